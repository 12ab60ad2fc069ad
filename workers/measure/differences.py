"""Differences between the left and the right side of a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workers.measure.body import Measurement

_LEFT, _RIGHT = "_left", "_right"


@dataclass(frozen=True, slots=True)
class SideDifference:
    """The difference of a measurement between left and right."""

    name: str
    """Name of both rows without the side."""
    value_m: float
    interval95_m: tuple[float, float]


def side_differences(rows: Sequence[Measurement]) -> tuple[SideDifference, ...]:
    """Left minus right for all rows that are there for both sides, in their order.

    The interval adds both rows' half widths in squares, as for independent errors. Errors that both
    sides share cancel in the difference, so the interval is rather too wide than too narrow.
    """
    by_name = {row.name: row for row in rows}
    found = []
    for left in rows:
        stem = left.name.removesuffix(_LEFT)
        right = by_name.get(f"{stem}{_RIGHT}")
        if right is None or stem == left.name:
            continue
        value = left.value_m - right.value_m
        (low, high), (other_low, other_high) = left.interval95_m, right.interval95_m
        below = np.hypot(left.value_m - low, other_high - right.value_m)
        above = np.hypot(high - left.value_m, right.value_m - other_low)
        found.append(SideDifference(stem, value, (float(value - below), float(value + above))))
    return tuple(found)
