"""Normals of a bare cloud that point out of the body: the file's, or estimated ones."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_NORMAL_NEIGHBOURS = 24
"""Neighbours that a normal is estimated from."""
_UNIT = 0.01
"""Deviation from 1 of a normal's length in a file: formats round to a few digits."""
_ACROSS = 0.8
"""Median cosine between a file's normals and those of its points' surroundings from which on they
are the skin's: 0.97 where 1500 points show a body, 0.88 if they were turned by 30 degrees."""
_COMPARED = 5000
"""Points whose normals are looked at."""
_ONE_SIDE = 0.75
"""Share of a file's normals that point to one side of the skin where a program oriented them: 0.84
of those of half a body seem to, and half of those that no program oriented, or one towards a single
camera."""
_ORIENTED = 25_000
"""Points whose normals are oriented; the others follow the nearest of them."""
_DIRECTIONS = 40
"""Directions, evenly around, from which a cloud is looked at."""
_PIXEL_M = 0.015
"""Pixels of these pictures: points are 5 to 8 mm apart."""
_HIDDEN_M = 0.02
"""Depth behind the nearest of the pixels around it from which a point is hidden: that of slanted
skin, and less than a hand is thick."""
_FOOT_M = 0.12
"""Height of a foot."""
_LINKS, _SPREAD_ROUNDS = 8, 150
"""Neighbours that evidence is shared with, and how often: points are 5 to 8 mm apart, so that it
comes 10 cm far."""
_SAME_SKIN = 0.6
"""Largest sine of the slope from a point to a neighbour on the same skin, and the least cosine of
their normals."""


def outward_normals(cloud: o3d.geometry.PointCloud) -> Array:
    """Unit normals (n, 3) of a body's points that point out of it.

    Those of the cloud are kept where they are the skin's. If they point out of it here and into it
    there, as where a program estimated them and did not orient them, each is oriented.
    """
    points = np.asarray(cloud.points)
    if not (_has_unit_normals(cloud) and _across_skin(points, np.asarray(cloud.normals))):
        # Open3D turns what it estimates towards normals that are there.
        cloud.normals = o3d.utility.Vector3dVector()
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
        return oriented(points, np.asarray(cloud.normals))
    normals = np.asarray(cloud.normals)
    some = slice(None, None, max(1, len(points) // _COMPARED))
    out = np.einsum("ni,ni->n", oriented(points[some], normals[some]), normals[some]) > 0.0
    if 1.0 - _ONE_SIDE < out.mean() < _ONE_SIDE:
        return oriented(points, normals)
    return normals if out.mean() > 0.5 else -normals


def _has_unit_normals(cloud: o3d.geometry.PointCloud) -> bool:
    """Whether every point has a direction: programs that know none write zeros."""
    lengths = np.linalg.norm(np.asarray(cloud.normals), axis=1)
    return cloud.has_normals() and bool((np.abs(lengths - 1.0) < _UNIT).all())


def _across_skin(points: Array, normals: Array) -> bool:
    """Whether a file's normals are those of its points: some programs turn the points alone."""
    some = slice(None, None, max(1, len(points) // _COMPARED))
    around = points[cKDTree(points).query(points[some], _NORMAL_NEIGHBOURS, workers=-1)[1]]
    offsets = around - around.mean(axis=1, keepdims=True)
    thinnest = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]
    return bool(np.median(np.abs(np.einsum("ni,ni->n", thinnest, normals[some]))) > _ACROSS)


def oriented(points: Array, normals: Array) -> Array:
    """Normals (n, 3) of a body's points (n, 3), each oriented to where the skin around it is seen
    from.
    """
    chosen = slice(None, None, max(1, len(points) // _ORIENTED))
    places, directions = points[chosen], normals[chosen]
    tree = cKDTree(places)
    evidence = _spread(tree, directions, _evidence(points, places, directions))
    mine = np.where(evidence < 0.0, -1.0, 1.0)[:, None] * directions
    mine = mine[tree.query(points, workers=-1)[1]]
    agrees = np.einsum("ni,ni->n", mine, normals) >= 0.0
    return np.where(agrees[:, None], normals, -normals)


def _spread(tree: cKDTree, directions: Array, evidence: Array) -> Array:
    """Evidence (n,) of a tree's points, spread along the skin: neighbours whose directions are
    alike share it, and where they are opposite it changes its sign.
    """
    neighbours = tree.query(tree.data, _LINKS + 1, workers=-1)[1][:, 1:]
    offsets = tree.data[neighbours] - tree.data[:, None]
    across = np.abs(np.einsum("ni,nki->nk", directions, offsets))
    cosine = np.einsum("ni,nki->nk", directions, directions[neighbours])
    # Skin that touches other skin lies along the normal from it.
    one_skin = across < _SAME_SKIN * np.linalg.norm(offsets, axis=2)
    link = np.where(one_skin & (np.abs(cosine) > _SAME_SKIN), cosine, 0.0)
    tail = np.repeat(np.arange(tree.n), _LINKS)
    graph = csr_matrix((link.ravel() / _LINKS, (tail, neighbours.ravel())), shape=(tree.n, tree.n))
    found = evidence
    for _ in range(_SPREAD_ROUNDS):
        found = evidence + graph @ found
    return np.asarray(found)


def _evidence(points: Array, places: Array, directions: Array) -> Array:
    """Evidence (n,) that directions (n, 3) at places (n, 3) of a cloud point out of the body;
    negative where they point into it.

    Whoever sees a place looks at the skin's outside. A foot stands on a floor, which hides its
    inside from below.
    """
    low_m = float(points[:, 2].min())
    floor = points[points[:, 2] < low_m + _FOOT_M] * (1.0, 1.0, 0.0) + (0.0, 0.0, low_m)
    seen = np.concatenate([points, floor])
    found = np.zeros(len(places))
    for towards in _evenly_around(_DIRECTIONS):
        across = np.linalg.svd(towards[None])[2][1:].T
        corner = (seen @ across).min(axis=0) - _PIXEL_M
        pixel = ((seen @ across - corner) / _PIXEL_M).astype(np.int64)
        nearest = np.full(pixel.max(axis=0) + 2, -np.inf)
        np.maximum.at(nearest, tuple(pixel.T), seen @ towards)
        nearest = ndimage.maximum_filter(nearest, 3)
        mine = ((places @ across - corner) / _PIXEL_M).astype(np.int64)
        visible = places @ towards > nearest[tuple(mine.T)] - _HIDDEN_M
        found += visible * (directions @ towards)
    return found


def _evenly_around(count: int) -> Array:
    """Unit vectors (count, 3) on a spiral of equal steps in height (Fibonacci's lattice)."""
    step = np.arange(count) + 0.5
    turn, height = np.pi * (3.0 - np.sqrt(5.0)) * step, 1.0 - 2.0 * step / count
    level = np.sqrt(1.0 - height**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), height])
