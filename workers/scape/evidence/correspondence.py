"""Which point belongs to which vertex: nearest neighbours in position and direction."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.scape.model.deformation import Graph
from workers.scape.model.kernels import follow

Array = NDArray[np.float64]

_DIRECTION_SCALE_M = 0.04
"""How far apart two points count that face opposite ways: half of twice this."""
_SCOUT_EVERY = 4
_WORTH_A_THREAD = 5000
"""Fewer questions are answered before a second thread has started."""


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
        _, index = self.tree.query(_joined(points, normals), workers=_threads(len(points)))
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


class Followers:
    """Oriented points (n, 3) that keep their vertex while one surface moves beneath them.

    They are searched for in the whole surface once; who finds nothing within the limits then is
    left out for good. After that, each looks for a nearer vertex among the neighbours of its last,
    and on from there: in a fold it may stop short of the nearest. Dense points in the order of an
    image are quicker: they set out from the vertex that was found for one a few places before them.
    """

    def __init__(self, graph: Graph, points: Array, normals: Array, *, dense: bool = False) -> None:
        self.points, self.normals = points, normals
        self._scouts = _SCOUT_EVERY if dense else 1
        self._place = _joined(points, normals)
        self._graph = graph
        self._vertex: NDArray[np.intp] | None = None

    def pairs(
        self, vertices: Array, normals: Array, *, max_distance_m: float, max_angle_rad: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Those of the points that have a compatible vertex (P, 3), and which."""
        nodes = _joined(vertices, normals)
        square, product = max_distance_m**2, _DIRECTION_SCALE_M**2 * np.cos(max_angle_rad)
        if self._vertex is None:
            tree = OrientedTree.build(vertices, normals)
            limits = {"max_distance_m": max_distance_m, "max_angle_rad": max_angle_rad}
            self._vertex = self._scouted(tree, limits)
            here, kept = self._led(nodes, self._vertex, square, product)
            # Whom a scout led astray is searched for by itself.
            lost = np.flatnonzero(~kept)
            again, anew = tree.pairs(self.points[lost], self.normals[lost], **limits)
            here[lost[again]], kept[lost[again]] = anew, True
        else:
            here, kept = self._led(nodes, self._vertex, square, product)
        self._vertex = here
        used = np.flatnonzero(kept)
        return used, here[used]

    def _led(
        self, nodes: Array, start: NDArray[np.intp], square: float, product: float
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """`follow`, half of the points beside the other half."""
        count = len(start)
        with ThreadPoolExecutor(_threads(count)) as pool:
            halves = pool.map(
                lambda half: follow(
                    self._place[half], nodes, *self._graph, start[half], square, product
                ),
                (slice(0, count // 2), slice(count // 2, count)),
            )
            here, kept = (np.concatenate(parts) for parts in zip(*halves, strict=True))
        return here, kept

    def _scouted(self, tree: OrientedTree, limits: dict[str, float]) -> NDArray[np.intp]:
        """(n,): where each point sets out from, -1 where nothing was found."""
        every = slice(None, None, self._scouts)
        found, vertex = tree.pairs(self.points[every], self.normals[every], **limits)
        scouted = np.full(-(-len(self.points) // self._scouts), -1, np.intp)
        scouted[found] = vertex
        return np.repeat(scouted, self._scouts)[: len(self.points)]


def _threads(questions: int) -> int:
    return 2 if questions > _WORTH_A_THREAD else 1


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
