"""Plane sections of a mesh and the tape around them (pure geometry, metres).

Every point of a section lies on an edge of the mesh and is kept as (tail, head, share): the same
point can then be found on the same mesh in another pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """n points on edges: tail + share (head - tail)."""

    tail: Index
    head: Index
    share: Array

    def on(self, vertices: Array) -> Array:
        """Places (n, 3) on a body with vertices (P, 3)."""
        start = vertices[self.tail]
        return np.asarray(start + self.share[:, None] * (vertices[self.head] - start))

    def take(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> EdgePoints:
        return EdgePoints(self.tail[chosen], self.head[chosen], self.share[chosen])

    @classmethod
    def at(cls, vertices: list[int]) -> EdgePoints:
        """Points that are vertices."""
        index = np.asarray(vertices, dtype=np.intp)
        return cls(index, index, np.zeros(len(index)))

    @classmethod
    def joined(cls, pieces: list[EdgePoints]) -> EdgePoints:
        return cls(
            np.concatenate([piece.tail for piece in pieces]),
            np.concatenate([piece.head for piece in pieces]),
            np.concatenate([piece.share for piece in pieces]),
        )


@dataclass(frozen=True, slots=True)
class EdgeNet:
    """The edges of some triangles of a mesh, ready to be cut."""

    tails: Index
    heads: Index
    left: Index
    """The triangle on one side of each edge ..."""
    right: Index
    """... and on the other; the same one again at a border."""

    @classmethod
    def build(cls, faces: Faces) -> EdgeNet:
        """Build the net of triangles (k, 3)."""
        corners = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), 1)
        owner = np.repeat(np.arange(len(faces)), 3)
        pairs, edge = np.unique(corners, axis=0, return_inverse=True)
        edge = edge.ravel()
        left, right = np.zeros(len(pairs), np.intp), np.zeros(len(pairs), np.intp)
        left[edge[::-1]] = owner[::-1]
        right[edge] = owner
        return cls(pairs[:, 0].astype(np.intp), pairs[:, 1].astype(np.intp), left, right)

    def cut(self, vertices: Array, point: Array, normal: Array) -> tuple[EdgePoints, Index]:
        """Points at which a plane cuts the edges, and the edge of each."""
        away = vertices @ normal - point @ normal
        from_m, to_m = away[self.tails], away[self.heads]
        crossing = np.flatnonzero((from_m < 0.0) != (to_m < 0.0))
        from_m, to_m = from_m[crossing], to_m[crossing]
        found = EdgePoints(self.tails[crossing], self.heads[crossing], from_m / (from_m - to_m))
        return found, crossing

    def pieces(self, crossing: Index) -> Index:
        """The connected piece of a section that each cut edge belongs to."""
        return np.asarray(_connected(*self.segments(crossing), len(crossing)))

    def segments(self, crossing: Index) -> tuple[Index, Index]:
        """Pairs of cut edges, by their place in `crossing`, that one triangle joins."""
        triangle = np.concatenate([self.left[crossing], self.right[crossing]])
        cut_edge = np.tile(np.arange(len(crossing)), 2)
        order = np.argsort(triangle, kind="stable")
        triangle, cut_edge = triangle[order], cut_edge[order]
        same = np.flatnonzero(triangle[1:] == triangle[:-1])
        return cut_edge[same], cut_edge[same + 1]


@numba.njit(cache=True)
def _connected(tails, heads, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The smallest of count places that each is linked to (union-find, paths halved)."""
    root = np.arange(count)
    for link in range(len(tails)):
        a, b = tails[link], heads[link]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        root[max(a, b)] = min(a, b)
    for place in range(count):
        root[place] = root[root[place]]
    return root


def cross(a: Array, b: Array) -> Array:
    """Vector product (3,) of two vectors, which takes numpy ten times as long."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def plane_axes(normal: Array, along: Array | None = None) -> tuple[Array, Array]:
    """Two unit vectors in a plane, the first the projection of `along`."""
    if along is None:
        along = np.array((0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0))
    x = along - normal * (along @ normal)
    x = x / np.linalg.norm(x)
    return x, cross(normal, x)


def hull_order(points: Array, normal: Array) -> Index:
    """Indices, in order, of the points (n, 3) of a plane section that a tight tape touches.

    Raises:
        ValueError: fewer than three points, or all on a line.
    """
    x, y = plane_axes(normal)
    u, v = points @ x, points @ y
    tape = _chain(u, v, np.lexsort((v, u)))
    if len(tape) < 3:
        raise ValueError("the plane does not cut this part of the body")
    return np.asarray(tape, np.intp)


def encloses(hull: Array, normal: Array, point: Array) -> bool:
    """Whether a convex polygon (n, 3), seen along its plane's normal, holds a point."""
    sides = np.roll(hull, -1, axis=0) - hull
    turns = np.cross(sides, point - hull) @ normal
    return bool((turns >= 0.0).all() or (turns <= 0.0).all())


@numba.njit(cache=True)
def _chain(u, v, order):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The convex hull of points (n,), sorted by u and then v, counter-clockwise: the chain below
    and back the chain above (Andrew 1979, Information Processing Letters 9:216)."""
    count = len(order)
    kept = np.empty(2 * count + 1, np.int64)
    size = 0
    for sweep in range(2):
        least = size + 1
        for step in range(count):
            here = order[step] if sweep == 0 else order[count - 1 - step]
            while size > least and _turn(u, v, kept[size - 2], kept[size - 1], here) <= 0.0:
                size -= 1
            kept[size] = here
            size += 1
        # The last point of one chain is the first of the other.
        size -= 1
    return kept[:size]


@numba.njit(cache=True, inline="always")
def _turn(u, v, a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Positive where a, b, c turn left."""
    return (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])


def loop_length(points: Array, *, closed: bool) -> float:
    """Length of a polyline (n, 3)."""
    steps = np.diff(points, axis=0, append=points[:1]) if closed else np.diff(points, axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


_BELOW_CHORD = 0.10
"""Points farther below the straight line than this share of its length are another part of the
body."""
_OUTSIDE = 1e-6
"""Share of the length that a point of the outside may lie below the highest segment there."""


def surface_order(
    points: Array,
    segments: tuple[Index, Index],
    ends: tuple[Array, Array],
    outward: Array,
    *,
    taut: bool,
    bulge: float,
) -> Index:
    """Indices, in order, of the points (n, 3) of a section on its outside between two ends.

    The section is that of the plane of both ends and of `outward`. A taut tape skips hollows.

    Args:
        segments: the points that follow each other in the section.
        bulge: height above the straight line, as a share of its length, from which points are
            another part of the body.
    """
    start, end = ends
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    up = outward - along * (outward @ along)
    up = up / np.linalg.norm(up)
    x, y = (points - start) @ along, (points - start) @ up
    near = (y > -_BELOW_CHORD * length) & (y < bulge * length)
    order = np.flatnonzero(near & (x > 0.0) & (x < length))
    order = order[np.argsort(x[order], kind="stable")]
    if taut:
        u, v = np.r_[0.0, x[order], length], np.r_[0.0, y[order], 0.0]
        return np.asarray(order[_taut(u, v)[1:-1] - 1], np.intp)
    a, b = (index[near[segments[0]] & near[segments[1]]] for index in segments)
    a, b = np.where(x[a] <= x[b], a, b), np.where(x[a] <= x[b], b, a)
    here = x[order][:, None]
    share = (here - x[a]) / np.maximum(x[b] - x[a], 1e-12)
    height = np.where((here > x[a]) & (here < x[b]), y[a] + share * (y[b] - y[a]), -np.inf)
    highest = height.max(axis=1, initial=-np.inf)
    return np.asarray(order[y[order] >= highest - _OUTSIDE * length], np.intp)


@numba.njit(cache=True)
def _taut(u, v):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Indices of the points (n,), sorted by u, that a tape above them touches, ends included."""
    kept = np.empty(len(u), np.int64)
    size = 0
    for here in range(len(u)):
        while size >= 2 and _turn(u, v, kept[size - 2], kept[size - 1], here) >= 0.0:
            size -= 1
        kept[size] = here
        size += 1
    return kept[:size]
