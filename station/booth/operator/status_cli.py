"""The operator's command: status."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from station.booth.health import (
    booth_health,
    can_scan,
    reports,
    scans_by_outcome,
    starting,
    unusable,
)
from station.core.commands import config_option
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.core.service import NOTHING_RUNS
from station.messaging.asking import STARTS, command
from station.messaging.messages import Request

_EXIT_NO_SCANS = 1


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
        content = command(config, Request("status"))
    except BoothError as problem:
        error, content = problem, {**asdict(booth_health(config)), "streaming": None}
        if starting(content["processes"]):
            error = BoothError(STARTS)
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
            click.echo(f"! {STARTS}")
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
        click.echo(f"deliver {name}: {count or 'nothing'} to hand over")
    counts = scans_by_outcome(content["spool"], content.get("cancelled", 0))
    free = f"; {content['free_bytes'] / 1e9:.1f} GB free" if content["free_bytes"] else ""
    click.echo(
        f"spool: {', '.join(f'{n} {state}' for state, n in counts.items()) or 'empty'}{free}"
    )
    for problem in content["problems"]:
        if problem != NOTHING_RUNS or content["streaming"] is not None:  # else told as the error
            click.echo(f"! {problem}")
    for remark in content.get("remarks", []):
        click.echo(f"! {remark}")
