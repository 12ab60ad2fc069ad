"""The floor at z = 0, which the calibration knows and on which no camera sees the soles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workers.scape.evidence.rows import Rows, Skin
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_FLOOR_SIGMA_M = 0.004
"""Standard deviation of a sole's height above the calibrated floor."""
_ROW_SHARE = 0.02
"""Weight of one row: the vertices of a sole share one error, so they do not count separately."""
_SOLE_BAND_M = 0.003
"""Height above a foot's lowest vertex within which the sole touches the floor."""
_FACING_DOWN = -0.8
"""Largest z component of a sole's normal."""
_STRETCHED_M = 0.03
"""Height below which a foot is stretched until it stands: about the height of the sole's edge."""
_LIFTED_M = 0.02
"""Height of a foot's lowest vertex beyond which the foot is taken to be lifted."""


def floor_rows(model: BodyModel, skin: Skin, tolerance_m: float) -> Rows:
    """Rows that place the soles on z = 0, and lift whatever lies below the floor.

    Args:
        tolerance_m: a foot whose lowest point is farther than this from the floor gets no rows, nor
            does one that is clearly lifted.
    """
    height = skin.positions[:, 2]
    touching = height < 0.0
    for foot in _feet(model, skin.part):
        low = float(height[foot].min())
        if abs(low) < min(tolerance_m, _LIFTED_M):
            touching |= foot & (height < low + _SOLE_BAND_M) & (skin.normals[:, 2] < _FACING_DOWN)
    found = np.flatnonzero(touching)
    return Rows(
        found,
        np.tile((0.0, 0.0, 1.0), (len(found), 1)),
        -height[found],
        _ROW_SHARE / _FLOOR_SIGMA_M**2 * skin.share[found],
    )


def stand_on_floor(model: BodyModel, vertices: Array) -> Array:
    """Vertices (P, 3) with the lowest centimetres of both feet stretched or squeezed to z = 0.

    A foot that is clearly lifted stays where it is.
    """
    standing = vertices.copy()
    for foot in _feet(model, model.part_of_vertex):
        low = float(vertices[foot, 2].min())
        if abs(low) > _LIFTED_M:
            continue
        near = foot & (vertices[:, 2] < _STRETCHED_M)
        standing[near, 2] = (vertices[near, 2] - low) * _STRETCHED_M / (_STRETCHED_M - low)
    return standing


def _feet(model: BodyModel, part: NDArray[np.int32]) -> tuple[NDArray[np.bool_], ...]:
    """Masks of both feet, given the part of each place."""
    return tuple(part == model.part_names.index(f"foot_{side}") for side in ("left", "right"))
