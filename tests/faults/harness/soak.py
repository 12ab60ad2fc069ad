"""Scans one after the other, seen on the console: each is delivered, and no process grows."""

from __future__ import annotations

import tempfile
import time
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from booth import Booth, whole_booth
from table import Row

_SLOPE_MB_H = 1.0
_DESCRIPTORS = 2
"""A connection that is being opened or closed, and a file."""
_SAMPLES = 200
_LOOKS, _BETWEEN_LOOKS_S = 10, 0.1
_WARM = 0.5
"""Scans taken first, per scan that counts: until caches are full, and until the interpreter has
rebuilt its table of names once, by 1 MB, since the parts of each path go through it (pathlib)."""
_FEWEST = 8
"""Samples that give a slope and its error."""
_LOG_EVERY = 100


def soak_rows(scans_wanted: int, job: str) -> list[Row]:
    """Take so many scans after some that do not count, the next as soon as the last is accepted."""
    with (
        tempfile.TemporaryDirectory() as name,
        whole_booth(Path(name), job=job) as (booth, scans),
    ):
        began_s = time.monotonic()
        refused = 0
        samples: list[tuple[float, dict[str, tuple[int, int]]]] = []
        warm = int(_WARM * scans_wanted)
        for number in range(-warm, scans_wanted):
            scans.take()
            scans.settle(left=1)
            refused += _look_at_console(booth)
            if number >= 0 and number % max(1, scans_wanted // _SAMPLES) == 0:
                samples.append((time.monotonic() - began_s, _sizes(booth)))
            if number % _LOG_EVERY == 0:
                print(f"        {number} scans, {time.monotonic() - began_s:.0f} s", flush=True)
        scans.settle()
        hours = (time.monotonic() - began_s) / 3600
        delivered = len(scans.delivered())
        row = scans.row(f"{warm} + {scans_wanted} scans, {job or 'whole'} jobs")
    grown = _growth(samples)
    worst = max(grown, key=lambda process: grown[process].at_most)
    opened = max(one.descriptors for one in grown.values())
    return [
        row,
        Row(
            f"{warm + scans_wanted} scans in {hours:.1f} h",
            "all delivered, the console answers",
            f"{delivered} delivered, {refused} requests of the console failed",
            delivered == warm + scans_wanted and not refused,
        ),
        Row(
            "memory and descriptors of a process",
            f"< {_SLOPE_MB_H:g} MB/h, flat",
            f"{grown[worst]} MB/h ({worst}), {opened:+d} descriptors; "
            + ", ".join(f"{process} {one}" for process, one in sorted(grown.items())),
            grown[worst].at_most < _SLOPE_MB_H and opened <= _DESCRIPTORS,
        ),
    ]


def _look_at_console(booth: Booth) -> int:
    """The requests of a page that shows the booth and its history; returns how many failed."""
    failed = 0
    for path in ("booth", "scans"):
        url = f"http://127.0.0.1:{booth.config.console.port}/api/v1/{path}"
        try:
            with urllib.request.urlopen(url, timeout=30.0) as answer:
                answer.read()
        except urllib.error.HTTPError as error:
            print(f"        {path}: {error.code} {error.read().decode()}", flush=True)
            failed += 1
        except OSError as error:
            print(f"        {path}: {error}", flush=True)
            failed += 1
    return failed


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


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of a process, by a line through its samples."""

    slope_mb_h: float
    error_mb_h: float
    """Standard error of the slope, from how far the samples lie from the line."""
    descriptors: int
    """More at the end than at the beginning."""

    @property
    def at_most(self) -> float:
        """The slope that two standard errors do not exclude."""
        return self.slope_mb_h + 2 * self.error_mb_h

    def __str__(self) -> str:
        return f"{self.slope_mb_h:.2f}+-{self.error_mb_h:.2f}"


def _growth(samples: list[tuple[float, dict[str, tuple[int, int]]]]) -> dict[str, Growth]:
    """Growth of each process that lives at the end; of one with few samples nothing is known."""
    grown = {}
    for process in samples[-1][1]:
        rows = [(at_s, *sizes[process]) for at_s, sizes in samples if process in sizes]
        times, memory, opened = np.array(rows).T
        slope, error = 0.0, float("inf")
        if len(rows) > _FEWEST:
            line, covariance = np.polyfit(times / 3600, memory / 1e6, 1, cov=True)
            slope, error = float(line[0]), float(np.sqrt(covariance[0, 0]))
        grown[process] = Growth(slope, error, int(opened[-1] - opened[0]))
    return grown
