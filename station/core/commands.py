"""Commands: the option that names the configuration, and a group whose --help stays quick.

The group imports a subcommand only when it is called.
"""

from __future__ import annotations

import errno
import importlib
import logging
import math
import os
import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from station import version
from station.core.errors import BoothError, InputError
from station.core.service import has_log, set_up_caches
from station.core.start.interrupts import loading

COMPILING = "the reconstruction is being compiled, once on this machine: a minute or two"

config_option = click.option(
    "--config", "config_path", type=click.Path(path_type=Path), help="booth.toml"
)
"""The configuration; without it `station.core.config_file.find_config` chooses."""


def _show_version(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        click.echo(f"{context.info_name}, version {version()}")
        context.exit()


version_option = click.option(
    "--version", is_flag=True, expose_value=False, is_eager=True, callback=_show_version,
    help="Show the version and exit.",
)  # fmt: skip
"""The version of these programs; click's own asks for it whatever the command is."""
_OPTIONAL = {
    "open3d": "this command needs open3d, which is not part of the basic installation: apt "
    "install body-booth-simulation, "
    "or pip install 'body-booth[simulation]'",
}
"""A library that may be missing -> the remedy."""
_ENDING = (signal.SIGTERM, signal.SIGHUP)
_NO_ACCESS = (errno.EACCES, errno.EPERM, errno.ELOOP, errno.ENAMETOOLONG)
_NO_PLACE = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST)


def at_most_one(**given: object) -> None:
    """Refuse options of which the command would ignore all but one.

    Args:
        given: option -> its value.

    Raises:
        UsageError: several are given.
    """
    names = [f"--{name}" for name, value in given.items() if value]
    if len(names) > 1:
        raise click.UsageError(f"{' or '.join(names)}, not {'both' if len(names) == 2 else 'all'}")


class Number(click.FloatRange):
    """A number in a range. NaN lies in every range of click's own."""

    def __init__(
        self, low: float, high: float | None = None, *, unit: str = "", **kwargs: bool
    ) -> None:
        super().__init__(low, high, **kwargs)
        self._unit = f" {unit}" if unit else ""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            point = " (write a point, 1.8)" if "," in str(value) else ""
            self.fail(f"{value} is not a number {self._range()}{point}.", param, ctx)
        try:
            return float(super().convert(number, param, ctx))
        except click.BadParameter:
            raise click.BadParameter(f"{value} is not {self._range()}.", ctx, param) from None

    def _range(self) -> str:
        low = f"{'above' if self.min_open else 'from'} {self.min:g}"
        if self.max is None:
            return f"{low}{self._unit}{'' if self.min_open else ' up'}"
        return f"{low} up to {self.max:g}{self._unit}"


class LazyGroup(click.Group):
    """Subcommands from a table: name -> ("module:attribute", one line of help)."""

    def __init__(
        self, *args: Any, lazy: Mapping[str, tuple[str, str]] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self._lazy = dict(lazy or {})

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self._lazy, *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self._lazy:
            return super().get_command(ctx, cmd_name)
        module, attribute = self._lazy[cmd_name][0].split(":")
        with loading():
            command = getattr(importlib.import_module(module), attribute)
        assert isinstance(command, click.Command)
        return command

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (KeyboardInterrupt, click.Abort) as cause:
            # A question whose answers ended is aborted as well, and click says so.
            if isinstance(cause, click.Abort) and not isinstance(
                cause.__context__, KeyboardInterrupt
            ):
                raise
            raise _Ended(signal.SIGINT) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the table's own help lines: no subcommand is imported for it."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self._lazy.items()])


def writable_folder(folder: Path, option: str, mode: int = 0o777) -> None:
    """Make the folder that an option names, before any work is done for it.

    Raises:
        InputError: nothing can be written there; the message names the option.
    """
    try:
        folder.mkdir(mode, parents=True, exist_ok=True)
        # Root may write everywhere, by its rights, and still makes no file in /proc.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as cause:
        raise InputError(
            f"{folder} cannot be written ({cause.strerror}); name another folder with {option}"
        ) from None


class _Ended(SystemExit):
    """A signal, whose number is the code, ended the command."""

    code: signal.Signals


def _terminate(number: int, _: object) -> None:
    # A second signal must not end what cleans up after the first.
    for other in _ENDING:
        signal.signal(other, signal.SIG_IGN)
    raise _Ended(signal.Signals(number))


def _tell(error: str) -> None:
    """Tell of an error: a process that has a log in its log, a command on its terminal."""
    if has_log():
        logging.getLogger().error(error)
    else:
        click.echo(f"error: {error}", err=True)


def run(group: click.Group) -> None:
    """Call a command; an error that the user can act upon becomes one line and exit code 1.

    SIGTERM, a closed terminal and Ctrl-C end it as they would by default, without a word of its
    own, once folders that were made for its time are gone. Processes that run until they are
    stopped handle them themselves.
    """
    set_up_caches()
    for number in _ENDING:
        # nohup ignores the signal of a closed terminal.
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _terminate)
    try:
        group()
    except _Ended as ended:
        signal.signal(ended.code, signal.SIG_DFL)
        os.kill(os.getpid(), ended.code)
    except BoothError as error:
        _tell(str(error))
        sys.exit(1)
    except OSError as error:
        if error.filename and error.errno in (*_NO_ACCESS, *_NO_PLACE):
            _tell(
                f"{error.filename} cannot be used ({error.strerror}); check its name, and "
                "that this user may read and write there"
            )
            sys.exit(1)
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
            raise
        where = f": {error.filename}" if error.filename else ""
        _tell(
            f"the disk cannot be written ({error.strerror}{where}); free some space, then "
            "run the command again"
        )
        sys.exit(1)
    except ModuleNotFoundError as error:
        remedy = _OPTIONAL.get(error.name or "")
        if remedy is None:
            raise
        _tell(remedy)
        sys.exit(1)
