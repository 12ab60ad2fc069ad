"""Plane sections of a mesh and the tape around them (pure geometry, metres).

Every point of a section lies on an edge of the mesh and is kept as (tail, head, share): the same
point can then be found on the same mesh in another pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.geometry import skew

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
        crossing, share = _crossing(vertices, self.tails, self.heads, point, normal)
        return EdgePoints(self.tails[crossing], self.heads[crossing], share), crossing

    def pieces(self, crossing: Index) -> Index:
        """The connected piece of a section that each cut edge belongs to."""
        return np.asarray(_connected(*self.segments(crossing), len(crossing)))

    def segments(self, crossing: Index) -> tuple[Index, Index]:
        """Pairs of cut edges, by their place in `crossing`, that one triangle joins."""
        one, other = _joined(self.left[crossing], self.right[crossing])
        return one, other


@numba.njit(cache=True, nogil=True)
def _crossing(vertices, tails, heads, point, normal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Edges that a plane cuts, and the share of each at which it does."""
    away = np.empty(len(vertices))
    for v in range(len(vertices)):
        away[v] = 0.0
        for i in range(3):
            away[v] += (vertices[v, i] - point[i]) * normal[i]
    edges, shares = np.empty(len(tails), np.int64), np.empty(len(tails))
    count = 0
    for edge in range(len(tails)):
        start, end = away[tails[edge]], away[heads[edge]]
        if (start < 0.0) != (end < 0.0):
            edges[count], shares[count] = edge, start / (start - end)
            count += 1
    return edges[:count].copy(), shares[:count].copy()


@numba.njit(cache=True, nogil=True)
def _joined(left, right):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Pairs of places (n,) that have a triangle in common; no more than two have the same one."""
    count = len(left)
    last = 0
    for place in range(count):
        last = max(last, left[place], right[place])
    first = np.full(last + 1, -1, np.int64)
    one, other = np.empty((2, 2 * count), np.int64)
    size = 0
    for place in range(count):
        for side in range(1 if left[place] == right[place] else 2):
            triangle = left[place] if side == 0 else right[place]
            if first[triangle] < 0:
                first[triangle] = place
            else:
                one[size], other[size] = first[triangle], place
                size += 1
    return one[:size].copy(), other[:size].copy()


@numba.njit(cache=True, nogil=True)
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
    turns = np.einsum("ni,ni->n", sides @ skew(normal).T, point - hull)
    return bool((turns >= 0.0).all() or (turns <= 0.0).all())


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def around(places, values, chosen, center, reach):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Weighted sum (3,) of chosen ones (k,) of the values (K, 3) at places (K, 3): the weight falls
    with the square of the distance from a center, to 0 at the reach."""
    total = np.zeros(3)
    for k in chosen:
        square = 0.0
        for i in range(3):
            square += ((places[k, i] - center[i]) / reach) ** 2
        if square < 1.0:
            for i in range(3):
                total[i] += (1.0 - square) * values[k, i]
    return total


def loop_length(points: Array, *, closed: bool) -> float:
    """Length of a polyline (n, 3)."""
    return float(_length(points, closed))


@numba.njit(cache=True, nogil=True)
def _length(points, closed):  # type: ignore[no-untyped-def]  # pragma: no cover
    count, length = len(points), 0.0
    for start in range(count if closed else count - 1):
        square = 0.0
        for i in range(3):
            square += (points[(start + 1) % count, i] - points[start, i]) ** 2
        length += np.sqrt(square)
    return length


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
    return np.asarray(_outside(x, y, near, order, *segments, _OUTSIDE * length), np.intp)


@numba.njit(cache=True, nogil=True)
def _outside(x, y, near, order, ones, others, slack):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Those of the points in an order that no segment between near points runs above."""
    kept = np.empty(len(order), np.int64)
    size = 0
    for here in order:
        highest = -np.inf
        for segment in range(len(ones)):
            a, b = ones[segment], others[segment]
            if not (near[a] and near[b]):
                continue
            if x[a] > x[b]:
                a, b = b, a
            if x[a] < x[here] < x[b]:
                share = (x[here] - x[a]) / max(x[b] - x[a], 1e-12)
                highest = max(highest, y[a] + share * (y[b] - y[a]))
        if y[here] >= highest - slack:
            kept[size] = here
            size += 1
    return kept[:size]


@numba.njit(cache=True, nogil=True)
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
