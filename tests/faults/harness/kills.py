"""kill -9 of each process at random moments of a scan."""

from __future__ import annotations

import os
import random
import signal
import threading
import time

from booth import Booth, Scans, until
from table import Row, percentile

_ISOLATED_S, _REPEATED_S = 3.0, 6.0
_APART_S = 10.0
"""A process that ran this long is restarted at once; one that keeps dying after a pause."""
_AGAIN = 0.25
"""Share of the kills that hit the same process once more, as soon as it is back."""
_MAX_WAITING = 3


def kill_rows(booth: Booth, scans: Scans, kills: int, seed: int) -> list[Row]:
    """Kill so many processes of a booth."""
    killed = _kill(booth, scans, kills, random.Random(seed))
    # Each kill may rightly have cost its scan; nothing costs this one.
    scans.take()
    scans.settle()
    rows = [scans.row(f"kill -9 at random moments, {kills} times")]
    for kind, limit_s in (("isolated", _ISOLATED_S), ("repeated", _REPEATED_S)):
        times = [back_s for of, back_s in killed if of == kind]
        if times:
            rows.append(
                Row(
                    f"frames after kill -9 of capture or sync, {kind}",
                    f"again within {limit_s:g} s",
                    f"{len(times)} kills, p50 {percentile(times, 0.5):.1f} s, "
                    f"p95 {percentile(times, 0.95):.1f} s, worst {max(times):.1f} s",
                    max(times) <= limit_s,
                    timed=True,
                )
            )
    return rows


def _kill(booth: Booth, scans: Scans, kills: int, rng: random.Random) -> list[tuple[str, float]]:
    """("isolated" or "repeated", seconds without frames) of the kills that stop them."""
    names = [*booth.processes(), "job"]
    last_s: dict[str, float] = {}
    found = []
    name = rng.choice(names)
    for _ in range(kills):
        if rng.random() > _AGAIN:
            name = rng.choice(names)
        taking = threading.Thread(target=scans.take)
        taking.start()
        time.sleep(rng.uniform(0.0, 2.0))
        apart = time.monotonic() - last_s.get(name, 0.0) > _APART_S
        pids = booth.pids(name)
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        killed_s = last_s[name] = time.monotonic()
        if name == "sync" or name.startswith("capture"):
            _wait_for_frames(booth, name, pids)
            found.append(("isolated" if apart else "repeated", time.monotonic() - killed_s))
        taking.join()
        booth.wait(booth.well, f"the booth is whole again after the end of {name}")
        scans.settle(left=_MAX_WAITING)
    return found


def _wait_for_frames(booth: Booth, name: str, killed: list[int]) -> None:
    until(lambda: booth.replaced(name, killed[0] if killed else 0))
    if name != "sync":
        until(lambda: booth.report(name).get("state") == "streaming")
    before = booth.framesets() if name != "sync" else 0
    until(lambda: booth.framesets() > before)
