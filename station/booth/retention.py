"""How long body scans are kept, and how one is deleted."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import click

from station.core.config import RetentionConfig, find_config, load_config
from station.core.errors import SpoolError
from station.core.spool import Spool

_DAY_S = 86_400.0


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


@click.command()
@click.argument("scan_id", required=False)
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
@click.option("--old", is_flag=True, help="remove everything past its retention period")
def purge(scan_id: str | None, config_path: Path | None, old: bool) -> None:
    """Delete a scan and its results, or all that are past their time.

    \b
    Examples:
      station purge 20261121T100000Z-7f3a
      station purge --old
    """
    config = load_config(find_config(config_path))
    spool = Spool(config.spool.folder)
    if old:
        removed = expire_old(spool, config.retention, time.time())
    elif scan_id:
        removed = [folder for _, folder in spool.every() if folder.name == scan_id]
        if not removed:
            raise SpoolError(f"there is no scan {scan_id} in {spool.folder}")
        if spool.path("work", scan_id) in removed:
            raise SpoolError(f"scan {scan_id} is being reconstructed; try again when it is done")
        for folder in removed:
            shutil.rmtree(folder)
    else:
        raise click.UsageError("give a scan id, or --old")
    for folder in removed:
        click.echo(f"removed {folder}")
