"""The states of a scan, from the operator's command to the delivered result (pure).

    armed -> capturing -> accepted -> reconstructing -> delivered | rescan | failed
      |          |
      +----------+-> failed (the person has to stay or come back)

A scan's state follows from what is on disk: the folder that it lies in, then its note. No process
keeps it in memory, so killing one loses nothing. Only the sync process (and, once accepted, the
worker) may declare a scan failed; until then an unknown state is reported as unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from station.core.scans import ScanNote

State = Literal["armed", "capturing", "accepted", "reconstructing", "delivered", "rescan", "failed"]
FINAL: frozenset[State] = frozenset({"delivered", "rescan", "failed"})
ON_DISK: frozenset[State] = frozenset({"accepted", "reconstructing", "delivered", "rescan"})
UNSURE = "outcome not known yet; do not scan again"
MAX_LABEL_LENGTH = 200
"""Characters; a note of a scan is read up to a limit."""


@dataclass(frozen=True, slots=True)
class Session:
    """One scan as the operator sees it."""

    scan_id: str
    label: str
    state: State
    framesets: int = 0
    wanted: int = 0
    reason: str = ""
    path: str = ""
    """Folder of its bundle or result; empty while it is taken, and when it was moved away."""


def state_of(note: ScanNote | None, place: str | None) -> State | None:
    """A scan's state; None if there is no such scan.

    Args:
        note: its note, if there is one.
        place: the spool's folder that it lies in.
    """
    if place == "outbox":
        return "rescan" if note is not None and note.verdict == "rescan" else "delivered"
    if place == "failed":
        return "failed"
    if place == "work":
        return "reconstructing"
    if place == "queue":
        return "accepted"
    if note is None:
        return None
    if note.stage == "delivered":
        return "rescan" if note.verdict == "rescan" else "delivered"
    if note.stage == "delivering":
        return "reconstructing"
    return note.stage


def overdue(note: ScanNote, now_s: float, boot: str) -> bool:
    """Whether an order should have been started by now; only sync decides its outcome."""
    return note.stage == "armed" and (note.boot != boot or now_s > note.valid_until_s)
