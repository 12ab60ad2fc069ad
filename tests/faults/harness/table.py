"""Rows of the table: what was injected, what must hold, what was seen."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One demand."""

    fault: str
    demand: str
    seen: str
    met: bool
    timed: bool = False
    """A limit in seconds: a busy machine misses it, so only the long form ends with 1."""

    def __str__(self) -> str:
        return (
            f"{'met   ' if self.met else 'MISSED'}  {self.fault:<44} {self.demand:<44} {self.seen}"
        )


def percentile(values: list[float], share: float) -> float:
    """The value below which a share of the values lies; NaN of none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")
