"""The operator's commands: start, scan, status, stop."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from station.archive.tables import printed_table, read_measurements
from station.booth.health import (
    booth_health,
    can_scan,
    reports,
    scans_by_outcome,
    starting,
    unusable,
)
from station.booth.session import FINAL, ON_DISK, UNSURE
from station.core.commands import Number, config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.core.files import is_held
from station.core.scans import CANCELLED, new_scan_id, scan_id_of
from station.core.service import NOTHING_RUNS, STATION_LOCK
from station.messaging.messages import Request
from station.messaging.transport import NoAnswerError, NothingRunsError, ask, ask_again

_POLL_S = 0.05
_BEGINS_S = 3.0
"""Time within which `station run` shows that it runs, on a busy computer."""
_STARTS = "the booth is starting; try again in a few seconds"
_NOT_BEGUN = f"{_STARTS}; no scan was started"
_EXIT_RESCAN = 3
_EXIT_NO_SCANS = 1
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


def _command(config: BoothConfig, request: Request, *, repeats: bool = False) -> dict[str, Any]:
    runtime = config.runtime
    asked = ask_again if repeats else ask
    reply = asked(runtime.folder, "control", request, runtime.command_timeout_s)
    if not reply.ok:
        raise BoothError(reply.error)
    return reply.content


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
        sync = _command(config, Request("status"))["sync"]
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
            _command(config, Request("start"), repeats=True)
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
    _command(config, Request("stop"))
    click.echo("sensors stopped")


@click.command()
@click.argument("scan_id")
@config_option
def cancel(scan_id: str, config_path: Path | None) -> None:
    """Cancel a scan that is being taken or is waiting to be reconstructed.

    \b
    Examples:
      station cancel 20261121T100000Z-7f3a
    """
    config = load_config(find_config(config_path))
    session = _command(config, Request("cancel", scan_id))
    click.echo(f"scan {scan_id}: {session['reason'] or session['state']}")


@click.command()
@config_option
@click.option("--json", "as_json", is_flag=True, help="print JSON")
def status(config_path: Path | None, as_json: bool) -> None:
    """Show processes, cameras, framesets and the spool, and what is wrong with them.

    Exit code 0: scans can be taken, once the sensors are started if they are stopped; 1: they
    cannot, because the booth does not run, a process that scans need or a camera is silent or
    disturbed, the disk is full, or the calibration is missing or of other cameras. What is known is
    shown either way.

    \b
    Examples:
      station status
      station status --json
    """
    config = load_config(find_config(config_path))
    error = None
    try:
        content = _command(config, Request("status"))
    except BoothError as problem:
        error, content = problem, {**asdict(booth_health(config)), "streaming": None}
        if starting(content["processes"]):
            error = BoothError(_STARTS)
    if as_json:
        click.echo(json.dumps(content))
    else:
        _show_status(content)
    if error is not None:
        raise error
    if not can_scan(config, content):
        # The station tells it of the booth.toml that it was begun with.
        words = unusable(config)
        if not as_json and words and words not in content["problems"]:
            click.echo(f"! {words}")
        if not as_json and starting(content["processes"]):
            click.echo(f"! {_STARTS}")
        sys.exit(_EXIT_NO_SCANS)


def _show_status(content: Mapping[str, Any]) -> None:
    streaming = content["streaming"]
    if streaming is not None:
        click.echo("sensors " + ("started" if streaming else "stopped"))
    if any(content["processes"].values()):
        click.echo(f"  {'process':<22} {'state':<10} last report")
        begun = starting(content["processes"])
        silent = "SILENT" if any(map(reports, content["processes"].values())) else "stopped"
        for name, told in content["processes"].items():
            words = "running" if reports(told) else silent
            age = f"{told['age_s']:.0f} s ago" if told else "never"
            if name in begun:
                words, age = "starting", ""
            click.echo(f"  {name:<22} {words:<10} {age}".rstrip())
    cameras = content["sync"].get("cameras", {})
    if cameras:
        click.echo(f"  {'camera':<22} {'state':<10} {'frames':>8} {'lost':>6} {'Hz':>5}")
    for name, camera in cameras.items():
        # Sensors that were stopped are expected to be silent.
        unexpectedly_silent = camera["silent"] and streaming
        words = "silent" if unexpectedly_silent else camera["state"]
        rate = f"{camera['rate_hz']:.0f}" if camera["rate_hz"] else ""
        click.echo(
            f"  {name:<22} {words:<10} {camera['frames']:>8} {camera['lost']:>6} {rate:>5}"
            + (f"  {camera['detail']}" if camera["detail"] else "")
        )
    if streaming and "framesets_hz" in content["sync"]:
        click.echo(f"framesets: {content['sync']['framesets_hz']:.0f} per second")
    for name, count in content["processes"].get("deliver", {}).get("waiting", {}).items():
        click.echo(f"deliver {name}: " + (f"{count} to hand over" if count else "all handed over"))
    counts = scans_by_outcome(content["spool"], content.get("cancelled", 0))
    free = f"; {content['free_bytes'] / 1e9:.1f} GB free" if content["free_bytes"] else ""
    click.echo(
        f"spool: {', '.join(f'{n} {state}' for state, n in counts.items()) or 'empty'}{free}"
    )
    for problem in content["problems"]:
        if problem != NOTHING_RUNS or content["streaming"] is not None:  # else told as the error
            click.echo(f"! {problem}")


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
        click.echo(f"scan again: {session['reason']}", err=True)
    else:
        click.echo("verdict: usable")
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
    free, sure_s = False, time.monotonic()
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
            return _command(config, request)
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
    """Print a delivered result's table.

    Raises:
        FormatError: it cannot be read.
    """
    click.echo("")
    for line in printed_table(read_measurements(folder, "as-scanned")):
        click.echo(f"  {line}".rstrip())
