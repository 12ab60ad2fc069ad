"""A wall clock that jumps by forty days while the station runs."""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from pathlib import Path

from booth import Booth, Scans, running_booth
from table import Row

_DAY_S = 86_400
_JUMPS = (40, -40, 0)
"""Days by which the wall clock is ahead, one after the other."""
_TIDYING_S = 5.0
"""A process that control starts when it starts looks for what is due."""


def wall_clock_rows() -> list[Row]:
    """Jump between scans and within one; control looks for old scans after each jump."""
    with (
        tempfile.TemporaryDirectory() as name,
        running_booth(Path(name), job="quick") as (booth, scans),
    ):
        deleted = sum(_jump(booth, scans, days) for days in _JUMPS)
        row = scans.row("scans while the wall clock jumps")
        refused = len(scans.told) - sum(map(scans.accepted, scans.told))
    return [
        Row(
            f"wall clock ahead by {_JUMPS} days",
            "nothing deleted that is not due",
            f"{deleted} bundles or notes deleted, {refused} scans refused",
            not deleted and not refused,
        ),
        row,
    ]


def _jump(booth: Booth, scans: Scans, days: int) -> int:
    """Jump while a scan is taken; returns how much of the earlier ones is gone."""
    scans.take()
    scans.settle()
    before = _kept(booth)
    taking = threading.Thread(target=scans.take)
    taking.start()
    time.sleep(0.3)
    for clock in booth.clocks:
        clock.move_wall_clock(days * _DAY_S)
    taking.join()
    [control] = booth.pids("control")
    os.kill(control, signal.SIGKILL)
    booth.wait(lambda: booth.replaced("control", control), "control is back")
    time.sleep(_TIDYING_S)
    booth.wait(booth.well, "the booth is whole after a jump")
    scans.take()
    scans.settle()
    return len(before - _kept(booth))


def _kept(booth: Booth) -> set[Path]:
    return {path for state in ("done", "scans") for path in (booth.spool / state).iterdir()}
