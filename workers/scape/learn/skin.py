"""The outer skin of a body mesh: what lies behind lips and lids is cut off, the gaps are closed.

A generated body is closed, but its surface runs on through mouth and eyelids to hulls inside the
head. No sensor sees them, and a volume or a print of the mesh would be wrong.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from workers.scape.model.deformation import Array, Faces, vertex_normals
from workers.scape.surface.crossings import crossing_pairs

_DIRECTIONS = 400
_HIDDEN = 0.05
"""A vertex from which fewer than this share of all directions lead outside is hidden."""
_MIN_CAVITY = 100
"""Vertices; smaller folds (nostrils, ears, between the toes) are skin."""
_OFF_SURFACE_M = 1e-4
_STEP_M = 1e-4
_MAX_STEPS = 60
_BEND = 0.3
"""Cost of bending by one radian, against the triangles' area, when a gap is closed."""

Edges = NDArray[np.int64]


def outer_skin(
    vertices: Array, faces: Faces, mirror: NDArray[np.int32]
) -> tuple[NDArray[np.intp], Faces]:
    """The vertices (n,) of a closed mesh (P, 3) to keep, and the triangles (K, 3) between them.

    `mirror` (P,) is the vertex on the other side: what goes on one side goes on both.
    """
    hidden = _openness(vertices, faces) < _HIDDEN
    hidden &= hidden[mirror]
    hidden = _large_pieces(faces, hidden)
    while True:
        kept = faces[~hidden[faces].any(axis=1)]
        tail = _boundary(kept)[:, 0]
        pinched = np.flatnonzero(np.bincount(tail, minlength=len(vertices)) > 1)
        if not len(pinched):
            break
        hidden[pinched] = hidden[mirror[pinched]] = True
    closed = [kept, *(_filled(vertices, loop) for loop in _loops(_boundary(kept)))]
    found = np.concatenate(closed)
    used = np.unique(found)
    index = np.zeros(len(vertices), np.int32)
    index[used] = np.arange(len(used))
    return used, index[found]


def separated(vertices: Array, faces: Faces, mirror: NDArray[np.int32]) -> Array:
    """The mesh (P, 3) drawn in by fractions of a millimetre where it runs through itself.

    Between the toes of a mean body, for instance; `mirror` as in `outer_skin`.
    """
    apart = vertices.copy()
    for _ in range(_MAX_STEPS):
        pairs = crossing_pairs(apart, faces)
        if not len(pairs):
            break
        moved = np.zeros(len(apart), bool)
        moved[faces[pairs]] = True
        moved |= moved[mirror]
        apart[moved] -= _STEP_M * vertex_normals(apart, faces)[moved]
    return apart


def _openness(vertices: Array, faces: Faces) -> Array:
    """Share (P,) of all directions that lead from a vertex outside without meeting the mesh."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    start = vertices + _OFF_SURFACE_M * vertex_normals(vertices, faces)
    free = np.zeros(len(vertices))
    for direction in _even_directions(_DIRECTIONS):
        rays = np.concatenate([start, np.tile(direction, (len(start), 1))], axis=1)
        found = scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
        free += ~np.isfinite(found["t_hit"].numpy())
    return free / _DIRECTIONS


def _even_directions(count: int) -> Array:
    """Unit vectors (count, 3) on a Fibonacci spiral."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    around = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(around), radius * np.sin(around), height], axis=1)


def _large_pieces(faces: Faces, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The chosen vertices (P,) that hang together with many others."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    both = chosen[tail] & chosen[head]
    links = sp.coo_matrix(
        (np.ones(both.sum()), (tail[both], head[both])), shape=(len(chosen), len(chosen))
    )
    _, piece = connected_components(links, directed=False)
    return np.asarray(chosen & (np.bincount(piece)[piece] >= _MIN_CAVITY))


def _boundary(faces: Faces) -> Edges:
    """Directed edges (n, 2) that one triangle alone has."""
    tail, head = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    count = int(faces.max()) + 1
    alone = ~np.isin(tail * count + head, head * count + tail)
    return np.stack([tail[alone], head[alone]], axis=1)


def _loops(boundary: Edges) -> list[NDArray[np.int64]]:
    """Closed chains of vertices, each in the direction in which its gap's triangles turn."""
    before = dict(boundary[:, ::-1].tolist())
    loops = []
    while before:
        start, current = before.popitem()
        loop = [start]
        while current != start:
            loop.append(current)
            current = before.pop(current)
        loops.append(np.array(loop))
    return loops


def _filled(vertices: Array, loop: NDArray[np.int64]) -> Faces:
    """Triangles (n - 2, 3) over a gap with rim (n,): the least area, and little bending.

    Dynamic programme over the rim's sections (Barequet & Sharir 1995).
    """
    rim = vertices[loop]
    count = len(loop)
    spread = float(np.square(rim - rim.mean(axis=0)).mean())
    cost = np.zeros((count, count))
    apex = np.zeros((count, count), np.intp)
    normal = np.zeros((count, count, 3))
    for length in range(2, count):
        for first in range(count - length):
            last = first + length
            middle = np.arange(first + 1, last)
            cross = np.cross(rim[middle] - rim[first], rim[last] - rim[first])
            size = np.linalg.norm(cross, axis=1)
            unit = cross / np.maximum(size, 1e-12)[:, None]
            bend = np.zeros(len(middle))
            for side in (normal[first, middle], normal[middle, last]):
                known = np.linalg.norm(side, axis=1) > 0.5
                cosine = np.clip(np.einsum("ni,ni->n", unit, side), -1.0, 1.0)
                bend += np.where(known, np.arccos(cosine), 0.0)
            total = cost[first, middle] + cost[middle, last] + 0.5 * size + _BEND * spread * bend
            best = int(np.argmin(total))
            cost[first, last], apex[first, last] = total[best], middle[best]
            normal[first, last] = unit[best]
    triangles = []
    sections = [(0, count - 1)]
    while sections:
        start, end = sections.pop()
        if end - start < 2:
            continue
        tip = int(apex[start, end])
        triangles.append((start, tip, end))
        sections += [(start, tip), (tip, end)]
    return np.asarray(loop[np.array(triangles)], dtype=np.int32)
