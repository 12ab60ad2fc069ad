"""The operator's commands: start, scan, status, stop."""

from __future__ import annotations

import json
import secrets
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from station.booth.session import FINAL, ON_DISK
from station.core.config import BoothConfig, find_config, load_config
from station.core.errors import BoothError
from station.core.spool import count_scans
from station.messaging.messages import Request
from station.messaging.transport import ask

_POLL_S = 0.05
_EXIT_RESCAN = 3
_WORDS = {
    "armed": "waiting for the cameras",
    "capturing": "hold still",
    "accepted": "scan accepted: the person may leave",
    "reconstructing": "reconstructing",
}

config_option = click.option(
    "--config", "config_path", type=click.Path(path_type=Path), help="booth.toml"
)


def _command(config: BoothConfig, request: Request) -> dict[str, Any]:
    reply = ask(config.runtime.folder, "control", request, config.runtime.command_timeout_s)
    if not reply.ok:
        raise BoothError(reply.error)
    return reply.content


@click.command()
@config_option
@click.option("--timeout", "timeout_s", default=20.0, help="seconds to wait for all cameras")
def start(config_path: Path | None, timeout_s: float) -> None:
    """Start the sensors and wait until every camera gives frames.

    \b
    Examples:
      station start
    """
    config = load_config(find_config(config_path))
    _command(config, Request("start"))
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
            # Between two tries a camera has nothing to say; what it said last still holds.
            if detail and troubles.get(name) != detail:
                troubles[name] = detail
                click.echo(f"  camera {name}: {detail}; trying again", err=True)
        if time.monotonic() > deadline_s:
            raise BoothError(
                "; ".join(f"camera {name}: {troubles.get(name, 'no frames')}" for name in silent)
            )
        time.sleep(_POLL_S)
    click.echo(f"{len(config.cameras)} cameras streaming")


@click.command()
@config_option
def stop(config_path: Path | None) -> None:
    """Stop the sensors; scans that were accepted go on.

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
    """Give up a scan that is being taken or waits for its reconstruction.

    \b
    Examples:
      station cancel 20261121T100000Z-7f3a
    """
    config = load_config(find_config(config_path))
    session = _command(config, Request("cancel", scan_id))
    click.echo(f"scan {scan_id}: {session['reason'] or session['state']}")


@click.command()
@config_option
@click.option("--json", "as_json", is_flag=True, help="for programs")
def status(config_path: Path | None, as_json: bool) -> None:
    """Show cameras, framesets and the spool.

    \b
    Examples:
      station status
      station status --json
    """
    config = load_config(find_config(config_path))
    try:
        content = _command(config, Request("status"))
    except BoothError:
        # What was accepted and delivered is on disk, whether a station runs or not.
        if config.spool.folder.is_dir() and not as_json:
            with suppress(OSError):
                _show_spool(count_scans(config.spool.folder))
        raise
    if as_json:
        click.echo(json.dumps(content))
        return
    click.echo("sensors " + ("started" if content["streaming"] else "stopped"))
    for name, camera in content["sync"].get("cameras", {}).items():
        # Sensors that were stopped are not amiss.
        amiss = camera["silent"] and content["streaming"]
        words = "silent" if amiss else camera["state"]
        click.echo(
            f"  {name:<16} {words:<10} {camera['frames']} frames, {camera['lost']} lost"
            + (f"  {camera['detail']}" if camera["detail"] else "")
        )
    if "error" in content["sync"]:
        click.echo(f"  {content['sync']['error']}")
    _show_spool(content["spool"])


def _show_spool(counts: Mapping[str, int]) -> None:
    click.echo(
        f"spool: {', '.join(f'{count} {state}' for state, count in counts.items()) or 'empty'}"
    )


@click.command()
@config_option
@click.option("--label", default="", help="whose scan it is; kept in the bundle")
@click.option("--scan-id", default=None, help="repeat a command for the same scan")
@click.option("--wait/--no-wait", default=True, help="wait for the result")
@click.option("--timeout", "timeout_s", default=180.0, help="seconds to wait for the result")
def scan(
    config_path: Path | None, label: str, scan_id: str | None, wait: bool, timeout_s: float
) -> None:
    """Scan the person in the booth and wait for the result.

    Exit code 0: delivered; 3: delivered, but scan again; 1: failed.

    \b
    Examples:
      station scan --label "Order 1234"
      station scan --no-wait
    """
    config = load_config(find_config(config_path))
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    scan_id = scan_id or f"{stamp}-{secrets.token_hex(2)}"
    began_s = time.monotonic()
    session = _command(config, Request("scan", scan_id, label))
    click.echo(f"scan {scan_id}")
    try:
        session = _follow(config, scan_id, session, _enough(wait), began_s + timeout_s)
    except KeyboardInterrupt:
        raise BoothError(
            f"scan {scan_id} goes on without this command; its state: station find {scan_id}; "
            f"give it up: station cancel {scan_id}"
        ) from None
    if session["state"] == "failed":
        raise BoothError(f"scan {scan_id} failed: {session['reason']}")
    if not wait:
        return
    click.echo(session["path"])
    _show_result(Path(session["path"]))
    click.echo(f"\n{time.monotonic() - began_s:.1f} s from the command to the result")
    if session["state"] == "rescan":
        click.echo(f"scan again: {session['reason']}", err=True)
        sys.exit(_EXIT_RESCAN)


def _enough(wait: bool) -> Callable[[str], bool]:
    if wait:
        return lambda state: state in FINAL
    return lambda state: state in FINAL or state in ("accepted", "reconstructing")


def _follow(
    config: BoothConfig,
    scan_id: str,
    session: dict[str, Any],
    enough: Callable[[str], bool],
    deadline_s: float,
) -> dict[str, Any]:
    """Show each new state on a line of its own until it is enough."""
    told, free = "", False
    while True:
        state = session["state"]
        if state in ON_DISK and state != "accepted" and not free:
            # The scan was quicker than the question: the person waits for this word.
            click.echo(f"  {_WORDS['accepted']:<44}")
        free = free or state in ON_DISK
        words = _WORDS.get(state, state)
        if state == "capturing" and session["wanted"]:
            words += f" ({session['framesets']} of {session['wanted']})"
        if words != told:
            fresh = sys.stdout.isatty() and told.startswith("hold still")
            click.echo(("\r" if fresh else "") + f"  {words:<44}", nl=not words.startswith("hold"))
            if words.startswith("hold") and not sys.stdout.isatty():
                click.echo()
            told = words
        if enough(state):
            return session
        if time.monotonic() > deadline_s:
            raise BoothError(f"scan {scan_id} is {state} and not done in time; see station status")
        time.sleep(_POLL_S)
        session = _command(config, Request("scan-status", scan_id))


def _show_result(folder: Path) -> None:
    document = json.loads((folder / "measurements.json").read_text())
    click.echo("")
    for row in document["measurements"]:
        low, high = row["interval95_m"]
        half_mm = 500 * (high - low)
        click.echo(f"  {row['name']:<28} {100 * row['value_m']:7.1f} cm  ± {half_mm:.0f} mm")
    seconds = json.loads((folder / "result.json").read_text())["seconds"]
    click.echo("\n  " + "  ".join(f"{step} {value:.2f} s" for step, value in seconds.items()))
