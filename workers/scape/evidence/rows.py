"""Weighted linear rows on the body's displacement, and their sums at the sample vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.evidence.free_space import FreeSpace
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_OUTLINE_SIGMA_M = 0.004
"""Standard deviation of a silhouette: about a pixel (3.4 mm at 2 m)."""
_OUTLINE_EVERY = 3
"""Every so many vertices are tested: neighbours see the same pixels."""


@dataclass(frozen=True, slots=True)
class Skin:
    """Surface points that rows refer to: all vertices, or some of them while the fit is coarse."""

    positions: Array
    """(k, 3)."""
    normals: Array
    """(k, 3)."""
    part: NDArray[np.int32]
    """(k,)."""
    share: Array
    """(k,): area that each represents, in units of an average vertex's."""
    sample: NDArray[np.intp]
    """(k,): index of the sample vertex whose derivative each one uses."""


@dataclass(frozen=True, slots=True)
class Rows:
    """n equations: direction . (displacement of a place) = residual, each with its weight."""

    place: NDArray[np.intp]
    """(n,): index into the skin."""
    direction: Array
    """(n, 3), unit vectors."""
    residual_m: Array
    """(n,): distance that the place should move along the direction."""
    weight: Array
    """(n,): inverse variance times the share with which the row counts."""

    @classmethod
    def joined(cls, *rows: Rows) -> Rows:
        """All rows of several sets."""
        return cls(
            np.concatenate([one.place for one in rows]),
            np.concatenate([one.direction for one in rows]),
            np.concatenate([one.residual_m for one in rows]),
            np.concatenate([one.weight for one in rows]),
        )

    def at_samples(self, skin: Skin, count: int) -> tuple[Array, Array]:
        """Sums over the rows of each sample: weights (count, 3, 3), weighted residuals (count, 3).

        With d the direction, w the weight and r the residual: sum of w d d^T, sum of w r d.
        """
        sample, direction = skin.sample[self.place], self.direction
        weight = np.empty((count, 3, 3))
        for i in range(3):
            weighted = self.weight * direction[:, i]
            for j in range(i + 1):
                weight[:, i, j] = np.bincount(sample, weighted * direction[:, j], count)
                weight[:, j, i] = weight[:, i, j]
        strength = self.weight * self.residual_m
        total = [np.bincount(sample, strength * direction[:, i], count) for i in range(3)]
        return weight, np.stack(total, axis=1)


@dataclass(frozen=True, slots=True)
class CameraTerms:
    """Parts of the normal equations that involve the corrections of C cameras."""

    normal: Array
    """(6 C, 6 C)."""
    gradient: Array
    """(6 C,)."""
    cross: Array
    """(n, 3, 6 C): derivative of each sample's weighted residual by the corrections."""

    @classmethod
    def build(
        cls,
        rows: Rows,
        points: Array,
        camera: NDArray[np.integer],
        corrections: CameraCorrections,
        skin: Skin,
        count: int,
    ) -> CameraTerms:
        """Sum up rows (n,).

        Args:
            points: (n, 3), the corrected point of each row.
            camera: (n,), index of its camera.
            corrections: of C cameras.
            count: number of samples.
        """
        cameras = len(corrections)
        derivative = corrections.derivative(points, camera, rows.direction)
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


def outline_rows(
    model: BodyModel,
    free_space: FreeSpace,
    poses: Sequence[Array],
    skin: Skin,
    row_share: float,
) -> Rows:
    """Rows that move places out of pixels that show the background.

    Hands are left out: with one joint for four fingers they cannot follow an outline, and they have
    rims.

    Args:
        poses: world_from_camera (4, 4) of each camera.
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
