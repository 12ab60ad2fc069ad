"""Room for limbs: no person stands with an arm in the trunk, and no camera would see it there."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from workers.scape.model.deformation import Faces
from workers.scape.surface.intersections import self_intersections

Array = NDArray[np.float64]

TOUCHING = 40
"""Crossings of the database's triangles that armpits and toes have in any pose."""


def has_room(neutral: Array, posed: Array, faces: Faces, touching: int = TOUCHING) -> bool:
    """Whether no limb of a body (P, 3) is in its trunk or in another limb in a pose."""
    return self_intersections(posed, faces) <= _most(neutral, faces, touching)


def first_with_room(
    neutral: Array, poses: Iterable[Array], faces: Faces, touching: int = TOUCHING
) -> Array:
    """The first of a body's poses, (P, 3) each, that it has room for.

    Raises:
        RuntimeError: there is none.
    """
    most = _most(neutral, faces, touching)
    for posed in poses:
        if self_intersections(posed, faces) <= most:
            return posed
    raise RuntimeError("every pose has a limb in the body")


def _most(neutral: Array, faces: Faces, touching: int) -> int:
    """Crossings at most, of a body that has room."""
    return self_intersections(neutral, faces) + touching
