"""The operator's commands: start, stop, cancel."""

from __future__ import annotations

import time
from pathlib import Path

import click

from station.core.commands import Number, config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.messaging.asking import command
from station.messaging.messages import Request
from station.messaging.transport import NothingRunsError

_POLL_S = 0.05
_BEGINS_S = 3.0
"""Time within which `station run` shows that it runs, on a busy computer."""
_TIMEOUT = Number(0.0, 86400.0, unit="seconds")


@click.command()
@config_option
@click.option(
    "--timeout", "timeout_s", type=_TIMEOUT, default=20.0, help="seconds to wait for all cameras"
)
def start(config_path: Path | None, timeout_s: float) -> None:
    """Start the sensors and wait until every camera sends frames.

    \b
    Examples:
      station start
    """
    config = load_config(find_config(config_path))
    _start(config)
    began_s = time.monotonic()
    deadline_s = began_s + timeout_s
    troubles: dict[str, str] = {}
    while True:
        sync = command(config, Request("status"))["sync"]
        silent = sync.get("silent", [camera.name for camera in config.cameras])
        # A camera whose process has just died counts as silent only after a while.
        if not silent and time.monotonic() - began_s > config.sync.silent_after_s:
            break
        for name in silent:
            detail = sync.get("cameras", {}).get(name, {}).get("detail")
            # Between two attempts a camera reports no detail; its last one still applies.
            if detail and troubles.get(name) != detail:
                troubles[name] = detail
                click.echo(f"  camera {name}: {detail}; trying again", err=True)
        if time.monotonic() > deadline_s:
            raise BoothError(
                "; ".join(f"camera {name}: {troubles.get(name, 'no frames')}" for name in silent)
            )
        time.sleep(_POLL_S)
    count = len(config.cameras)
    click.echo(f"{count} camera{'s' if count > 1 else ''} streaming")


def _start(config: BoothConfig) -> None:
    """Ask control to start the sensors.

    `station run` may have been begun a moment ago in the same script: it is given the time to show
    that it runs, and its control process the time to answer.
    """
    deadline_s = time.monotonic() + _BEGINS_S
    while True:
        try:
            command(config, Request("start"), repeats=True)
            return
        except NothingRunsError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_POLL_S)


@click.command()
@config_option
def stop(config_path: Path | None) -> None:
    """Stop the sensors; accepted scans are still reconstructed.

    \b
    Examples:
      station stop
    """
    config = load_config(find_config(config_path))
    command(config, Request("stop"))
    click.echo("sensors stopped")


@click.command()
@click.argument("scan_id")
@config_option
def cancel(scan_id: str, config_path: Path | None) -> None:
    """Cancel a scan that is being taken, also in the console's countdown, or is waiting to be
    reconstructed.

    \b
    Examples:
      station cancel 20261121T100000Z-7f3a
    """
    config = load_config(find_config(config_path))
    session = command(config, Request("cancel", scan_id))
    click.echo(f"scan {scan_id}: {session['reason'] or session['state']}")
