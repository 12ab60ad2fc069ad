"""A scan's way through the spool, cut at every call that changes the disk.

Each run is a process of its own, forked from a warm one, that ends (or meets an errno) at its n-th
call of open, write, fsync, rename, mkdir or unlink. A new process goes on from what is on disk.
"""

from __future__ import annotations

import builtins
import errno
import os
import shutil
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from table import Row

from station.core.scans import ScanId, ScanNote
from station.core.spool import Spool

_CALLS = ("open", "write", "fsync", "rename", "replace", "mkdir", "unlink", "rmdir", "ftruncate")
_ERRORS = (errno.EIO, errno.ENOSPC, errno.EROFS, errno.EPERM, errno.EMFILE)
_ID = ScanId("20260101T000000Z-0001")


def _inject(at: int, act: Callable[[], None]) -> Callable[[], int]:
    """Call `act` before the at-th changing call; returns how many calls there were so far."""
    count = 0

    def counted(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal count
            count += 1
            if count == at:
                act()
            return real(*args, **kwargs)

        return call

    for name in _CALLS:
        setattr(os, name, counted(getattr(os, name)))
    builtins.open = counted(builtins.open)
    import io

    io.open = builtins.open
    return lambda: count


def _live(folder: Path, *, retries: int = 2) -> None:
    """A scan's whole life: order, bundle, claim, result, moved away."""
    spool = Spool(folder)
    if spool.notes.read(_ID) is None and spool.where(_ID) is None:
        spool.notes.write(ScanNote(_ID, "capturing"), durable=False)
    if spool.where(_ID) is None and spool.note(_ID).stage == "capturing":
        bundle = spool.temporary(_ID)
        bundle.mkdir()
        for index in range(3):
            (bundle / f"{index}.png").write_bytes(b"frame" * 100)
        (bundle / "bundle.json").write_text("whole")
        spool.submit(bundle, _ID)
    spool.recover(retries)
    while (claim := spool.claim()) is not None:
        result = spool.temporary(_ID)
        result.mkdir()
        for name in ("mesh.ply", "result.json"):
            (result / name).write_text("whole" * 50)
        try:
            claim.deliver(result, "ok")
        except OSError:
            claim.release()
            raise


def _take(folder: Path) -> int:
    """The fitting room: results that it finds in the outbox, moved away; torn ones count 100."""
    taken = 0
    room = folder.parent / "room"
    room.mkdir(exist_ok=True)
    for result in (folder / "outbox").glob("*"):
        whole = {p.name: p.read_text() for p in result.iterdir()}
        taken += 1 if len(whole) == 2 and all(t == "whole" * 50 for t in whole.values()) else 100
        shutil.move(result, room / f"{result.name}.{len(list(room.iterdir()))}")
    return taken


def _child(folder: Path, at: int, act: Callable[[], None]) -> tuple[bool, int]:
    """Live a scan in a process with a fault; whether it got through, and its number of calls."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        report = os.write
        calls = _inject(at, act)
        code = 1
        try:
            _live(folder)
            code = 0
        except OSError:
            pass
        finally:
            report(writing, str(calls()).encode())
            os._exit(code)
    os.close(writing)
    _, status = os.waitpid(pid, 0)
    with os.fdopen(reading) as said:
        text = said.read()
    return status == 0, int(text or 0)


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _raise(code: int) -> Callable[[], None]:
    def act() -> None:
        raise OSError(code, os.strerror(code))

    return act


def _one(at: int, act: Callable[[], None], moved_between: bool) -> tuple[int, bool, int]:
    """Results that were delivered in all, whether one try was enough, and the calls there were."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "spool"
        Spool(folder)
        through, calls = _child(folder, at, act)
        delivered = _take(folder) if moved_between else 0
        for _ in range(3):
            _child(folder, 0, _die)
        return delivered + _take(folder), through, calls


def disk_rows(every: int) -> list[Row]:
    """Cut a scan's life at every n-th changing call, by SIGKILL and by each errno."""
    _, _, calls = _one(0, _die, False)
    killed = wrong = 0
    for moved_between in (False, True):
        for at in range(1, calls + 1, every):
            delivered, _, _ = _one(at, _die, moved_between)
            killed += 1
            wrong += delivered != 1
    rows = [
        Row(
            "kill at a write, fsync, rename of the spool",
            "0 torn, lost, doubled",
            f"{killed} points of {2 * calls}, {wrong} wrong",
            wrong == 0,
        )
    ]
    failed = wrong = 0
    for code in _ERRORS:
        for at in range(1, calls + 1, every):
            delivered, _, _ = _one(at, _raise(code), True)
            failed += 1
            wrong += delivered != 1
    names = ", ".join(errno.errorcode[code] for code in _ERRORS)
    rows.append(
        Row(
            "an errno at a file call of the spool",
            "the scan delivered once all the same",
            f"{failed} points ({names}), {wrong} wrong",
            wrong == 0,
        )
    )
    return rows
