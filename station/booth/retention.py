"""Retention of body scans, and the deletion of one."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import click

from station.archive.index import ScanIndex
from station.core.config import RetentionConfig, find_config, load_config
from station.core.errors import SpoolError
from station.core.spool import Spool

_DAY_S = 86_400.0
_MOST_OF_A_LABEL = 10_000


def expire_old(spool: Spool, retention: RetentionConfig, now_s: float) -> list[Path]:
    """Remove bundles of delivered scans, results and failed scans that are past their time."""
    limits = {
        "done": retention.raw_days,
        "outbox": retention.result_days,
        "failed": retention.result_days,
    }
    removed = []
    for state, folder in spool.every():
        if state in limits and now_s - folder.stat().st_mtime > limits[state] * _DAY_S:
            shutil.rmtree(folder, ignore_errors=True)
            removed.append(folder)
    return removed


def purge_scan(spool: Spool, scan_id: str) -> list[Path]:
    """Delete a scan, its bundle and its results.

    Raises:
        SpoolError: there is no such scan, or it is being reconstructed.
    """
    if spool.path("work", scan_id) in (folders := _folders(spool, scan_id)):
        raise SpoolError(f"scan {scan_id} is being reconstructed; try again when it is done")
    if not folders:
        raise SpoolError(f"there is no scan {scan_id} in {spool.folder}")
    for folder in folders:
        shutil.rmtree(folder)
    return folders


def _folders(spool: Spool, scan_id: str) -> list[Path]:
    return [folder for _, folder in spool.every() if folder.name == scan_id]


@click.command()
@click.argument("scan_id", required=False)
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
@click.option("--label", help="delete all scans with exactly this label")
@click.option("--old", is_flag=True, help="remove everything past its retention period")
def purge(scan_id: str | None, config_path: Path | None, label: str | None, old: bool) -> None:
    """Delete a scan and its results, all scans of a label, or all that are past their time.

    \b
    Examples:
      station purge 20261121T100000Z-7f3a
      station purge --label "Order 1234"
      station purge --old
    """
    if sum([bool(scan_id), label is not None, old]) != 1:
        raise click.UsageError("give a scan id, --label or --old")
    config = load_config(find_config(config_path))
    spool = Spool(config.spool.folder)
    if old:
        removed = expire_old(spool, config.retention, time.time())
    elif scan_id:
        removed = purge_scan(spool, scan_id)
    else:
        removed = _purge_label(spool, str(label))
    # Its labels go with the scans, now and not at the next look.
    ScanIndex(spool).find(limit=0)
    for folder in removed:
        click.echo(f"removed {folder}")


def _purge_label(spool: Spool, label: str) -> list[Path]:
    found = ScanIndex(spool).find(label=label, limit=_MOST_OF_A_LABEL)
    if not found:
        raise SpoolError(f"there is no scan with the label {label!r}; see station list")
    return [folder for scan in found for folder in purge_scan(spool, scan.scan_id)]
