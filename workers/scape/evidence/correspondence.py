"""Correspondences of points and vertices: nearest neighbours in position and direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.scape.model.deformation import Graph
from workers.scape.model.halves import WORTH_A_THREAD, in_halves
from workers.scape.model.kernels import descend, side_by_side

Array = NDArray[np.float64]

_DIRECTION_SCALE_M = 0.04
"""Scale of normals in the search space: opposite normals count as 8 cm of distance."""
_SEARCHED_EVERY = 4
"""Step between the dense points that are searched for; the others start from their results."""


@dataclass(frozen=True, slots=True)
class OrientedTree:
    """Search tree of oriented points (n, 3), so that a front never pairs with a back."""

    points: Array
    normals: Array
    tree: cKDTree

    @classmethod
    def build(cls, points: Array, normals: Array) -> OrientedTree:
        return cls(points, normals, cKDTree(_joined(points, normals), balanced_tree=False))

    def nearest(self, points: Array, normals: Array) -> NDArray[np.intp]:
        """Index (m,) of the nearest neighbour of each oriented point (m, 3)."""
        _, index = self.tree.query(_joined(points, normals), workers=_threads(len(points)))
        return np.asarray(index)

    def pairs(
        self, points: Array, normals: Array, *, max_distance_m: float, max_angle_rad: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices of oriented points (m, 3) with a compatible neighbour, and of these neighbours.

        Faster than `nearest`, since farther points are not searched for.
        """
        turn_m = 2.0 * _DIRECTION_SCALE_M * np.sin(0.5 * max_angle_rad)
        reach_m = float(np.hypot(max_distance_m, turn_m))
        _, index = self.tree.query(
            _joined(points, normals),
            distance_upper_bound=reach_m,
            workers=_threads(len(points)),
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


class TrackedPoints:
    """Nearest vertices of oriented points (n, 3), tracked while one surface moves.

    The whole surface is searched once; points that find nothing within the limits are left out from
    then on. Later searches descend from the last vertex to nearer neighbours, which may stop short
    of the nearest vertex in a fold. Dense points in the order of an image are faster: each starts
    from the vertex of a point a few places before it.
    """

    def __init__(self, graph: Graph, points: Array, normals: Array, *, dense: bool = False) -> None:
        self.points, self.normals = points, normals
        self._stride = _SEARCHED_EVERY if dense else 1
        self._place = _joined(points, normals)
        self._graph = graph
        self._vertex: NDArray[np.intp] | None = None

    def pairs(
        self, vertices: Array, normals: Array, *, max_distance_m: float, max_angle_rad: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices of points with a compatible vertex among (P, 3), and of these vertices."""
        nodes = _joined(vertices, normals)
        square, product = max_distance_m**2, _DIRECTION_SCALE_M**2 * np.cos(max_angle_rad)
        if self._vertex is None:
            tree = OrientedTree.build(vertices, normals)
            limits = {"max_distance_m": max_distance_m, "max_angle_rad": max_angle_rad}
            self._vertex = self._starting_vertices(tree, limits)
            here, kept = self._descended(nodes, self._vertex, square, product)
            # Points misled by the coarse search are matched individually.
            lost = np.flatnonzero(~kept)
            again, anew = tree.pairs(self.points[lost], self.normals[lost], **limits)
            here[lost[again]], kept[lost[again]] = anew, True
        else:
            here, kept = self._descended(nodes, self._vertex, square, product)
        self._vertex = here
        used = np.flatnonzero(kept)
        return used, here[used]

    def _descended(
        self, nodes: Array, start: NDArray[np.intp], square: float, product: float
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """`descend` for all points, in two threads."""
        here, kept = in_halves(
            lambda part: descend(
                self._place[part], nodes, *self._graph, start[part], square, product
            ),
            len(start),
        )
        return here, kept

    def _starting_vertices(self, tree: OrientedTree, limits: dict[str, float]) -> NDArray[np.intp]:
        """Vertex (n,) that each point starts from, -1 where none was found."""
        every = slice(None, None, self._stride)
        found, vertex = tree.pairs(self.points[every], self.normals[every], **limits)
        start = np.full(-(-len(self.points) // self._stride), -1, np.intp)
        start[found] = vertex
        return np.repeat(start, self._stride)[: len(self.points)]


def _threads(queries: int) -> int:
    return 2 if queries > WORTH_A_THREAD else 1


def _joined(points: Array, normals: Array) -> Array:
    return np.asarray(side_by_side(points, normals, _DIRECTION_SCALE_M))


def compatible(
    offsets: Array,
    normals_a: Array,
    normals_b: Array,
    *,
    max_distance_m: float,
    max_angle_rad: float,
) -> NDArray[np.bool_]:
    """Mask of pairs closer than a distance whose normals differ by less than an angle (the paper's
    step a)."""
    near = np.einsum("ni,ni->n", offsets, offsets) < max_distance_m**2
    aligned = np.einsum("ni,ni->n", normals_a, normals_b) > np.cos(max_angle_rad)
    return np.asarray(near & aligned)
