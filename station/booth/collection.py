"""One scan while its framesets are collected (pure)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from station.booth.frameset import Frameset
from station.core.rig import Rig
from station.core.scans import ScanId
from station.messaging.intake import LiveFrame

LATE = "the order came too late and was not taken up; scan again"


@dataclass(frozen=True, slots=True)
class Order:
    """A scan that the operator wants."""

    scan_id: ScanId
    label: str
    valid_until_s: float
    """Taken up later it is void: the operator was told that nothing came of it."""

    def late(self, now_s: float) -> bool:
        return now_s > self.valid_until_s


@dataclass(slots=True)
class Collection:
    """A scan being collected."""

    order: Order
    rig: Rig
    wanted: int
    deadline_s: float
    sets: list[Frameset[LiveFrame]] = field(default_factory=list)
    complete_s: float = 0.0
    """Time at which its last frameset came."""

    def add(self, found: Frameset[LiveFrame], now_s: float) -> bool:
        """Take a frameset; True when it was the last one."""
        self.sets.append(found)
        self.complete_s = now_s
        return len(self.sets) >= self.wanted

    def depth_scale_m(self) -> float:
        """Metres per unit of its depth images."""
        return next(iter(self.sets[0].frames.values())).header.depth_scale_m

    def too_few(self, silent: Sequence[str], troubles: Sequence[str], within_s: float) -> str:
        """Why the framesets did not come in time."""
        if troubles:
            return "; ".join(troubles)
        if silent:
            return f"camera {', '.join(silent)} went silent; check its cable and scan again"
        return (
            f"only {len(self.sets)} of {self.wanted} framesets came in {within_s:g} s; "
            "check station status and scan again"
        )
