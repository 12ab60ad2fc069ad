"""Scans one after the other, seen on the console: each is delivered, and no process grows."""

from __future__ import annotations

import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
import psutil
from booth import Booth, whole_booth
from table import Row

_SLOPE_MB_H = 1.0
_DESCRIPTORS = 2
"""A connection that is being opened or closed, and a file."""
_SAMPLES = 60
_LOOKS, _BETWEEN_LOOKS_S = 10, 0.1
_WARM = 0.2
"""Share of the scans after which caches are full, and growth counts."""
_LOG_EVERY = 100


def soak_rows(scans_wanted: int, job: str) -> list[Row]:
    """Take so many scans, the next one as soon as the last one is accepted."""
    with (
        tempfile.TemporaryDirectory() as name,
        whole_booth(Path(name), job=job) as (booth, scans),
    ):
        began_s = time.monotonic()
        samples: list[tuple[float, dict[str, tuple[int, int]]]] = []
        for number in range(scans_wanted):
            scans.take()
            scans.settle(left=1)
            _look_at_console(booth)
            if number % max(1, scans_wanted // _SAMPLES) == 0:
                samples.append((time.monotonic() - began_s, _sizes(booth)))
            if number % _LOG_EVERY == 0:
                print(f"        {number} scans, {time.monotonic() - began_s:.0f} s", flush=True)
        scans.settle()
        hours = (time.monotonic() - began_s) / 3600
        delivered = len(scans.delivered())
        row = scans.row(f"{scans_wanted} scans, {job or 'whole'} jobs")
    grown = _growth(samples[int(_WARM * len(samples)) :])
    slopes = {process: slope for process, (slope, _) in grown.items()}
    worst = max(slopes, key=lambda process: slopes[process])
    opened = max(count for _, count in grown.values())
    return [
        row,
        Row(
            f"{scans_wanted} scans in {hours:.1f} h",
            "all delivered",
            f"{delivered} delivered",
            delivered == scans_wanted,
        ),
        Row(
            "memory and descriptors of a process",
            f"< {_SLOPE_MB_H:g} MB/h, flat",
            f"{slopes[worst]:.2f} MB/h ({worst}), {opened:+d} descriptors; "
            + ", ".join(f"{process} {slope:.2f}" for process, slope in sorted(slopes.items())),
            slopes[worst] < _SLOPE_MB_H and opened <= _DESCRIPTORS,
        ),
    ]


def _look_at_console(booth: Booth) -> None:
    """The requests of a page that shows the booth and its history."""
    for path in ("booth", "scans"):
        url = f"http://127.0.0.1:{booth.config.console.port}/api/v1/{path}"
        with urllib.request.urlopen(url, timeout=30.0) as answer:
            answer.read()


def _sizes(booth: Booth) -> dict[str, tuple[int, int]]:
    """Resident bytes and open descriptors of each process that lives on.

    The least of some looks: frames that come and go in between are no growth.
    """
    found: dict[str, tuple[int, int]] = {}
    of = {f"{name} {pid}": pid for name in booth.processes() for pid in booth.pids(name)}
    for _ in range(_LOOKS):
        for name, pid in of.items():
            process = psutil.Process(pid)
            now = process.memory_info().rss, process.num_fds()
            before = found.get(name, now)
            found[name] = min(before[0], now[0]), min(before[1], now[1])
        time.sleep(_BETWEEN_LOOKS_S)
    return found


def _growth(
    samples: list[tuple[float, dict[str, tuple[int, int]]]],
) -> dict[str, tuple[float, int]]:
    """MB an hour by least squares, and more descriptors at the end than at the beginning."""
    grown = {}
    for process in samples[-1][1]:
        rows = [(at_s, *sizes[process]) for at_s, sizes in samples if process in sizes]
        times, memory, opened = np.array(rows).T
        slope = np.polyfit(times / 3600, memory / 1e6, 1)[0] if len(rows) > 2 else 0.0
        grown[process] = float(slope), int(opened[-1] - opened[0])
    return grown
