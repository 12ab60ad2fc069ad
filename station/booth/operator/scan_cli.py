"""The operator's command: scan."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import click

from station.archive.tables import printed_table, read_measurements
from station.booth.session import FINAL, ON_DISK, UNSURE
from station.core.commands import COMPILING, Number, config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.core.files import is_held
from station.core.scans import CANCELLED, new_scan_id, scan_id_of
from station.core.service import STATION_LOCK, read_health
from station.core.words.terms import verdict_words
from station.messaging.asking import STARTS, command
from station.messaging.messages import Request
from station.messaging.transport import NoAnswerError

_POLL_S = 0.05
_NOT_BEGUN = f"{STARTS}; no scan was started"
_EXIT_RESCAN = 3
_UNSURE_S = 15.0
"""Time within which a process that hangs is restarted and the outcome of a scan is known again."""
_TIMEOUT = Number(0.0, 86400.0, unit="seconds")
_CONTROL_LOCK = "control.lock"
_LOCKS = (STATION_LOCK, _CONTROL_LOCK, "sync.lock")
_WORDS = {
    "armed": "waiting for the cameras",
    "capturing": "hold still",
    "accepted": "scan accepted: the person may leave",
    "reconstructing": "reconstructing",
}
_CHANGING = (_WORDS["capturing"], _WORDS["reconstructing"])


@click.command()
@config_option
@click.option(
    "--label", default="", help="whose scan it is, e.g. an order number; stored with the scan"
)
@click.option("--scan-id", default=None, help="scan id, to repeat a command for the same scan")
@click.option("--wait/--no-wait", default=True, help="wait for the result")
@click.option(
    "--timeout", "timeout_s", type=_TIMEOUT, default=180.0, help="seconds to wait for the result"
)
def scan(
    config_path: Path | None, label: str, scan_id: str | None, wait: bool, timeout_s: float
) -> None:
    """Scan the person in the booth and wait for the result, which is usable or to be scanned again.

    Exit code 0: delivered and usable; 3: delivered, but scan again; 1: failed.

    \b
    Examples:
      station scan --label "Order 1234"
      station scan --no-wait
    """
    config = load_config(find_config(config_path))
    scan_id = scan_id_of(scan_id) if scan_id else new_scan_id()
    began_s = time.monotonic()
    valid_until_s = began_s + config.runtime.command_timeout_s
    order = Request("scan", scan_id, _text(label), valid_until_s)
    session = _ask_until_answered(config, order)
    click.echo(f"scan {scan_id}")
    try:
        session = _follow(config, order, session, _enough(wait), began_s + timeout_s)
    except KeyboardInterrupt:
        raise BoothError(
            f"scan {scan_id} continues without this command; see its state with: station find "
            f"{scan_id}; cancel it with: station cancel {scan_id}"
        ) from None
    if session["reason"] == CANCELLED:
        raise BoothError(f"scan {scan_id} was {CANCELLED}")
    if session["state"] == "failed":
        raise BoothError(f"scan {scan_id} failed: {session['reason']}")
    if not wait:
        return
    again = session["state"] == "rescan"
    if again:
        # Before any number, which nobody should then take down.
        click.echo(f"{verdict_words('rescan')}: {session['reason']}", err=True)
    else:
        click.echo(f"verdict: {verdict_words('ok')}")
    took = f"{time.monotonic() - began_s:.1f} s from the command to the result"
    path = session["path"]
    if not path or not Path(path).is_dir():
        click.echo(f"  {took}, which has been taken from the outbox")
    else:
        try:
            show_result(Path(path))
        finally:
            # Where the table cannot be read, the folder still holds the surface.
            click.echo(f"\n{took}:\n{path}")
    if again:
        sys.exit(_EXIT_RESCAN)


def _enough(wait: bool) -> Callable[[str], bool]:
    if wait:
        return lambda state: state in FINAL
    return lambda state: state in FINAL or state in ("accepted", "reconstructing")


def _follow(
    config: BoothConfig,
    order: Request,
    session: dict[str, Any],
    enough: Callable[[str], bool],
    deadline_s: float,
) -> dict[str, Any]:
    """Show each new state on a line of its own until it is enough."""
    scan_id = order.scan_id
    free, told, sure_s = False, False, time.monotonic()
    begun_s: float | None = None
    with closing(_Line()) as line:
        while True:
            state = session["state"]
            if session["reason"] != UNSURE:
                sure_s = time.monotonic()
            elif time.monotonic() - sure_s > _UNSURE_S:
                raise UnsureError(scan_id)
            if state in ON_DISK and state != "accepted" and not free:
                # The scan ended before this poll; the person waits for this message.
                line.show(_WORDS["accepted"])
            free = free or state in ON_DISK
            words = _WORDS.get(state, state)
            if state == "capturing" and session["wanted"]:
                words += f" ({session['framesets']} of {session['wanted']})"
                if session["framesets"] >= session["wanted"]:
                    words = "pictures taken: the person may move; storing"
            if state == "reconstructing" and sys.stdout.isatty():
                begun_s = begun_s or time.monotonic()
                words += f" ({time.monotonic() - begun_s:.0f} s)"
            if session["reason"] == UNSURE:
                words = UNSURE
            if session["reason"] == CANCELLED:
                words = "cancelled"
            if state == "reconstructing" and not told and _compiles(config):
                told = True
                line.show(COMPILING)
            line.show(words, changes=words.startswith(_CHANGING))
            if enough(state):
                return session
            if time.monotonic() > deadline_s:
                raise BoothError(
                    f"scan {scan_id} is not done yet (its state is {state}) and goes on; do not "
                    f"scan again: station find {scan_id} shows its outcome"
                )
            time.sleep(_POLL_S)
            # The order itself may not have been recorded; repeated, it is the same scan.
            unsure = session["reason"] == UNSURE
            request = order if unsure else Request("scan-status", scan_id)
            session = _ask_until_answered(config, request, line)


def _compiles(config: BoothConfig) -> bool:
    """Whether a scan waits for the first reconstruction to be compiled."""
    return bool(read_health(config.runtime.folder, "workers").get("compiling"))


class _Line:
    """The line of a scan's state; where somebody watches, it is written over while it changes."""

    def __init__(self) -> None:
        self._told, self._open = "", False

    def show(self, words: str, *, changes: bool = False) -> None:
        """Show words that are new; ``changes``: others of the same state may follow."""
        if words == self._told:
            return
        written_over = changes and sys.stdout.isatty()
        click.echo(("\r" if self._open else "") + f"  {words:<44}", nl=not written_over)
        self._told, self._open = words, written_over

    def close(self) -> None:
        """End the line: whatever is told next has its own."""
        if self._open:
            click.echo()
            self._open = False


class UnsureError(BoothError):
    """The outcome of a scan could not be determined in time."""

    def __init__(self, scan_id: str) -> None:
        super().__init__(f"scan {scan_id}: {UNSURE}; see station status and station find {scan_id}")


def _ask_until_answered(
    config: BoothConfig, request: Request, line: _Line | None = None
) -> dict[str, Any]:
    """Control's reply about a scan, retried until it arrives: a repeated order is the same scan.

    Args:
        line: where the scan's state is shown; the order was received then.

    Raises:
        UnsureError: it did not arrive; the scan may be taken anyway.
        BoothError: control refused, or never ran; no scan was started.
    """
    deadline_s = time.monotonic() + _UNSURE_S
    lock = config.runtime.folder / _CONTROL_LOCK
    received = line is not None
    told = ""
    while True:
        # An order that nobody could receive is not taken up later: it went with its socket.
        received = received or is_held(lock)
        try:
            return command(config, request)
        except NoAnswerError:
            runs = any(is_held(config.runtime.folder / lock) for lock in _LOCKS)
            if not (told or line or runs):
                # No station is running here: nobody received the order.
                raise
            received = received or is_held(lock)
            if time.monotonic() > deadline_s:
                raise (
                    UnsureError(request.scan_id) if received else BoothError(_NOT_BEGUN)
                ) from None
            words = UNSURE if received else "the booth is starting"
            if told != words:
                if line is not None:
                    line.close()
                click.echo(f"  {words}", err=True)
            told = words
            time.sleep(_POLL_S)


def _text(label: str) -> str:
    """A label, with unprintable characters removed."""
    text = label.encode(errors="surrogateescape").decode(errors="replace")
    return "".join(letter if letter.isprintable() else " " for letter in text)


def show_result(folder: Path) -> None:
    """Print the remarks on a delivered result, and its table.

    Raises:
        FormatError: it cannot be read.
    """
    document = read_measurements(folder, "as-scanned")
    for remark in (document.get("verdict") or {}).get("notes", ()):
        click.echo(f"remark: {remark}")
    click.echo("")
    for line in printed_table(document):
        click.echo(f"  {line}".rstrip())
