"""Points attached to the nearest place of a surface: a triangle and barycentric weights (numba).

A point that is attached to a vertex pulls it towards the vertex's tangent plane, which leaves the
skin where it is curved; a place on a triangle has no such error.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces
from workers.scape.model.halves import in_halves
from workers.scape.model.kernels import interpolated

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Attachments:
    """n places of a surface."""

    triangle: Index
    """(n,)."""
    weights: Array
    """(n, 3): barycentric, of the triangle's corners."""

    @classmethod
    def joined(cls, *places: Attachments) -> Attachments:
        """All places of several sets."""
        return cls(
            np.concatenate([one.triangle for one in places]),
            np.concatenate([one.weights for one in places]),
        )

    def of(self, values: Array, faces: Faces) -> Array:
        """(n, k): values (P, k) of the vertices, interpolated."""
        return np.asarray(interpolated(values, faces, self.triangle, self.weights))

    def chosen(self, which: NDArray[np.bool_]) -> Attachments:
        """Some of the places, by a mask (n,)."""
        return Attachments(self.triangle[which], self.weights[which])


def attached(
    model: BodyModel, vertices: Array, points: Array, near: NDArray[np.integer]
) -> Attachments:
    """The nearest places to points (n, 3) among the triangles around a vertex (n,) of each.

    Args:
        vertices: (P, 3), the surface.
        near: (n,): vertices near the points.
    """
    around = _triangles_around(model)
    triangle, weights = in_halves(
        lambda part: _nearest_places(points[part], near[part], *around, model.faces, vertices),
        len(points),
    )
    return Attachments(triangle, weights)


@lru_cache(maxsize=2)
def _triangles_around(model: BodyModel) -> tuple[Index, Index]:
    """Start of each vertex's triangles (P + 1,), and all triangles (3 K,)."""
    corners = model.faces.ravel()
    first = np.zeros(model.vertex_count + 1, np.int64)
    np.cumsum(np.bincount(corners, minlength=model.vertex_count), out=first[1:])
    return first, (np.argsort(corners, kind="stable") // 3).astype(np.int64)


@numba.njit(cache=True, nogil=True)
def _nearest_places(points, near, first, triangles, faces, vertices):  # type: ignore[no-untyped-def]  # pragma: no cover
    count = len(points)
    triangle = np.empty(count, np.int64)
    weights = np.empty((count, 3))
    for p in range(count):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        least = np.inf
        for index in range(first[near[p]], first[near[p] + 1]):
            k = triangles[index]
            a, b, c = vertices[faces[k, 0]], vertices[faces[k, 1]], vertices[faces[k, 2]]
            u, v, w = _barycentric(x, y, z, a, b, c)
            square = (
                (u * a[0] + v * b[0] + w * c[0] - x) ** 2
                + (u * a[1] + v * b[1] + w * c[1] - y) ** 2
                + (u * a[2] + v * b[2] + w * c[2] - z) ** 2
            )
            if square < least:
                least, triangle[p] = square, k
                weights[p, 0], weights[p, 1], weights[p, 2] = u, v, w
    return triangle, weights


@numba.njit(cache=True, nogil=True, inline="always")
def _barycentric(x, y, z, a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Weights of the triangle's place nearest to a point (Ericson 2005, section 5.1.5)."""
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    d1 = ab0 * (x - a[0]) + ab1 * (y - a[1]) + ab2 * (z - a[2])
    d2 = ac0 * (x - a[0]) + ac1 * (y - a[1]) + ac2 * (z - a[2])
    d3 = ab0 * (x - b[0]) + ab1 * (y - b[1]) + ab2 * (z - b[2])
    d4 = ac0 * (x - b[0]) + ac1 * (y - b[1]) + ac2 * (z - b[2])
    d5 = ab0 * (x - c[0]) + ab1 * (y - c[1]) + ab2 * (z - c[2])
    d6 = ac0 * (x - c[0]) + ac1 * (y - c[1]) + ac2 * (z - c[2])
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    area_c = d1 * d4 - d3 * d2
    if area_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        share = d1 / (d1 - d3)
        return 1.0 - share, share, 0.0
    area_b = d5 * d2 - d1 * d6
    if area_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        share = d2 / (d2 - d6)
        return 1.0 - share, 0.0, share
    area_a = d3 * d6 - d5 * d4
    if area_a <= 0.0 and d4 >= d3 and d5 >= d6:
        share = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - share, share
    total = area_a + area_b + area_c
    if total <= 0.0:
        return 1.0, 0.0, 0.0
    return area_a / total, area_b / total, area_c / total
