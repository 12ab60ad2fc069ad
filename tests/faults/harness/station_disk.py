"""The disk of a running station: errnos, stalls, and a small, full, read-only or slow one."""

from __future__ import annotations

import errno
import itertools
import os
import random
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path

import psutil
from booth import Booth, Scans, running_booth, until
from injection import ERRNOS, Injection
from table import Row

_RETURN_S = 10.0
_ERRNOS_A_LIFE, _SCANS_A_LIFE = 6, 20
_SETTLED_S = 4.0
"""A fault at one call is over by then: the pauses of sync, workers and recovery are shorter."""
_OUTAGE_S = 3.0
_SETTINGS = """
[spool]
min_free_mb = 50
[scan]
framesets = 2
[console]
enabled = false
"""
_STALLS_S = (0.1, 0.5, 2.0, 4.0, 7.0, 10.0)
_TRUE_WORDS = ("disk", "expired", "interrupted", "is being taken")
"""Words on a scan that was refused because a disk stalled; one of them is true."""
_SLOW_BYTES_S = 1_000_000
_SMALL_MB, _LEFT_MB = 400, 70


def errno_rows() -> list[Row]:
    """Each errno at each file call of sync, control and workers; then at all of them for seconds.

    Each of these processes meets several errnos in one life, far apart: the next scan after them
    shows whether the booth is well.
    """
    with (
        tempfile.TemporaryDirectory() as name,
        running_booth(Path(name), job="quick", settings=_SETTINGS) as (booth, scans),
    ):
        calls = {role: _calls_of_a_scan(booth, scans, role) for role in booth.disk}
        longest = max(-(-count // _ERRNOS_A_LIFE) for count in calls.values())
        hits: Counter[str] = Counter()
        backs = []
        for code, at in itertools.product(ERRNOS, range(1, longest + 1)):
            met, back_s = _one_life(booth, scans, calls, code, at)
            hits.update(met)
            backs.append(back_s)
        of = ", ".join(
            f"{role} {hits[role]} of {len(ERRNOS) * count}" for role, count in calls.items()
        )
        missed = [role for role, count in calls.items() if hits[role] < len(ERRNOS) * count]
        rows = [
            Row("each errno at each file call", "all are met", of, not missed),
            _return_row(f"after {sum(hits.values())} errnos in {len(backs)} lives", backs),
        ]
        outages = [_outage(booth, scans, role, code) for role in booth.disk for code in ERRNOS]
        rows.append(_return_row(f"every call fails for {_OUTAGE_S:g} s", outages))
        scans.settle()
        rows.append(_nothing_stuck(booth))
        rows.append(scans.row("scans while errnos are met"))
    return rows


def _calls_of_a_scan(booth: Booth, scans: Scans, role: str) -> int:
    """File calls of a process from an order until the scan is put away."""
    scans.take()
    scans.settle()
    booth.disk[role].arm(booth.folder, "count")
    scans.take()
    scans.settle()
    booth.disk[role].disarm()
    return booth.disk[role].calls


def _one_life(
    booth: Booth, scans: Scans, calls: dict[str, int], code: int, at: int
) -> tuple[dict[str, int], float]:
    """Errnos met by each process, and the seconds from the disk's return to a scan's delivery.

    A process meets them at its at-th call and then always after a share of a scan's calls. A scan
    that they end does not come to all calls: the next one does.
    """
    wanted = {}
    for role, count in calls.items():
        every = -(-count // _ERRNOS_A_LIFE)
        wanted[role] = max(0, -(-(count + 1 - at) // every)) if at <= every else 0
        if wanted[role]:
            booth.disk[role].arm(
                booth.folder, "fail", code, first=at, count=wanted[role], every=every
            )

    def met() -> bool:
        return all(booth.disk[role].hits >= count for role, count in wanted.items())

    for _ in range(_SCANS_A_LIFE):
        scans.take()
        until(lambda: met() or _idle(booth), _SETTLED_S)
        if met():
            break
    for role in wanted:
        booth.disk[role].disarm()
    found = {role: booth.disk[role].hits for role, count in wanted.items() if count}
    return found, _next_delivered_s(scans)


def _outage(booth: Booth, scans: Scans, role: str, code: int) -> float:
    booth.disk[role].arm(booth.folder, "fail", code)
    taking = threading.Thread(target=scans.take)
    taking.start()
    time.sleep(_OUTAGE_S)
    booth.disk[role].disarm()
    back_s = _next_delivered_s(scans, meanwhile=taking)
    taking.join()
    return back_s


def _next_delivered_s(scans: Scans, meanwhile: threading.Thread | None = None) -> float:
    """Seconds until a scan that is ordered from now on is in the fitting room."""
    began_s = time.monotonic()
    if meanwhile is not None:
        meanwhile.join()
    scan_id = scans.take_until_accepted(2 * _RETURN_S)
    if scans.accepted(scan_id):
        until(partial(scans.came, scan_id), 3 * _RETURN_S)
    return time.monotonic() - began_s


def _met(disk: Injection) -> bool:
    return disk.hits > 0


def _idle(booth: Booth) -> bool:
    return not any(any((booth.spool / state).iterdir()) for state in ("queue", "work", "outbox"))


def _return_row(fault: str, back_s: list[float]) -> Row:
    worst = max(back_s, default=float("inf"))
    late = sum(seconds > _RETURN_S for seconds in back_s)
    return Row(
        fault,
        f"the next scan delivered {_RETURN_S:g} s after it",
        f"{len(back_s)} points, {late} late, worst {worst:.1f} s",
        late == 0 and bool(back_s),
    )


def _nothing_stuck(booth: Booth) -> Row:
    until(lambda: not any((booth.spool / "locks").iterdir()), _SETTLED_S)
    stuck = [
        path.name
        for state in ("work", "locks", "queue")
        for path in (booth.spool / state).iterdir()
    ]
    words = f"{len(stuck)} stuck {' '.join(stuck)}"
    return Row("claims after errnos", "0 stuck", words, not stuck)


def stall_rows(points: int, seed: int) -> list[Row]:
    """A stall of up to ten seconds at random calls of sync, control and workers."""
    rng = random.Random(seed)
    with (
        tempfile.TemporaryDirectory() as name,
        running_booth(Path(name), job="quick", settings=_SETTINGS) as (booth, scans),
    ):
        calls = {role: _calls_of_a_scan(booth, scans, role) for role in booth.disk}
        words: Counter[str] = Counter()
        met = 0
        for _ in range(points):
            role = rng.choice(list(booth.disk))
            seconds = rng.choice(_STALLS_S)
            disk = booth.disk[role]
            at = rng.randint(1, calls[role])
            disk.arm(booth.folder, "stall", int(1e3 * seconds), first=at, count=1)
            _, told = scans.told[scans.take()]
            if told:
                words[told.split(": ", 1)[-1]] += 1
            until(partial(_met, disk), 1.0)
            met += disk.hits > 0
            disk.disarm()
            until(lambda: booth.well() and _idle(booth))
        scans.settle()
        row = scans.row(f"stalls of {_STALLS_S[0]:g} to {_STALLS_S[-1]:g} s, {met} calls")
    for told, count in words.most_common():
        print(f"        {count} times: {told}", flush=True)
    untrue = sum(
        count
        for told, count in words.items()
        if "not known yet" not in told and not any(true in told for true in _TRUE_WORDS)
    )
    return [
        row,
        Row(
            "words on scans while a disk stalls",
            "the disk is named, or nothing is claimed",
            f"{sum(words.values())} not accepted, {untrue} told something else",
            untrue == 0,
        ),
    ]


def small_disk_rows() -> list[Row]:
    """A file system of its own for the spool: full, read-only; and a slow one."""
    if os.geteuid() != 0:
        return [Row("disk full, read-only", "refused, well without hands", "needs root", False)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with _mounted(folder / "spool"), running_booth(folder, job="quick") as (booth, scans):
            rows = [
                _refusing(booth, scans, "disk full", "MB free", _filled),
                _refusing(booth, scans, "disk read-only", "disk", _read_only),
                _breaking(booth, scans, "disk full", _full),
                _breaking(booth, scans, "disk read-only", _erofs),
                _slow(booth, scans),
            ]
            scans.settle()
            rows.append(scans.row("scans while disks fail"))
    return rows


@contextmanager
def _mounted(folder: Path) -> Iterator[None]:
    """A file system in memory at a folder."""
    folder.mkdir()
    options = ("-t", "tmpfs", "-o", f"size={_SMALL_MB}m", "tmpfs", str(folder))
    subprocess.run(["mount", *options], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextmanager
def _filled(booth: Booth, left_mb: int = _LEFT_MB) -> Iterator[None]:
    """Fill the spool's disk; a scan needs 50 MB and a bundle's room to be begun."""
    ballast = booth.spool / "tmp" / f"ballast.{os.getpid()}.1"
    with ballast.open("wb", buffering=0) as stream, suppress(OSError):
        while psutil.disk_usage(str(booth.spool)).free > left_mb << 20:
            stream.write(bytes(1 << 18))
    try:
        yield
    finally:
        ballast.unlink()


def _full(booth: Booth) -> AbstractContextManager[None]:
    """Fill it to the last page."""
    return _filled(booth, left_mb=0)


@contextmanager
def _read_only(booth: Booth) -> Iterator[None]:
    """Remount the spool's file system; no file may be open for writing."""
    remount = ["mount", "-o", "remount,{}", str(booth.spool)]
    booth.wait(lambda: _ran(remount, "ro"), "the spool can be read only")
    try:
        yield
    finally:
        _ran(remount, "rw")


def _ran(words: list[str], option: str) -> bool:
    command = [word.format(option) for word in words]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@contextmanager
def _erofs(booth: Booth) -> Iterator[None]:
    """Let every call that changes something fail, also on files that are open."""
    for disk in booth.disk.values():
        disk.arm(booth.spool, "fail", errno.EROFS, changes=True)
    try:
        yield
    finally:
        for disk in booth.disk.values():
            disk.disarm()


Broken = Callable[[Booth], AbstractContextManager[None]]


def _refusing(booth: Booth, scans: Scans, fault: str, words: str, broken: Broken) -> Row:
    """A disk that is broken before the order: nobody may be scanned."""
    scans.settle()
    sets = [booth.report("sync").get("collecting")]
    with broken(booth):
        told = [scans.told[scans.take()] for _ in range(5)]
        sets.append(booth.report("sync").get("collecting"))
    back_s = _next_delivered_s(scans)
    refused = sum(code == 1 and words in said for code, said in told)
    return Row(
        f"{fault} before scans",
        f"refused before; delivered {_RETURN_S:g} s after its return",
        f"{refused} of {len(told)} refused ({told[-1][1][-60:]}), next after {back_s:.1f} s",
        refused == len(told) and sets == [None, None] and back_s <= _RETURN_S,
    )


def _breaking(booth: Booth, scans: Scans, fault: str, broken: Broken) -> Row:
    """A disk that breaks while a scan is taken or reconstructed."""
    backs = []
    for after_s in (0.1, 0.3, 0.5, 0.7, 0.9, 1.2):
        scans.settle()
        taking = threading.Thread(target=scans.take)
        taking.start()
        time.sleep(after_s)
        with broken(booth):
            time.sleep(_OUTAGE_S)
        backs.append(_next_delivered_s(scans, meanwhile=taking))
    return _return_row(f"{fault} within scans", backs)


def _slow(booth: Booth, scans: Scans) -> Row:
    """A disk that writes 1 MB/s."""
    scans.settle()
    for disk in booth.disk.values():
        disk.arm(booth.spool, "slow", _SLOW_BYTES_S, changes=True)
    began_s = time.monotonic()
    told = [scans.told[scans.take()] for _ in range(3)]
    mean_s = (time.monotonic() - began_s) / len(told)
    for disk in booth.disk.values():
        disk.disarm()
    back_s = _next_delivered_s(scans)
    words = "; ".join(sorted({said[-60:] or "accepted" for _, said in told}))
    return Row(
        "disk at 1 MB/s",
        "refused before, or accepted and delivered",
        f"{words} after {mean_s:.1f} s, the next delivered after {back_s:.1f} s",
        back_s <= _RETURN_S,
    )
