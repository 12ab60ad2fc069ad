"""Record of hand-overs, kept on disk so that it survives a restart.

handover/<target>/waiting/<scan id>.json   tries, when next, what went wrong
handover/<target>/done/<scan id>           handed over; kept as long as the result or its note is
"""

from __future__ import annotations

import json
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from station.core.files import fsync_folder, private_file, private_folder, write_json

PAUSES_S = (5.0, 15.0, 60.0, 300.0, 900.0, 3600.0)
"""Pauses after the first, second ... failure; then every hour, without limit."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """One result that one target has not received yet."""

    target: str
    scan_id: str
    tries: int = 0
    """Failures, without those of tries before their time."""
    next_s: float = 0.0
    """Moment of the next try, seconds since 1970; 0: now, before its time if any has failed."""
    error: str = ""

    def due(self, now_s: float) -> bool:
        """Whether it is time for the next try; a wall clock that was put back delays none."""
        return self.next_s <= now_s or not self.next_s <= now_s + PAUSES_S[-1]

    def document(self) -> dict[str, Any]:
        moment = datetime.fromtimestamp(self.next_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        return {"target": self.target, "scan_id": self.scan_id, "tries": self.tries,
                "next_try": moment if self.next_s else "", "error": self.error}  # fmt: skip

    def failed(self, error: str, now_s: float) -> Waiting:
        """The entry after one more failure, with a longer pause."""
        # A try before its time, as an operator asks for it, makes no pause longer.
        counts = self.tries <= 0 or self.next_s != 0.0
        tries = max(self.tries, 0) + counts
        pause_s = PAUSES_S[min(tries, len(PAUSES_S)) - 1]
        return replace(self, tries=tries, next_s=now_s + pause_s, error=error)


class Ledger:
    """The folder `handover` of a spool."""

    def __init__(self, spool_folder: Path) -> None:
        self._folder = spool_folder / "handover"

    def follow(self, target: str, scan_ids: Iterable[str], noted: Iterable[str]) -> list[Waiting]:
        """Add new results; remove, and return, what waits of those that no longer exist.

        ``noted``: scans that are known although their results may have been taken away. Who has
        copies of these is told when they are deleted.
        """
        there = set(scan_ids)
        known = there.union(noted)
        done, waiting = self._place(target, "done"), self._place(target, "waiting")
        for path in done.iterdir():
            if path.name not in known:
                path.unlink(missing_ok=True)
        dropped = []
        for path in waiting.glob("*.json"):
            if path.stem not in there:
                path.unlink(missing_ok=True)
                dropped.append(Waiting(target, path.stem))
        for scan_id in there:
            # In this order: `finish` ends the waiting after it has recorded the hand-over.
            if not (waiting / f"{scan_id}.json").exists() and not (done / scan_id).exists():
                self.keep(Waiting(target, scan_id))
        return dropped

    def keep(self, entry: Waiting) -> None:
        """Save a waiting result."""
        path = self._place(entry.target, "waiting") / f"{entry.scan_id}.json"
        write_json(path, {"tries": entry.tries, "next_s": entry.next_s, "error": entry.error})

    def try_now(self, targets: Container[str]) -> list[Waiting]:
        """Make the next try of all that waits for these targets due; what waits for them."""
        found = [entry for entry in self.waiting() if entry.target in targets]
        due = [replace(entry, next_s=0.0) for entry in found]
        for before, entry in zip(found, due, strict=True):
            # To write one takes milliseconds, and there may be thousands.
            if entry != before:
                self.keep(entry)
        return due

    def finish(self, entry: Waiting) -> None:
        """Mark a result as handed over."""
        done = self._place(entry.target, "done")
        private_file(done / entry.scan_id)
        fsync_folder(done)
        self.drop(entry)

    def drop(self, entry: Waiting) -> None:
        """Wait no longer to hand over a result."""
        waiting = self._place(entry.target, "waiting")
        (waiting / f"{entry.scan_id}.json").unlink(missing_ok=True)

    def prune(self, is_known: Callable[[str], bool]) -> None:
        """Keep nothing of scans that are not known, also of targets that booth.toml named before.

        Each is asked for just before: one that comes meanwhile must not be forgotten.
        """
        for path in [*self._folder.glob("*/done/*"), *self._folder.glob("*/waiting/*.json")]:
            if not is_known(path.name.removesuffix(".json")):
                path.unlink(missing_ok=True)

    def receivers(self, scan_id: str) -> list[str]:
        """Targets that have a copy of a scan's result; also those that booth.toml named before,
        and those that the record names which a restored backup replaced."""
        places = [
            place for folder in (self._folder, *self._replaced()) for place in folder.glob("*/done")
        ]
        return sorted({place.parent.name for place in places if (place / scan_id).exists()})

    def forget(self, scan_id: str, *, replaced: bool = False) -> None:
        """Remove all that is kept of a scan that was deleted.

        Args:
            replaced: also from what a restored backup replaced, where its bundle may still lie.
        """
        folders = (self._folder, *(self._replaced() if replaced else ()))
        for place, name in (("done", scan_id), ("waiting", f"{scan_id}.json")):
            # The name itself is no pattern: any folder may lie in the outbox.
            for folder in [found for kept in folders for found in kept.glob(f"*/{place}")]:
                (folder / name).unlink(missing_ok=True)

    def _replaced(self) -> list[Path]:
        """Earlier records, which `station restore` keeps beside this one."""
        return list(self._folder.parent.glob(f".{self._folder.name}.before-restore*"))

    def waiting(self) -> list[Waiting]:
        """All waiting results of all targets."""
        if not self._folder.is_dir():
            return []
        found = []
        for path in sorted(self._folder.glob("*/waiting/*.json")):
            if (path.parents[1] / "done" / path.stem).exists():
                continue  # the end of a hand-over was cut short
            try:
                document = json.loads(path.read_bytes())
                entry = Waiting(path.parent.parent.name, path.stem, int(document["tries"]),
                                float(document["next_s"]), str(document["error"]))  # fmt: skip
                entry.document()  # its moment may be beyond the calendar
            except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
                entry = Waiting(path.parent.parent.name, path.stem)
            found.append(entry)
        return found

    def _place(self, target: str, name: str) -> Path:
        return private_folder(self._folder / target / name)
