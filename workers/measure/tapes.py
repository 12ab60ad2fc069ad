"""Tapes around sections of a body, and those of a section's pieces that go around a place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.measure.sections import EdgePoints, Index, encloses, hull_order

Array = NDArray[np.float64]

_MIN_LOOP = 8
"""Points of a section from which a piece may be a loop of skin."""


@dataclass(frozen=True, slots=True)
class Tape:
    """Tape around a section."""

    points: EdgePoints
    places: Array
    """(n, 3)."""
    normal: Array
    """Unit normal of the section's plane."""


def tapes_around(
    found: EdgePoints, places: Array, piece: Index, normal: Array, middle: Array
) -> list[Tape]:
    """Tapes around those pieces of a section that go around a place."""
    tapes = []
    for chosen in (np.flatnonzero(piece == index) for index in np.unique(piece)):
        if len(chosen) < _MIN_LOOP:
            continue
        try:
            tape = chosen[hull_order(places[chosen], normal)]
        except ValueError:
            continue  # all on a line
        if encloses(places[tape], normal, middle):
            tapes.append(Tape(found.take(tape), places[tape], normal))
    return tapes
