"""Work on the scans of a spool: claims, deliveries, recovery after a worker died.

A worker claims a scan by a file lock and a rename from `queue/` into `work/`. The lock of a dead
process is released, and any other worker puts the scan back. Locks and renames need one local file
system. The folders are described in `station.core.scans`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from station.core.errors import SpoolError
from station.core.files import (
    delete,
    entries_of,
    fsync_folder,
    open_private,
    private_folder,
    publish_folder,
    write_json,
)
from station.core.scans import (
    REASON,
    STATES,
    ScanFolders,
    ScanId,
    ScanNote,
    Stage,
    boot_id,
    is_scan_id,
    sweep_unwritten,
    writer_lives,
)

MAX_DEATHS = 10
"""Ends of the station, unlike those of a job, do not count as tries of a scan; a scan during which
the station ends this often is given up."""
_IN_EACH = ("bundle.json", "result.json")
"""Every bundle, and every result, has one of these."""
_LOG = logging.getLogger("spool")


class Spool(ScanFolders):
    """One spool, whose scans are claimed, delivered and recovered."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        private_folder(folder / "locks")
        self.released: set[ScanId] = set()
        """Claims that this process dropped: their worker did not die."""

    def claim(self) -> Claim | None:
        """Claim the oldest waiting scan.

        Raises:
            OSError: the disk prevents every waiting scan from being claimed.
        """
        problem: OSError | None = None
        for scan_id in self.waiting():
            try:
                claim = self._claim(scan_id)
            except OSError as error:
                problem = error
                continue
            if claim is not None:
                return claim
        if problem is not None:
            raise problem
        return None

    def _claim(self, scan_id: ScanId) -> Claim | None:
        lock = self.lock(scan_id)
        if lock is None:
            return None
        with contextlib.ExitStack() as undo:
            undo.callback(self.unlock, scan_id, lock)
            if self.path("work", scan_id).exists():
                # The same scan once more, while a dead worker's waits to be put back: one is kept.
                self.remove(self.path("queue", scan_id))
                return None
            note = self.note(scan_id)
            try:
                os.rename(self.path("queue", scan_id), self.path("work", scan_id))
            except FileNotFoundError:
                return None
            undo.pop_all()
            return Claim(self, scan_id, lock, note)

    def withdraw(self, scan_id: str, reason: str) -> bool:
        """Take a waiting scan off the queue into failed/; False if it is not waiting."""
        if not is_scan_id(scan_id) or not self.path("queue", scan_id).exists():
            return False
        claim = self._claim(ScanId(scan_id))
        if claim is None:
            return False
        try:
            claim.fail(reason)
        finally:
            claim.close()
        return True

    def retry(self, scan_id: ScanId) -> None:
        """Put a failed scan back into the queue and reset its tries.

        Raises:
            SpoolError: it is not in failed/.
        """
        bundle = self.path("failed", scan_id)
        absent = SpoolError(
            f"scan {scan_id} is not among the failed scans in {bundle.parent}; see station list"
        )
        if not bundle.is_dir():
            raise absent
        lock = self.lock(scan_id)
        if lock is None:
            raise SpoolError(f"scan {scan_id} is in use at the moment; try again")
        try:
            fresh = ScanNote(scan_id, "accepted", label=self.note(scan_id).label)
            self.notes.write(fresh, durable=True)
            (bundle / REASON).unlink(missing_ok=True)
            os.rename(bundle, self.path("queue", scan_id))
            fsync_folder(self.folder / "queue")
        except FileNotFoundError:
            # It was past its time, or deleted, just now.
            self.notes.remove(scan_id)
            raise absent from None
        finally:
            self.unlock(scan_id, lock)

    def recover(self, retries: int) -> list[ScanId]:
        """Put back the scans of workers that died; fail those that were tried too often.

        Also finishes deliveries that a crash cut short. Returns the ids that were put back. A scan
        that cannot be moved is left for the next call.
        """
        back = []
        for scan_id in self.scans_in("work"):
            try:
                if self._recover(scan_id, retries):
                    back.append(scan_id)
            except OSError as error:
                _LOG.warning("scan %s waits for the disk: %s", scan_id, error)
        self._remove_idle_locks()
        return back

    def _recover(self, scan_id: ScanId, retries: int) -> bool:
        lock = self.lock(scan_id)
        if lock is None:
            return False
        with contextlib.ExitStack() as undo:
            undo.callback(self.unlock, scan_id, lock)
            claim = Claim(self, scan_id, lock, self.note(scan_id))
            undo.pop_all()
        try:
            return self._settle(claim, retries)
        finally:
            claim.close()

    def _remove_idle_locks(self) -> None:
        """Remove lock files that a refusing disk left behind: they bear the names of scans."""
        for path in entries_of(self.folder / "locks"):
            if not is_scan_id(path.stem) or self.path("work", path.stem).exists():
                continue
            if (lock := self.lock(ScanId(path.stem))) is not None:
                self.unlock(ScanId(path.stem), lock)

    def _settle(self, claim: Claim, retries: int) -> bool:
        """End an abandoned claim; True if the scan was put back."""
        note = claim.note
        result = self.folder / "tmp" / note.result
        if note.stage == "delivered" or self.path("outbox", claim.scan_id).exists():
            claim.delivered()
        elif note.stage == "delivering" and note.boot == boot_id():
            if result.is_dir():
                claim.deliver(result, note.verdict, note.reason)
            else:
                # It got its name before the crash, and was taken from the outbox since.
                claim.delivered()
        elif note.stage == "failed":
            claim.fail(note.reason)
        elif note.tries > retries:
            claim.fail(f"{note.tries} reconstructions failed; the last one: {note.reason}")
        elif note.deaths >= MAX_DEATHS and claim.scan_id not in self.released:
            claim.fail(f"the station ended {note.deaths + 1} times while it worked on this scan")
        else:
            if claim.scan_id not in self.released:
                claim.count_death()
            claim.put_back()
            self.released.discard(claim.scan_id)
            return True
        return False

    def sweep(self) -> None:
        """Remove leftovers of dead writers, except those that a delivery still needs."""
        needed = {note.result for scan_id in self.scans_in("work") if (note := self.note(scan_id))}
        for entry in (self.folder / "tmp").iterdir():
            if entry.name in needed or writer_lives(entry.name):
                continue
            # As much of a folder as the disk lets go.
            shutil.rmtree(entry, ignore_errors=True)
            with contextlib.suppress(OSError):
                delete(entry)
        self.notes.sweep()
        # Names of scans, and of whom they were handed over to.
        for folder in (self.folder, *self.folder.glob("handover/*/waiting")):
            sweep_unwritten(folder)

    def lock(self, scan_id: ScanId, *, to_delete: bool = False) -> int | None:
        """The scan's lock, or None while a living process holds it.

        Args:
            to_delete: where no further file can be made, a file of the scan is its lock.
        """
        path = self.folder / "locks" / f"{scan_id}.lock"
        while True:
            try:
                descriptor = open_private(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW)
            except OSError as error:
                full = error.errno in (errno.ENOSPC, errno.EDQUOT)
                if not (to_delete and full and self._link(scan_id, path)):
                    raise
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Its previous holder removes the file: a lock on a removed file locks nothing.
                if os.stat(path).st_ino == os.fstat(descriptor).st_ino:
                    return descriptor
            except BlockingIOError:
                os.close(descriptor)
                return None
            except FileNotFoundError:
                # Its holder removed the file between the two calls: try again with a new file.
                pass
            except OSError:
                os.close(descriptor)
                raise
            os.close(descriptor)

    def _link(self, scan_id: ScanId, lock: Path) -> bool:
        """Give a file of the scan a second name, for which a full disk has room: its lock's."""
        files = (self.path(state, scan_id) / name for state in STATES for name in _IN_EACH)
        for path in (self.notes.path(scan_id), *files):
            try:
                os.link(path, lock, follow_symlinks=False)
                return True
            except FileExistsError:
                return True
            except OSError:
                continue
        return False

    def unlock(self, scan_id: ScanId, lock: int) -> None:
        """Release a scan's lock and remove its file, so that no name outlives its scan."""
        with contextlib.suppress(OSError):
            (self.folder / "locks" / f"{scan_id}.lock").unlink()
        os.close(lock)


class Claim:
    """A scan that only this process works on."""

    def __init__(self, spool: Spool, scan_id: ScanId, lock: int, note: ScanNote) -> None:
        self.spool, self.scan_id, self.note = spool, scan_id, note
        self._lock: int | None = lock

    @property
    def bundle(self) -> Path:
        return self.spool.path("work", self.scan_id)

    @property
    def tries(self) -> int:
        """Number of failed reconstructions so far."""
        return self.note.tries

    def deliver(self, result: Path, verdict: str = "ok", reason: str = "") -> None:
        """Publish a result exactly once, then put the bundle away.

        Args:
            result: a finished folder under the spool's `tmp/`.
            verdict, reason: what it says: "ok", or "rescan" and why.

        Raises:
            OSError: the disk refused; release the claim, and `Spool.recover` goes on from here.
        """
        final = self.spool.path("outbox", self.scan_id)
        if final.exists():
            shutil.rmtree(result, ignore_errors=True)
        else:
            self._write("delivering", result=result.name, verdict=verdict, reason=reason)
            publish_folder(result, final)
        self.delivered()

    def delivered(self) -> None:
        """Put the bundle of a delivered scan away."""
        self._write("delivered", result="")
        self._move("done")

    def count_try(self, reason: str) -> None:
        """Record a reconstruction that failed on its own."""
        self.note = replace(self.note, tries=self.note.tries + 1, reason=reason)
        self.spool.notes.write(self.note, durable=False)

    def count_death(self) -> None:
        """Record that the worker's process ended while it worked on this scan."""
        self.note = replace(self.note, deaths=self.note.deaths + 1)
        self.spool.notes.write(self.note, durable=False)

    def fail(self, reason: str) -> None:
        """Give up: the bundle is kept in failed/ with the reason."""
        write_json(self.bundle / REASON, {"reason": reason, "tries": self.note.tries})
        self._write("failed", reason=reason, result="")
        self._move("failed")

    def put_back(self) -> None:
        """Return the scan to the queue."""
        self._move("queue")

    def close(self) -> None:
        """Drop the lock, if it is still held."""
        if self._lock is not None:
            self.spool.unlock(self.scan_id, self._lock)
            self._lock = None

    def release(self) -> None:
        """Give up the claim; `Spool.recover` takes care of the scan."""
        if self._lock is not None:
            self.spool.released.add(self.scan_id)
            self.close()

    def _write(self, stage: Stage, **changes: str) -> None:
        changed: Callable[..., ScanNote] = replace
        self.note = changed(self.note, stage=stage, boot=boot_id(), **changes)
        self.spool.notes.write(self.note, durable=True)

    def _move(self, state: str) -> None:
        target = self.spool.path(state, self.scan_id)
        if target.exists():
            self.spool.remove(target)
        os.rename(self.bundle, target)
        fsync_folder(target.parent)
        self.close()
