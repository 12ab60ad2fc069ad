"""Which point belongs to which vertex: nearest neighbours in position and direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_DIRECTION_SCALE_M = 0.04
"""How far apart two points count that face opposite ways: half of twice this."""


@dataclass(frozen=True, slots=True)
class OrientedTree:
    """Nearest neighbours among oriented points (n, 3): a front never pairs with a back."""

    points: Array
    normals: Array
    tree: cKDTree

    @classmethod
    def build(cls, points: Array, normals: Array) -> OrientedTree:
        return cls(points, normals, cKDTree(_joined(points, normals), balanced_tree=False))

    def nearest(self, points: Array, normals: Array) -> NDArray[np.intp]:
        """Index (m,) of the neighbour of each oriented point (m, 3)."""
        _, index = self.tree.query(_joined(points, normals), workers=2)
        return np.asarray(index)

    def pairs(
        self, points: Array, normals: Array, *, max_distance_m: float, max_angle_rad: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Those of the oriented points (m, 3) that have a compatible neighbour, and which.

        Farther points are not searched for, which is most of the time of `nearest`.
        """
        turn_m = 2.0 * _DIRECTION_SCALE_M * np.sin(0.5 * max_angle_rad)
        reach_m = float(np.hypot(max_distance_m, turn_m))
        _, index = self.tree.query(
            _joined(points, normals), distance_upper_bound=reach_m, workers=2
        )
        found = np.flatnonzero(index < len(self.points))
        index = index[found]
        kept = compatible(
            self.points[index] - points[found],
            normals[found],
            self.normals[index],
            max_distance_m=max_distance_m,
            max_angle_rad=max_angle_rad,
        )
        return found[kept], index[kept]


def _joined(points: Array, normals: Array) -> Array:
    return np.concatenate([points, _DIRECTION_SCALE_M * normals], axis=1)


def compatible(
    offsets: Array,
    normals_a: Array,
    normals_b: Array,
    *,
    max_distance_m: float,
    max_angle_rad: float,
) -> NDArray[np.bool_]:
    """Pairs nearer than a distance whose normals differ by less than an angle (paper)."""
    near = np.einsum("ni,ni->n", offsets, offsets) < max_distance_m**2
    aligned = np.einsum("ni,ni->n", normals_a, normals_b) > np.cos(max_angle_rad)
    return np.asarray(near & aligned)
