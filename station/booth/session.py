"""The states of a scan, from the operator's word to the fitting room.

    armed -> capturing -> accepted -> reconstructing -> delivered | rescan | failed
      |          |
      +----------+-> failed (the person has to stay or come back)

Once accepted a scan never goes back: its bundle is on disk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

State = Literal["armed", "capturing", "accepted", "reconstructing", "delivered", "rescan", "failed"]
FINAL: frozenset[State] = frozenset({"delivered", "rescan", "failed"})
ON_DISK: frozenset[State] = frozenset({"accepted", "reconstructing", "delivered", "rescan"})
CANCELLED = "cancelled by the operator"
"""The reason of a scan that failed because it was given up."""
_ORDER: dict[State, int] = {
    "armed": 0, "capturing": 1, "accepted": 2, "reconstructing": 3,
    "delivered": 4, "rescan": 4, "failed": 4,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Session:
    """One scan as the operator sees it."""

    scan_id: str
    label: str
    armed_s: float
    """Host's monotonic time."""
    state: State = "armed"
    framesets: int = 0
    wanted: int = 0
    reason: str = ""


def advance(
    session: Session, state: State, *, framesets: int = 0, wanted: int = 0, reason: str = ""
) -> Session:
    """The session after an event; what is late, repeated or impossible changes nothing."""
    if session.state in FINAL or _ORDER[state] < _ORDER[session.state]:
        return session
    return replace(
        session,
        state=state,
        framesets=max(framesets, session.framesets),
        wanted=max(wanted, session.wanted),
        reason=reason or session.reason,
    )


def expire(session: Session, now_s: float, limit_s: float) -> Session:
    """A scan that was not accepted in time has failed: nobody is collecting it any more."""
    if session.state in ("armed", "capturing") and now_s - session.armed_s > limit_s:
        return advance(
            session, "failed", reason="the sync process ended during the scan; scan again"
        )
    return session
