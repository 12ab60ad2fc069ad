"""What pulls the body: distances along a direction at a vertex, and their sums at the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.scape.free_space import FreeSpace
from workers.scape.model import BodyModel

Array = NDArray[np.float64]

_FLOOR_SIGMA_M = 0.004
_FLOOR_SHARE = 0.02
_SOLE_BAND_M = 0.012
_OUTLINE_SIGMA_M = 0.004
_SEARCHED = ("hand", "thumb", "fingers")
"""The search for the hands looks at points; one curl for four fingers cannot keep an outline."""


@dataclass(frozen=True, slots=True)
class Rows:
    """n distances that ought to vanish."""

    vertex: NDArray[np.intp]
    direction: Array
    """(n, 3), unit."""
    residual_m: Array
    """(n,): how far the vertex should go along the direction."""
    weight: Array
    """(n,): one over the variance, times what the row counts."""

    @classmethod
    def joined(cls, *rows: Rows) -> Rows:
        return cls(
            np.concatenate([one.vertex for one in rows]),
            np.concatenate([one.direction for one in rows]),
            np.concatenate([one.residual_m for one in rows]),
            np.concatenate([one.weight for one in rows]),
        )

    def at_samples(self, sample_of_vertex: NDArray[np.intp], count: int) -> tuple[Array, Array]:
        """Sums for the samples: 3x3 weights (count, 3, 3) and pulls (count, 3)."""
        sample, direction = sample_of_vertex[self.vertex], self.direction
        weight = np.empty((count, 3, 3))
        for i in range(3):
            weighted = self.weight * direction[:, i]
            for j in range(i + 1):
                weight[:, i, j] = np.bincount(sample, weighted * direction[:, j], count)
                weight[:, j, i] = weight[:, i, j]
        strength = self.weight * self.residual_m
        pull = [np.bincount(sample, strength * direction[:, i], count) for i in range(3)]
        return weight, np.stack(pull, axis=1)


def floor_rows(vertices: Array, normals: Array, reach_m: float) -> Rows:
    """The soles stand on z = 0, which no camera sees; nothing lies below it."""
    down = (normals[:, 2] < -0.8) & (vertices[:, 2] < _SOLE_BAND_M)
    near = down & (vertices[:, 2] > -max(_SOLE_BAND_M, reach_m))
    touching = np.flatnonzero(near | (vertices[:, 2] < 0.0))
    return Rows(
        touching,
        np.tile((0.0, 0.0, 1.0), (len(touching), 1)),
        -vertices[touching, 2],
        np.full(len(touching), _FLOOR_SHARE / _FLOOR_SIGMA_M**2),
    )


def outline_rows(
    model: BodyModel, free_space: FreeSpace, vertices: Array, row_share: float
) -> Rows:
    """Vertices go back from where a camera saw the booth behind them."""
    found = free_space.intrusions(vertices)
    searched = [i for i, name in enumerate(model.part_names) if name.startswith(_SEARCHED)]
    kept = ~np.isin(model.part_of_vertex[found.vertex], searched)
    vertex = found.vertex[kept]
    return Rows(
        vertex,
        found.direction[kept],
        -found.depth_m[kept],
        row_share / _OUTLINE_SIGMA_M**2 * model.vertex_shares[vertex],
    )
