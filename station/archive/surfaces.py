"""Meshes and clouds of results, and distances between surfaces. Pure but for reading."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.core.errors import FormatError
from station.core.files import read_regular

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
_NEIGHBOURS = 4
"""Triangles of so many near vertices: the nearest point lies on one of them."""
_TRIMMED = 0.7
"""The share of the body that is aligned: arms in a different position must not affect it."""
_ROUNDS = 12
_MAX_BYTES = 1 << 26
"""A result's mesh has 0.3 MB."""
_VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


@dataclass(frozen=True, slots=True)
class Surface:
    """A triangle mesh."""

    vertices: Array
    """(n, 3) metres, world frame."""
    faces: Faces
    """(m, 3)"""


def read_mesh(path: Path) -> Surface:
    """A result's mesh.ply.

    Raises:
        FormatError: it is missing, or not a binary PLY of triangles.
    """
    try:
        data = read_regular(path, _MAX_BYTES)
        head, _, body = data.partition(b"end_header\n")
        words = (line.split() for line in head.splitlines())
        counts = {line[1]: int(line[2]) for line in words if line[:1] == [b"element"]}
        vertices, faces = counts[b"vertex"], counts[b"face"]
        corners = np.frombuffer(body, _FACE, faces, vertices * _VERTEX.itemsize)
        points = np.frombuffer(body, _VERTEX, vertices)
        if faces and not 0 <= corners["corners"].min() <= corners["corners"].max() < vertices:
            raise ValueError("a corner is no vertex")
    except OSError:
        raise FormatError(f"{path.parent.name} has no {path.name}") from None
    except (KeyError, IndexError, ValueError, OverflowError) as cause:
        raise FormatError(
            f"{path.name} of {path.parent.name} is not a mesh that this program wrote ({cause})"
        ) from None
    stacked = np.stack([points["x"], points["y"], points["z"]], axis=1)
    return Surface(stacked.astype(np.float64), corners["corners"].copy())


def aligned(moving: Surface, target: Surface) -> Surface:
    """A surface rigidly aligned to another one.

    Both have one template's topology, so their vertices correspond: Kabsch's rotation, least
    squares over the 70 % that lie nearest (trimmed, after Chetverikov et al. 2002). Surfaces of
    different topology stay where they are.
    """
    if moving.vertices.shape != target.vertices.shape:
        return moving
    points = moving.vertices
    kept = np.ones(len(points), bool)
    for _ in range(_ROUNDS):
        here, there = points[kept].mean(axis=0), target.vertices[kept].mean(axis=0)
        u, _, vt = np.linalg.svd((points[kept] - here).T @ (target.vertices[kept] - there))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        points = (points - here) @ (u @ flip @ vt) + there
        off = np.linalg.norm(points - target.vertices, axis=1)
        kept = off <= np.quantile(off, _TRIMMED)
    return Surface(points, moving.faces)


def distances(surface: Surface, other: Surface) -> Array:
    """Signed distance (n,) in metres of each vertex to another surface: positive outside it."""
    # A fifth of the console's start, which has to be back within seconds.
    from scipy.spatial import cKDTree

    corners = other.vertices[other.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around = _faces_around(other)
    _, near = cKDTree(other.vertices).query(surface.vertices, k=_NEIGHBOURS)
    best = np.full(len(surface.vertices), np.inf)
    signed = np.zeros(len(surface.vertices))
    for neighbour in range(_NEIGHBOURS):
        for faces in around[near[:, neighbour]].T:
            offset = surface.vertices - _nearest_on(corners[faces], surface.vertices)
            square = np.einsum("ni,ni->n", offset, offset)
            nearer = (square < best) & (faces >= 0)
            best[nearer] = square[nearer]
            side = np.einsum("ni,ni->n", offset, normals[faces])
            signed[nearer] = np.copysign(np.sqrt(square), side)[nearer]
    return signed


def _faces_around(surface: Surface) -> Faces:
    """(n, k): faces that meet in each vertex, -1 where there are fewer."""
    vertex = surface.faces.ravel()
    face = np.repeat(np.arange(len(surface.faces), dtype=np.int32), 3)
    order = np.argsort(vertex, kind="stable")
    vertex, face = vertex[order], face[order]
    counts = np.bincount(vertex, minlength=len(surface.vertices))
    position = np.arange(len(vertex)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.full((len(surface.vertices), int(counts.max())), -1, np.int32)
    table[vertex, position] = face
    return table


def _nearest_on(triangles: Array, points: Array) -> Array:
    """The nearest points (n, 3) of triangles (n, 3, 3): within, or on the nearest edge.

    Ericson, "Real-Time Collision Detection" (2005), 5.1.5.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = np.maximum(d00 * d11 - d01 * d01, 1e-30)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    nearest = a + v[:, None] * ab + w[:, None] * ac
    outside = (v < 0) | (w < 0) | (v + w > 1)
    best = np.where(outside, np.inf, 0.0)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        share = np.clip(_dot(points - start, along) / np.maximum(_dot(along, along), 1e-30), 0, 1)
        candidate = start + share[:, None] * along
        away = _dot(points - candidate, points - candidate)
        take = outside & (away < best)
        nearest[take], best[take] = candidate[take], away[take]
    return nearest


def _dot(one: Array, other: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", one, other))
