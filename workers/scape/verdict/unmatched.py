"""Patches of the scan that the fitted surface does not explain.

A limb that the fit lost leaves a coherent patch of readings centimetres from the surface. Shares of
points say less: they mix a lost hand with the folds and the stray readings of a sound scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from workers.cloud.observed import PointCloud
from workers.scape.model.body_model import BodyModel
from workers.scape.surface.attachment import attached

Array = NDArray[np.float64]

_CELL_M = 0.02
"""Points are thinned to one for each cube of this size; cubes that touch are connected."""
_MAX_CELLS = 4_000_000
"""A cloud that fills a larger grid (20 x 2 x 2 m) is no body and has no patches."""
FAR_M = 0.015
"""Distance from which a point is not explained: the folds of real people stay below it."""
ELSEWHERE_M = 0.15
"""Distance of a patch from which it is no limb of the person but something else."""
_SHARE_OF_PATCH = 0.2
"""A patch is of every part that is nearest to at least so much of it."""
_MIN_WIDENED_M2 = 0.0012
"""Area from which a patch is more than stray readings and folds: sound scans of the model's own
family leave 2 cm^2 at most, those of other people 11."""
_WIDENED_RINGS = 3
"""Rings of vertices around those next to a patch, whose points are thinned."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Connected part of the scan that lies farther than 15 mm from the surface."""

    area_m2: float
    distance_m: float
    """Median distance to the surface."""
    parts: tuple[int, ...]
    """Indices of the model's parts that are nearest to it, the most frequent first."""
    vertices: NDArray[np.intp]
    """Vertices that are nearest to its points."""


def unmatched_patches(model: BodyModel, vertices: Array, cloud: PointCloud) -> tuple[Patch, ...]:
    """Patches of a cloud that a surface (P, 3) does not explain, the largest first."""
    cells = np.floor((cloud.points - cloud.points.min(axis=0)) / _CELL_M).astype(np.int64) + 1
    shape = tuple(int(n) for n in cells.max(axis=0) + 2)
    if np.prod(shape, dtype=np.float64) > _MAX_CELLS:
        return ()
    of_point = np.ravel_multi_index(tuple(cells.T), shape)
    # The first point of each cube; assignments to one place leave the last.
    first = np.full(np.prod(shape), -1)
    first[of_point[::-1]] = np.arange(len(cells))[::-1]
    cell = np.flatnonzero(first >= 0)
    chosen = first[cell]
    points = cloud.points[chosen]
    _, near = cKDTree(vertices, balanced_tree=False).query(points)
    places = attached(model, vertices, points, near)
    away = np.linalg.norm(points - places.of(vertices, model.faces), axis=1)
    far = np.flatnonzero(away > FAR_M)
    occupied = np.zeros(shape, bool)
    occupied.flat[cell[far]] = True
    labels, count = ndimage.label(occupied, structure=np.ones((3, 3, 3)))
    label = labels.flat[cell[far]]
    # A plane of this normal meets so many cells per square metre.
    area = _CELL_M**2 / np.abs(cloud.normals[chosen[far]]).sum(axis=1)
    part = model.part_of_vertex[near[far]]
    patches = [
        Patch(
            float(area[label == index].sum()),
            float(np.median(away[far][label == index])),
            _parts_of(part[label == index]),
            np.unique(near[far][label == index]),
        )
        for index in range(1, count + 1)
    ]
    return tuple(sorted(patches, key=lambda patch: -patch.area_m2))


def patch_sigma_m(model: BodyModel, patches: Sequence[Patch]) -> Array:
    """Standard deviations (P,) that unmatched patches add around them: there the skin is as far off
    as the patch, metres."""
    found = np.zeros(model.vertex_count)
    for patch in patches:
        if patch.area_m2 < _MIN_WIDENED_M2 or patch.distance_m > ELSEWHERE_M:
            continue
        around = np.zeros(len(found))
        around[patch.vertices] = 1.0
        for _ in range(_WIDENED_RINGS):
            around += model.adjacency @ around
        near = around > 0.0
        found[near] = np.hypot(found[near], patch.distance_m)
    return found


def _parts_of(part: NDArray[np.int32]) -> tuple[int, ...]:
    counts = np.bincount(part)
    order = np.argsort(-counts, kind="stable")
    return tuple(int(p) for p in order if counts[p] >= _SHARE_OF_PATCH * len(part))
