"""SIGSTOP of each process: it is named, then replaced, and nothing else suffers."""

from __future__ import annotations

import os
import signal
import time

from booth import WAIT_S, Booth, Scans, until
from table import Row

_NAMED_S, _REPLACED_S = 5.0, 15.0
_GAP_S = 1.0
"""The longest time without a new frameset that counts as unharmed: reports are 0.25 s apart."""


def stop_rows(booth: Booth, scans: Scans, only: tuple[str, ...] = ()) -> list[Row]:
    """Stop each process of a booth, or only some."""
    rows = [_stop(booth, process) for process in only or booth.processes()]
    scans.take()
    scans.settle()
    return [*rows, scans.row("a scan after all of them")]


def _stop(booth: Booth, name: str) -> Row:
    booth.wait(booth.well, f"the booth is whole before {name} is stopped")
    others = {other: booth.pids(other) for other in booth.processes() if other != name}
    [victim, *_] = booth.pids(name)
    stopped_s = time.monotonic()
    os.kill(victim, signal.SIGSTOP)
    named_s = until(lambda: any(name in problem for problem in booth.problems()))
    needed = name == "sync" or name.startswith("capture")
    gap_s = 0.0 if needed else _longest_gap_s(booth, name, victim)
    until(lambda: booth.replaced(name, victim))
    replaced_s = time.monotonic() - stopped_s
    changed = [other for other, pids in others.items() if booth.pids(other) != pids]
    seen = f"named {named_s:.1f} s, replaced {replaced_s:.1f} s, others restarted: {len(changed)}"
    return Row(
        f"SIGSTOP of {name}",
        f"named in {_NAMED_S:g} s, replaced in {_REPLACED_S:g} s, rest unharmed",
        seen if needed else f"{seen}, longest gap {gap_s:.1f} s",
        named_s <= _NAMED_S and replaced_s <= _REPLACED_S and not changed and gap_s <= _GAP_S,
        timed=True,
    )


def _longest_gap_s(booth: Booth, name: str, victim: int) -> float:
    """The longest time without a new frameset until the process is replaced."""
    began_s = last_s = time.monotonic()
    known, longest_s = booth.framesets(), 0.0
    while not booth.replaced(name, victim) and time.monotonic() - began_s < WAIT_S:
        now_s, count = time.monotonic(), booth.framesets()
        longest_s = max(longest_s, now_s - last_s)
        if count != known:
            known, last_s = count, now_s
        time.sleep(0.02)
    return longest_s
