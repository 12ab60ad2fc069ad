"""The spool: where scans wait, are worked on and are delivered. Disk is the truth.

    tmp/       being written
    queue/     accepted scans (bundles)
    work/      claimed by a worker
    outbox/    results, whole or not at all
    failed/    bundles that could not be reconstructed, with reason.json
    done/      bundles of delivered scans, until retention removes them

A worker claims a scan by a file lock and a rename. A dead process drops its lock, and any peer
puts the scan back with one more try. Locks and renames need one local file system.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from station.core.errors import SpoolError
from station.core.files import fsync_folder, private_folder, publish_folder, write_json

STATES = ("queue", "work", "outbox", "failed", "done")
REASON = "reason.json"
_BUNDLE_BYTES = 40 << 20
"""More than forty depth frames take."""
_LEFTOVER_AGE_S = 600.0


def count_scans(folder: Path) -> dict[str, int]:
    """State -> how many scans of a spool are in it; touches nothing.

    Raises:
        OSError: the spool is another user's.
    """
    found = {state: folder / state for state in STATES if (folder / state).is_dir()}
    counts = {state: len(list(place.iterdir())) for state, place in found.items()}
    return {state: count for state, count in counts.items() if count}


class Spool:
    """The folders of one spool."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("tmp", "locks", *STATES):
            private_folder(folder / name)

    def path(self, state: str, scan_id: str) -> Path:
        return self.folder / state / scan_id

    def temporary(self, name: str) -> Path:
        """A new name in the spool's own file system; the caller makes the folder."""
        return self.folder / "tmp" / f"{name}.{os.getpid()}.{time.monotonic_ns()}"

    def check_space(self, min_free_mb: float) -> None:
        """Refuse a scan before it is taken, rather than lose it after.

        Raises:
            SpoolError: naming the folder and the space that is missing.
        """
        free = shutil.disk_usage(self.folder).free
        needed = min_free_mb * 1e6 + _BUNDLE_BYTES
        if free < needed:
            raise SpoolError(
                f"{self.folder} has {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB are needed "
                "(spool.min_free_mb); free some space or purge old scans"
            )

    def where(self, scan_id: str) -> str | None:
        """The state of a scan, or None if it is unknown.

        Folders are looked through in the order in which a scan passes them, and once more: a scan
        that is being renamed is in one of them at any moment, but not always in the one looked at.
        """
        for _ in range(2):
            for state in ("outbox", "failed", "work", "queue"):
                if self.path(state, scan_id).exists():
                    return state
        return None

    def submit(self, temporary: Path, scan_id: str) -> None:
        """Accept a finished bundle: from here on nothing short of losing the disk loses it.

        The same scan twice is one scan.
        """
        if self.where(scan_id) is not None:
            shutil.rmtree(temporary, ignore_errors=True)
            return
        publish_folder(temporary, self.path("queue", scan_id))

    def waiting(self) -> list[str]:
        """Scan ids in the queue, oldest first."""
        return sorted(entry.name for entry in (self.folder / "queue").iterdir() if entry.is_dir())

    def claim(self) -> Claim | None:
        """Take the oldest waiting scan that nobody else takes."""
        for scan_id in self.waiting():
            lock = self._lock(scan_id)
            if lock is None:
                continue
            try:
                os.rename(self.path("queue", scan_id), self.path("work", scan_id))
            except FileNotFoundError:
                os.close(lock)
                continue
            return Claim(self, scan_id, lock, self._count_try(scan_id))
        return None

    def withdraw(self, scan_id: str, reason: str) -> bool:
        """Take a waiting scan off the queue into failed/; False if it does not wait (any more)."""
        lock = self._lock(scan_id)
        if lock is None:
            return False
        try:
            os.rename(self.path("queue", scan_id), self.path("work", scan_id))
        except FileNotFoundError:
            os.close(lock)
            return False
        Claim(self, scan_id, lock, self._tries(scan_id)).fail(reason)
        return True

    def recover(self, retries: int) -> list[str]:
        """Put back the scans of workers that died; fail those that were tried too often.

        Also finishes deliveries that a crash cut short. Returns the ids that were put back.
        """
        back = []
        for entry in sorted((self.folder / "work").iterdir()):
            scan_id = entry.name
            lock = self._lock(scan_id)
            if lock is None:
                continue
            claim = Claim(self, scan_id, lock, self._tries(scan_id))
            if self.path("outbox", scan_id).exists():
                claim.finish("done")
            elif claim.tries > retries:
                claim.fail(f"the worker died {claim.tries} times on this scan")
            else:
                claim.put_back()
                back.append(scan_id)
        return back

    def sweep(self) -> None:
        """Remove what crashed writers left behind."""
        for entry in (self.folder / "tmp").iterdir():
            if time.time() - entry.stat().st_mtime > _LEFTOVER_AGE_S:
                shutil.rmtree(entry, ignore_errors=True)

    def every(self) -> Iterator[tuple[str, Path]]:
        """All scans: (state, folder)."""
        for state in STATES:
            for entry in sorted((self.folder / state).iterdir()):
                yield state, entry

    def _lock(self, scan_id: str) -> int | None:
        """The scan's lock, or None while a living process holds it."""
        path = self.folder / "locks" / f"{scan_id}.lock"
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            return None
        return descriptor

    def _tries_path(self, scan_id: str) -> Path:
        return self.folder / "locks" / f"{scan_id}.tries.json"

    def _tries(self, scan_id: str) -> int:
        try:
            return int(json.loads(self._tries_path(scan_id).read_text())["tries"])
        except (OSError, ValueError, KeyError):
            return 0

    def _count_try(self, scan_id: str) -> int:
        tries = self._tries(scan_id) + 1
        write_json(self._tries_path(scan_id), {"tries": tries})
        return tries


@dataclass(frozen=True, slots=True)
class Claim:
    """A scan that this process, and no other, works on."""

    spool: Spool
    scan_id: str
    lock: int
    tries: int

    @property
    def bundle(self) -> Path:
        return self.spool.path("work", self.scan_id)

    def deliver(self, result: Path) -> None:
        """Publish a result exactly once, then put the bundle away."""
        final = self.spool.path("outbox", self.scan_id)
        if final.exists():
            shutil.rmtree(result, ignore_errors=True)
        else:
            publish_folder(result, final)
        self.finish("done")

    def fail(self, reason: str) -> None:
        """Give up: the bundle is kept in failed/ with the reason."""
        write_json(self.bundle / REASON, {"reason": reason, "tries": self.tries})
        self.finish("failed")

    def put_back(self) -> None:
        """Let anybody try again."""
        self._move("queue")

    def finish(self, state: str) -> None:
        """Put the bundle away and forget its tries."""
        self._move(state)
        self.spool._tries_path(self.scan_id).unlink(missing_ok=True)

    def _move(self, state: str) -> None:
        target = self.spool.path(state, self.scan_id)
        if target.exists():
            shutil.rmtree(target)
        os.rename(self.bundle, target)
        fsync_folder(target.parent)
        os.close(self.lock)
