"""`station list` and `station find`: scans by time and by label."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import click

from station.archive.index import ScanIndex
from station.archive.records import ScanRecord, read_noted
from station.core.commands import config_option
from station.core.config_file import find_config, load_config
from station.core.files import local_time
from station.core.scans import ScanId, is_scan_id
from station.core.spool import Spool
from station.core.words.terms import verdict_words

_limit_option = click.option(
    "--limit",
    type=click.IntRange(1, 1_000_000),
    default=20,
    show_default=True,
    help="largest number of scans to list, newest first",
)
_LABEL_LETTERS = 40
"""A longer label is cut short in the table."""
_WORDS = {
    "accepted": "waiting",
    "reconstructing": "reconstructing",
    "delivered": verdict_words("ok"),
    "rescan": verdict_words("rescan"),
    "failed": "failed",
}


@click.command("list")
@config_option
@click.option(
    "--since",
    default="",
    callback=lambda _, __, given: _moment(given),
    help="from this day or time on (2026-11-21, the booth's local time)",
)
@_limit_option
@click.option("--json", "as_json", is_flag=True, help="print JSON")
def list_scans(config_path: Path | None, since: str, limit: int, as_json: bool) -> None:
    """List the scans of this booth, newest first, with their outcome.

    Scans that were not taken (nobody in the booth, a silent camera) are not listed: of them there
    is nothing but the reason, which station find tells by the whole scan id. Times are
    the booth's local time; those in scan ids and in JSON are UTC.

    \b
    Examples:
      station list
      station list --since 2026-11-21 --limit 200
      station list --json
    """
    _show(config_path, "", since, limit, as_json)


@click.command()
@click.argument("text")
@config_option
@_limit_option
@click.option("--json", "as_json", is_flag=True, help="print JSON")
def find(text: str, config_path: Path | None, limit: int, as_json: bool) -> None:
    """Find scans whose label or id contains TEXT, ignoring case.

    By its whole id also a scan is found that was not taken, with the reason.

    \b
    Examples:
      station find "Order 1234"
      station find 20261121
      station find 20261121T100000Z-7f3a
    """
    _show(config_path, text, "", limit, as_json)


def _show(config_path: Path | None, text: str, since: str, limit: int, as_json: bool) -> None:
    config = load_config(find_config(config_path))
    spool = Spool(config.spool.folder)
    found = ScanIndex(spool).find(text, since=since, limit=limit)
    if not found and is_scan_id(text) and (noted := read_noted(spool, ScanId(text))):
        found = [noted]
    if as_json:
        click.echo(json.dumps([{**asdict(scan), "verdict": scan.verdict} for scan in found]))
        return
    if not found:
        since_then = f"no scans since {local_time(since)}" if since else "no scans yet"
        click.echo((_unended(spool, text) or f"no scan matches {text!r}") if text else since_then)
    for scan in found:
        click.echo(_line(scan))


def _unended(spool: Spool, text: str) -> str:
    """Words on a scan that is being taken, or was when the booth ended; empty if there is none."""
    if not is_scan_id(text) or spool.notes.read(ScanId(text)) is None:
        return ""
    return f"scan {text} has no outcome yet; it has one soon if the booth runs: see station status"


def _moment(given: str) -> str:
    """A day or time as scans have it: UTC, ISO 8601."""
    if not given:
        return ""
    try:
        # Without an offset it is the booth's local time.
        moment = datetime.fromisoformat(given).astimezone(UTC)
    except (ValueError, OverflowError):
        raise click.BadParameter(
            f"{given} is no day or time: write 2026-11-21, or 2026-11-21T10:00"
        ) from None
    return moment.replace(tzinfo=None).isoformat(timespec="seconds")


def _line(scan: ScanRecord) -> str:
    # A label is arbitrary text: control characters must not reach the terminal.
    label = "".join(c if c.isprintable() else "?" for c in scan.label) or "-"
    if len(label) > _LABEL_LETTERS:
        label = f"{label[: _LABEL_LETTERS - 1]}…"
    outcome = "cancelled" if scan.cancelled else _WORDS[scan.state]
    reasons = f"  {'; '.join(scan.reasons)}" if scan.reasons and not scan.cancelled else ""
    return f"{scan.scan_id:<24} {local_time(scan.created)}  {outcome:<14} {label}{reasons}"
