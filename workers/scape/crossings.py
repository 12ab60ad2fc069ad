"""Which triangles of a surface cross each other (numba; a grid finds the candidates)."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from workers.scape.deformation import Faces

Array = NDArray[np.float64]

_ROOM_M = 0.02


def crossing_pairs(
    vertices: Array, faces: Faces, asking: NDArray[np.bool_] | None = None
) -> NDArray[np.int32]:
    """Pairs (m, 2) of triangles that cross.

    Triangles with one vertex in common count where they cross beyond it; those with an edge in
    common cannot. Touching is not crossing.

    Args:
        vertices: (P, 3).
        faces: (K, 3).
        asking: (K,): pairs of others are left out; everyone asks by default.
    """
    corners = np.ascontiguousarray(vertices[faces])
    lows, highs = _boxes(corners)
    if asking is None:
        return _crossing_pairs(corners, lows, highs, faces, np.ones(len(faces), bool))
    # What is far from all askers need not be sorted into the fine grid.
    near = np.flatnonzero(_near(lows, highs, asking, _ROOM_M))
    found = _crossing_pairs(corners[near], lows[near], highs[near], faces[near], asking[near])
    return near[found].astype(np.int32)


@numba.njit(cache=True)
def _boxes(corners):  # type: ignore[no-untyped-def]  # pragma: no cover
    lows, highs = corners[:, 0].copy(), corners[:, 0].copy()
    for k in range(len(corners)):
        for i in range(1, 3):
            for c in range(3):
                lows[k, c] = min(lows[k, c], corners[k, i, c])
                highs[k, c] = max(highs[k, c], corners[k, i, c])
    return lows, highs


@numba.njit(cache=True)
def _near(lows, highs, asking, room):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Boxes that share a room of a coarse grid with an asker's box."""
    origin = np.empty(3)
    size = np.empty(3, np.int64)
    for c in range(3):
        origin[c] = lows[:, c].min()
        size[c] = int((highs[:, c].max() - origin[c]) / room) + 1
    occupied = np.zeros((size[0], size[1], size[2]), np.bool_)
    near = asking.copy()
    for marking in (True, False):
        for k in range(len(lows)):
            if asking[k] != marking:
                continue
            first = ((lows[k] - origin) / room).astype(np.int64)
            last = ((highs[k] - origin) / room).astype(np.int64)
            for x in range(first[0], last[0] + 1):
                for y in range(first[1], last[1] + 1):
                    for z in range(first[2], last[2] + 1):
                        if marking:
                            occupied[x, y, z] = True
                        elif occupied[x, y, z]:
                            near[k] = True
    return near


@numba.njit(cache=True)
def _crossing_pairs(corners, lows, highs, faces, asking):  # type: ignore[no-untyped-def]  # pragma: no cover
    count = len(corners)
    extent = 0.0
    for k in range(count):
        for c in range(3):
            extent += highs[k, c] - lows[k, c]
    # About a triangle's size: few cells a triangle, few triangles a cell.
    cell = max(2.0 * extent / (3 * count), 1e-6)
    first = np.empty((count, 3), np.int64)
    last = np.empty((count, 3), np.int64)
    entries = 0
    for k in range(count):
        for c in range(3):
            first[k, c] = int(np.floor(lows[k, c] / cell))
            last[k, c] = int(np.floor(highs[k, c] / cell))
        spans = last[k] - first[k] + 1
        entries += spans[0] * spans[1] * spans[2]
    buckets = 1
    while buckets < 2 * entries:
        buckets *= 2
    start = np.zeros(buckets + 1, np.int64)
    # Two passes: how many entries a bucket has, then the entries.
    triangle = np.empty(entries, np.int32)
    cells = np.empty((entries, 3), np.int64)
    boxes = np.empty((entries, 6))
    for filling in range(2):
        for k in range(count):
            for x in range(first[k, 0], last[k, 0] + 1):
                for y in range(first[k, 1], last[k, 1] + 1):
                    for z in range(first[k, 2], last[k, 2] + 1):
                        bucket = _bucket(x, y, z, buckets)
                        if filling:
                            start[bucket] -= 1
                            entry = start[bucket]
                            triangle[entry] = k
                            cells[entry, 0], cells[entry, 1], cells[entry, 2] = x, y, z
                            boxes[entry, :3], boxes[entry, 3:] = lows[k], highs[k]
                        else:
                            start[bucket] += 1
        if not filling:
            for bucket in range(buckets):
                start[bucket + 1] += start[bucket]
    pairs = []
    for bucket in range(buckets):
        for i in range(start[bucket], start[bucket + 1]):
            a = triangle[i]
            for j in range(i + 1, start[bucket + 1]):
                if (
                    boxes[i, 0] > boxes[j, 3]
                    or boxes[j, 0] > boxes[i, 3]
                    or boxes[i, 1] > boxes[j, 4]
                    or boxes[j, 1] > boxes[i, 4]
                    or boxes[i, 2] > boxes[j, 5]
                    or boxes[j, 2] > boxes[i, 5]
                ):
                    continue
                b = triangle[j]
                if a == b or not (asking[a] or asking[b]):
                    continue
                first_common = True
                for c in range(3):
                    # A pair is looked at in one cell alone: the first that both are in.
                    lowest = max(first[a, c], first[b, c])
                    if cells[i, c] != lowest or cells[j, c] != lowest:
                        first_common = False
                        break
                if first_common and _cross(corners, faces, a, b):
                    pairs.append((min(a, b), max(a, b)))
    out = np.empty((len(pairs), 2), np.int32)
    for row in range(len(pairs)):
        out[row, 0], out[row, 1] = pairs[row]
    return out


@numba.njit(cache=True, inline="always")
def _bucket(x, y, z, buckets):  # type: ignore[no-untyped-def]  # pragma: no cover
    # The primes of Teschner et al. 2003, "Optimized spatial hashing for collision detection".
    return ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & (buckets - 1)


@numba.njit(cache=True)
def _cross(corners, faces, a, b):  # type: ignore[no-untyped-def]  # pragma: no cover
    shared, at_a, at_b = 0, 0, 0
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                shared, at_a, at_b = shared + 1, i, j
    if shared > 1:
        return False
    if shared == 1:
        return _pierces(corners, a, (at_a + 1) % 3, b) or _pierces(corners, b, (at_b + 1) % 3, a)
    found = False
    for i in range(3):
        found = found or _pierces(corners, a, i, b) or _pierces(corners, b, i, a)
    return found


@numba.njit(cache=True)
def _pierces(corners, k, start, triangle):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether an edge of triangle k goes through a triangle: by the signs of volumes."""
    a0, a1, a2 = _seen_from(corners, k, start, triangle, 0)
    b0, b1, b2 = _seen_from(corners, k, start, triangle, 1)
    c0, c1, c2 = _seen_from(corners, k, start, triangle, 2)
    end = (start + 1) % 3
    d0 = corners[k, end, 0] - corners[k, start, 0]
    d1 = corners[k, end, 1] - corners[k, start, 1]
    d2 = corners[k, end, 2] - corners[k, start, 2]
    # Volumes of the edge's start with the triangle, and of the edge with the triangle's edges.
    ab0, ab1, ab2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    bc0, bc1, bc2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    ca0, ca1, ca2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
    u = d0 * ab0 + d1 * ab1 + d2 * ab2
    v = d0 * bc0 + d1 * bc1 + d2 * bc2
    w = d0 * ca0 + d1 * ca1 + d2 * ca2
    if not ((u > 0.0 and v > 0.0 and w > 0.0) or (u < 0.0 and v < 0.0 and w < 0.0)):
        return False
    before = ab0 * c0 + ab1 * c1 + ab2 * c2
    # The edge's line goes through; where it does, as a share of the edge: before / (u + v + w).
    share = before / (u + v + w)
    return 0.0 < share < 1.0


@numba.njit(cache=True, inline="always")
def _seen_from(corners, k, start, triangle, corner):  # type: ignore[no-untyped-def]  # pragma: no cover
    return (
        corners[triangle, corner, 0] - corners[k, start, 0],
        corners[triangle, corner, 1] - corners[k, start, 1],
        corners[triangle, corner, 2] - corners[k, start, 2],
    )
