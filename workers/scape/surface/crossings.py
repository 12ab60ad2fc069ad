"""Pairs of triangles of a surface that cross each other (numba).

Candidates are found by a sweep from bottom to top in every column of a grid.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from workers.scape.model.deformation import Faces

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pairs = NDArray[np.int32]

_CELL_M = 0.02
"""Cell size of the grid that finds triangles near those that are tested."""


def at_vertices(vertices: Mask, faces: Faces) -> Mask:
    """Mask (K,) of triangles with a corner among some vertices (P,)."""
    # A quarter of the time that `any` takes over three columns.
    return np.asarray(vertices[faces[:, 0]] | vertices[faces[:, 1]] | vertices[faces[:, 2]])


def crossing_pairs(vertices: Array, faces: Faces, tested: Mask | None = None) -> Pairs:
    """Pairs (m, 2) of triangles that cross.

    Triangles that share a vertex count if they cross elsewhere; triangles that share an edge cannot
    cross. Touching is not crossing.

    Args:
        vertices: (P, 3).
        faces: (K, 3).
        tested: (K,), pairs without one of these triangles are left out; all by default.
    """
    lows, highs = _boxes(vertices, faces)
    if tested is None:
        tested = np.ones(len(faces), bool)
        near = np.arange(len(faces))
    else:
        # Triangles far from all tested ones need not be compared.
        near = np.flatnonzero(_near(lows, highs, tested, _CELL_M))
    if len(near) == 0:
        return np.empty((0, 2), np.int32)
    upwards = near[np.argsort(lows[near, 2], kind="stable")]
    found = _crossing_pairs(
        vertices[faces[upwards]], lows[upwards], highs[upwards], faces[upwards], tested[upwards]
    )
    return np.sort(upwards[found], axis=1).astype(np.int32)


@numba.njit(cache=True, nogil=True)
def _boxes(vertices, faces):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Least and largest coordinates (K, 3) of each triangle."""
    lows, highs = np.empty((len(faces), 3)), np.empty((len(faces), 3))
    for k in range(len(faces)):
        one, two, three = faces[k, 0], faces[k, 1], faces[k, 2]
        for c in range(3):
            x, y, z = vertices[one, c], vertices[two, c], vertices[three, c]
            lows[k, c] = min(x, y, z)
            highs[k, c] = max(x, y, z)
    return lows, highs


@numba.njit(cache=True, nogil=True)
def _near(lows, highs, tested, cell):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Mask of boxes that share a cell of a coarse grid with a tested one."""
    low, high = lows[0].copy(), highs[0].copy()
    for k in range(len(lows)):
        for c in range(3):
            low[c] = min(low[c], lows[k, c])
            high[c] = max(high[c], highs[k, c])
    x1, y1, z1 = _cell_of(high, low, cell)
    occupied = np.zeros((x1 + 1, y1 + 1, z1 + 1), np.bool_)
    near = tested.copy()
    for marking in (True, False):
        for k in range(len(lows)):
            if tested[k] != marking:
                continue
            x0, y0, z0 = _cell_of(lows[k], low, cell)
            x1, y1, z1 = _cell_of(highs[k], low, cell)
            for x in range(x0, x1 + 1):
                for y in range(y0, y1 + 1):
                    for z in range(z0, z1 + 1):
                        if marking:
                            occupied[x, y, z] = True
                        elif occupied[x, y, z]:
                            near[k] = True
    return near


@numba.njit(cache=True, nogil=True, inline="always")
def _cell_of(point, low, cell):  # type: ignore[no-untyped-def]  # pragma: no cover
    return (
        int((point[0] - low[0]) / cell),
        int((point[1] - low[1]) / cell),
        int((point[2] - low[2]) / cell),
    )


@numba.njit(cache=True, nogil=True)
def _filed(lows, highs):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Boxes, sorted by their lowest heights, filed by the vertical columns that they are in.

    Returns:
        the first column (n, 2) of each box; where each bucket of columns starts; and of each entry
        the box, its column (x, y) and the box' ends.
    """
    count = len(lows)
    extent = 0.0
    for k in range(count):
        for c in range(2):
            extent += highs[k, c] - lows[k, c]
    # Wider than most triangles, so that a triangle is in few columns and a column is short.
    width = max(1.5 * extent / count, 1e-6)
    first = np.empty((count, 2), np.int64)
    last = np.empty((count, 2), np.int64)
    entries = 0
    for k in range(count):
        for c in range(2):
            first[k, c] = int(np.floor(lows[k, c] / width))
            last[k, c] = int(np.floor(highs[k, c] / width))
        spans = last[k] - first[k] + 1
        entries += spans[0] * spans[1]
    buckets = 1
    while buckets < 2 * entries:
        buckets *= 2
    start = np.zeros(buckets + 1, np.int64)
    # Two passes: how many entries a bucket has, then the entries, from its last to its first.
    triangle = np.empty(entries, np.int32)
    columns = np.empty((entries, 2), np.int64)
    boxes = np.empty((entries, 6))
    for filling in range(2):
        for k in range(count - 1, -1, -1):
            for x in range(first[k, 0], last[k, 0] + 1):
                for y in range(first[k, 1], last[k, 1] + 1):
                    bucket = _bucket(x, y, buckets)
                    if filling:
                        start[bucket] -= 1
                        entry = start[bucket]
                        triangle[entry] = k
                        columns[entry, 0], columns[entry, 1] = x, y
                        # Assigning a row takes 4 s to compile.
                        for axis in range(3):
                            boxes[entry, axis] = lows[k, axis]
                            boxes[entry, 3 + axis] = highs[k, axis]
                    else:
                        start[bucket] += 1
        if not filling:
            for bucket in range(buckets):
                start[bucket + 1] += start[bucket]
    return first, start, triangle, columns, boxes


@numba.njit(cache=True, nogil=True)
def _crossing_pairs(corners, lows, highs, faces, tested):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Crossing pairs of triangles that are sorted by their lowest heights."""
    first, start, triangle, columns, boxes = _filed(lows, highs)
    pairs = []
    for bucket in range(len(start) - 1):
        for i in range(start[bucket], start[bucket + 1]):
            a = triangle[i]
            for j in range(i + 1, start[bucket + 1]):
                if boxes[j, 2] > boxes[i, 5]:
                    break
                if (
                    boxes[i, 0] > boxes[j, 3]
                    or boxes[j, 0] > boxes[i, 3]
                    or boxes[i, 1] > boxes[j, 4]
                    or boxes[j, 1] > boxes[i, 4]
                ):
                    continue
                b = triangle[j]
                if a == b or not (tested[a] or tested[b]):
                    continue
                # A pair is tested only in the first column that holds both.
                x, y = max(first[a, 0], first[b, 0]), max(first[a, 1], first[b, 1])
                if columns[i, 0] != x or columns[i, 1] != y:
                    continue
                if columns[j, 0] != x or columns[j, 1] != y:
                    continue
                if _cross(corners, faces, a, b):
                    pairs.append((a, b))
    out = np.empty((len(pairs), 2), np.int32)
    for row in range(len(pairs)):
        out[row, 0], out[row, 1] = pairs[row]
    return out


@numba.njit(cache=True, nogil=True, inline="always")
def _bucket(x, y, buckets):  # type: ignore[no-untyped-def]  # pragma: no cover
    # Primes of Teschner et al. 2003, "Optimized spatial hashing for collision detection".
    return ((x * 73856093) ^ (y * 19349663)) & (buckets - 1)


@numba.njit(cache=True, nogil=True)
def _cross(corners, faces, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    shared, at_a, at_b = 0, 0, 0
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                shared, at_a, at_b = shared + 1, i, j
    if shared > 1:
        return False
    a0, a1, a2 = _from_corner(corners, a, at_a)
    b0, b1, b2 = _from_corner(corners, b, at_b)
    if _pierces(a1, a2, b0, b1, b2) or _pierces(b1, b2, a0, a1, a2):
        return True
    # Edges that start in a common corner cannot pierce the other triangle.
    return shared == 0 and (
        _pierces(a0, a1, b0, b1, b2)
        or _pierces(a2, a0, b0, b1, b2)
        or _pierces(b0, b1, a0, a1, a2)
        or _pierces(b2, b0, a0, a1, a2)
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _from_corner(corners, k, first):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Corners of a triangle in order, starting with one of them."""
    i, j = (first + 1) % 3, (first + 2) % 3
    return (
        (corners[k, first, 0], corners[k, first, 1], corners[k, first, 2]),
        (corners[k, i, 0], corners[k, i, 1], corners[k, i, 2]),
        (corners[k, j, 0], corners[k, j, 1], corners[k, j, 2]),
    )


@numba.njit(cache=True, nogil=True)
def _pierces(start, end, a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether an edge passes through a triangle, by the signs of tetrahedra's volumes."""
    if _volume(a, b, c, start) * _volume(a, b, c, end) >= 0.0:
        return False
    u, v, w = _volume(start, end, a, b), _volume(start, end, b, c), _volume(start, end, c, a)
    return (u > 0.0 and v > 0.0 and w > 0.0) or (u < 0.0 and v < 0.0 and w < 0.0)


@numba.njit(cache=True, nogil=True)
def _volume(a, b, c, d):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Six times the signed volume of a tetrahedron."""
    x0, x1, x2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    y0, y1, y2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    z0, z1, z2 = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    return x0 * (y1 * z2 - y2 * z1) + x1 * (y2 * z0 - y0 * z2) + x2 * (y0 * z1 - y1 * z0)
