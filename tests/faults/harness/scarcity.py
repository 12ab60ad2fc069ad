"""Scarcity: no room in /tmp, a shop that takes no results, no memory.

Five hundred results wait for a target that refuses them; a job is ended for want of memory while
it works.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
from booth import Booth, Scans, running_booth, until, whole_booth
from table import Row

from station.core.files import private_folder
from station.core.words.tables import FILES

_WAITING = 500
_ANSWER_S, _SHARE = 1.0, 0.5
"""Limits of the console's answers, and of the processor time of a process that waits."""
_WATCHED_S, _HANDED_S = 10.0, 180.0
_JOB_MB = 300
"""Less than a job needs."""
_CGROUPS = Path("/sys/fs/cgroup/memory")


def scarcity_rows() -> list[Row]:
    """A full /tmp, many results that wait, no memory; the first and the last need root."""
    return [_full_tmp(), *_many_waiting(), *_no_memory()]


def _full_tmp() -> Row:
    with tempfile.TemporaryDirectory() as name:
        folder, tmp = Path(name), Path(name) / "tmp"
        (folder / "booth").mkdir()
        with (
            _full(tmp),
            running_booth(folder / "booth", tmp=tmp) as (booth, scans),
        ):
            problems = booth.problems()
            for _ in range(2):
                scans.take()
                scans.settle()
            row = scans.row("scans while the folder of temporary files is full")
    return Row(row.fault, row.demand, f"{row.seen}; {problems}", row.met and not problems)


@contextmanager
def _full(folder: Path) -> Iterator[None]:
    """A file system of its own at a folder, filled to the last page."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], check=True)
    try:
        with (folder / "ballast").open("wb", buffering=0) as stream, suppress(OSError):
            while True:
                stream.write(bytes(1 << 12))
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def _many_waiting() -> list[Row]:
    """Results that the other program's folder refuses, each, and then takes."""
    with (
        tempfile.TemporaryDirectory() as name,
        whole_booth(Path(name), job="quick") as (booth, scans),
    ):
        handed = booth.folder / "handed"
        ids = [f"w-{number:04}" for number in range(_WAITING)]
        for scan_id in ids:
            (handed / f".{scan_id}.part").write_text("in the way")
            _write_result(booth, scan_id)
        told = until(lambda: _waiting(booth) >= _WAITING)
        time.sleep(_WATCHED_S / 2)
        shares = _shares(booth)
        answer_s = max(_answer_s(booth) for _ in range(5))
        accepted = scans.accepted(scans.take())
        for scan_id in ids:
            (handed / f".{scan_id}.part").unlink()
        began_s = time.monotonic()
        until(lambda: all((handed / scan_id).is_dir() for scan_id in ids), _HANDED_S)
        there = sum((handed / scan_id).is_dir() for scan_id in ids)
        handed_s = time.monotonic() - began_s
        until(lambda: set(ids) <= scans.delivered().keys())
        doubled = sum(count > 1 for count in scans.delivered().values())
        problems = booth.problems()
    worst = max(shares, key=lambda process: shares[process])
    return [
        Row(
            f"{_WAITING} results that a target refuses",
            f"the console answers in {_ANSWER_S:g} s, scans are taken",
            f"counted after {told:.1f} s, answers {answer_s:.2f} s, {worst} takes "
            f"{shares[worst]:.0%} of a core, scan accepted: {accepted}",
            answer_s <= _ANSWER_S and shares["deliver"] <= _SHARE and accepted,
            timed=True,
        ),
        Row(
            f"{_WAITING} results that it takes again",
            "each once",
            f"{there} there {handed_s:.0f} s after, {doubled} twice; {problems}",
            there == _WAITING and not doubled,
        ),
    ]


def _write_result(booth: Booth, scan_id: str) -> None:
    result = private_folder(booth.spool / "tmp" / f"{scan_id}.{os.getpid()}.1")
    (result / "result.json").write_text(json.dumps({"scan_id": scan_id, "status": "ok"}))
    for pose, name in FILES.items():
        table = {"format": "booth-measurements", "version": 1, "pose": pose, "measurements": []}
        (result / name).write_text(json.dumps(table))
    result.rename(booth.spool / "outbox" / scan_id)


def _waiting(booth: Booth) -> int:
    return int(booth.report("deliver").get("waiting", {}).get("shop", 0))


def _shares(booth: Booth) -> dict[str, float]:
    """Share of a core that each process takes, while nothing is done."""
    names = ("deliver", "console", "control")
    running = {name: psutil.Process(booth.pids(name)[0]) for name in names}
    before = {name: sum(process.cpu_times()[:2]) for name, process in running.items()}
    time.sleep(_WATCHED_S)
    return {
        name: (sum(process.cpu_times()[:2]) - before[name]) / _WATCHED_S
        for name, process in running.items()
    }


def _answer_s(booth: Booth) -> float:
    began_s = time.monotonic()
    url = f"http://127.0.0.1:{booth.config.console.port}/api/v1/scans"
    with urllib.request.urlopen(url, timeout=30.0) as answer:
        answer.read()
    return time.monotonic() - began_s


def _no_memory() -> list[Row]:
    """Jobs that the kernel ends for want of memory, until there is some again."""
    group = _CGROUPS / f"booth-{os.getpid()}"
    with tempfile.TemporaryDirectory() as name, running_booth(Path(name)) as (booth, scans):
        try:
            group.mkdir()
        except OSError as cause:
            return [Row("jobs without memory", "delivered once", f"not tried: {cause}", False)]
        try:
            return [_starved(booth, scans, group)]
        finally:
            for pid in (group / "cgroup.procs").read_text().split():
                (_CGROUPS / "cgroup.procs").write_text(pid)
            group.rmdir()


def _starved(booth: Booth, scans: Scans, group: Path) -> Row:
    (group / "memory.limit_in_bytes").write_text(str(_JOB_MB << 20))
    for pid in (*booth.pids("workers"), *booth.pids("job")):
        with suppress(ProcessLookupError):
            (group / "cgroup.procs").write_text(str(pid))
    scan_id = scans.take_until_accepted()
    note = booth.spool / "scans" / f"{scan_id}.json"
    until(lambda: json.loads(note.read_text())["deaths"] > 1)
    (group / "memory.limit_in_bytes").write_text("-1")
    scans.settle()
    told = json.loads(note.read_text())
    return Row(
        f"jobs that {_JOB_MB} MB are too few for, ended by the kernel",
        "delivered once when there is memory",
        f"ended {told['deaths']} times, came {scans.delivered()[scan_id]} times",
        told["deaths"] > 0 and scans.delivered()[scan_id] == 1,
    )
