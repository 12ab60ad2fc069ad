"""What pulls the body: distances along a direction at a vertex, and their sums at the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.scape.evidence.crown import Reach
from workers.scape.evidence.free_space import FreeSpace
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_FLOOR_SIGMA_M = 0.004
_FLOOR_SHARE = 0.02
_SOLE_BAND_M = 0.003
_FACING_DOWN = -0.8
_OUTLINE_SIGMA_M = 0.004
_OUTLINE_EVERY = 3
"""Neighbours see the same pixels."""


@dataclass(frozen=True, slots=True)
class Skin:
    """Places of the body that rows hold on to: all vertices, or some while the fit is coarse."""

    positions: Array
    """(k, 3)."""
    normals: Array
    """(k, 3)."""
    part: NDArray[np.int32]
    """(k,)."""
    share: Array
    """(k,): the area that each stands for, in those of an average vertex."""
    sample: NDArray[np.intp]
    """(k,): the sample whose derivative each one takes."""


@dataclass(frozen=True, slots=True)
class Rows:
    """n distances that ought to vanish."""

    place: NDArray[np.intp]
    """(n,): of the skin."""
    direction: Array
    """(n, 3), unit."""
    residual_m: Array
    """(n,): how far the place should go along the direction."""
    weight: Array
    """(n,): one over the variance, times what the row counts."""

    @classmethod
    def joined(cls, *rows: Rows) -> Rows:
        return cls(
            np.concatenate([one.place for one in rows]),
            np.concatenate([one.direction for one in rows]),
            np.concatenate([one.residual_m for one in rows]),
            np.concatenate([one.weight for one in rows]),
        )

    def at_samples(self, skin: Skin, count: int) -> tuple[Array, Array]:
        """Sums for the samples: 3x3 weights (count, 3, 3) and pulls (count, 3)."""
        sample, direction = skin.sample[self.place], self.direction
        weight = np.empty((count, 3, 3))
        for i in range(3):
            weighted = self.weight * direction[:, i]
            for j in range(i + 1):
                weight[:, i, j] = np.bincount(sample, weighted * direction[:, j], count)
                weight[:, j, i] = weight[:, i, j]
        strength = self.weight * self.residual_m
        pull = [np.bincount(sample, strength * direction[:, i], count) for i in range(3)]
        return weight, np.stack(pull, axis=1)


@dataclass(frozen=True, slots=True)
class CameraTerms:
    """What the points' rows say of C cameras' corrections, and of them together with the body."""

    normal: Array
    """(6 C, 6 C)."""
    gradient: Array
    """(6 C,)."""
    cross: Array
    """(n, 3, 6 C): at each sample, how its pull changes with the corrections."""

    @classmethod
    def build(
        cls,
        rows: Rows,
        derivative: Array,
        camera: NDArray[np.integer],
        cameras: int,
        skin: Skin,
        count: int,
    ) -> CameraTerms:
        """Of rows whose points, of cameras (n,), move by derivative (n, 6)."""
        normal = np.zeros((6 * cameras, 6 * cameras))
        gradient = np.zeros(6 * cameras)
        cell = skin.sample[rows.place] * cameras + camera
        cross = np.empty((count * cameras, 3, 6))
        for j in range(6):
            weighted = rows.weight * derivative[:, j]
            for i in range(3):
                cross[:, i, j] = np.bincount(cell, weighted * rows.direction[:, i], count * cameras)
        for index in range(cameras):
            mine = camera == index
            own = slice(6 * index, 6 * index + 6)
            weighted = derivative[mine] * rows.weight[mine, None]
            normal[own, own] = derivative[mine].T @ weighted
            gradient[own] = -weighted.T @ rows.residual_m[mine]
        side_by_side = cross.reshape(count, cameras, 3, 6).transpose(0, 2, 1, 3)
        return cls(normal, gradient, side_by_side.reshape(count, 3, 6 * cameras))


def floor_rows(model: BodyModel, skin: Skin, reach_m: float) -> Rows:
    """Each foot's lowest millimetres stand on z = 0, which no camera sees; the arch does not.

    A foot that is farther from the floor than reach_m is left alone; nothing lies below the floor.
    """
    height = skin.positions[:, 2]
    touching = height < 0.0
    for side in ("left", "right"):
        foot = skin.part == model.part_names.index(f"foot_{side}")
        low = float(height[foot].min())
        if abs(low) < reach_m:
            touching |= foot & (height < low + _SOLE_BAND_M) & (skin.normals[:, 2] < _FACING_DOWN)
    found = np.flatnonzero(touching)
    return Rows(
        found,
        np.tile((0.0, 0.0, 1.0), (len(found), 1)),
        -height[found],
        _FLOOR_SHARE / _FLOOR_SIGMA_M**2 * skin.share[found],
    )


def outline_rows(
    model: BodyModel,
    free_space: FreeSpace,
    poses: Sequence[Array],
    skin: Skin,
    row_share: float,
) -> Rows:
    """Places go back from where a camera at its pose (4, 4) saw the booth behind them.

    Not the hands: one curl for four fingers cannot keep an outline, and they have rims.
    """
    found = free_space.intrusions(poses, skin.positions[::_OUTLINE_EVERY])
    place = _OUTLINE_EVERY * found.vertex
    kept = ~np.isin(skin.part[place], model.hand_parts)
    place = place[kept]
    return Rows(
        place,
        found.direction[kept],
        -found.depth_m[kept],
        _OUTLINE_EVERY * row_share / _OUTLINE_SIGMA_M**2 * skin.share[place],
    )


def crown_rows(reach: Reach) -> Rows:
    """The head ends where the cameras see it end; a camera's word counts in full, once."""
    return Rows(reach.vertex, reach.direction, reach.distance_m, reach.information)
