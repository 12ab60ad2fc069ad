"""Hair that stands off the head, and caps: what they hide, and how much larger they make a head.

A bun, a ponytail or a beard lies beside the fitted head, and the next scan would show it again.
Thick hair and caps lie all around it, and the surface follows them: what it gives for the head, and
for the stature, is that of the hair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from workers.cloud.observed import PointCloud
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.verdict.unmatched import Patch

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BROW_LEVELS, NAPE_LEVELS = (0.58, 0.70), (0.25, 0.6)
"""Levels of the brow and of the back of the head below it, as shares of the head's height."""
_FACE_LEVELS = (0.30, 0.75)
_FACING = 0.5
"""Least component to the front or the back of the normals of what faces there."""
_FACE_OFF_M = 3.3e-3
"""Distance of the points from the face, rms, beyond their noise, from which the head was not found.
With hair of eight kinds on three bodies the face is 0.6 to 1.3 mm off, 2.7 to 4.2 where hair covers
its sides, 5 and more where an afro was taken for the head."""
_FACE_REACH_M = 0.03
_LEAST_FACE_POINTS = 200
_NEXT_TO_HEAD = ("head", "neck", "chest", "shoulder_left", "shoulder_right")
"""Parts that hair lies on."""
_FARTHEST_M = 0.09
"""Distance of a patch from which it is not hair: a bun's is 74 mm at most."""
_LARGEST_M2 = 0.04
"""Area of a patch from which it is not hair: long hair has 330 cm^2, an arm beside the head that
the fit lost 430 to 1,890."""
_HEAD_GIRTH_M, _HEAD_GIRTH_SIGMA_M = 0.567, 0.020
"""Mean and spread of the girth at the brow. Of 6,068 people (ANSUR II, 2012) the head's girth has
570 and 18 mm, of the model's own family 567 and 20."""
_HAIRY_SHARE = 0.65
"""Share of that girth that hair covers: not the forehead."""
_BESIDE_FACE_M = 0.09
"""Distance from the middle of the template's body where its face ends."""
_LARGEST_GIRTH_M = 0.645
"""Larger heads are covered: the largest of the 6,068 people has 635 mm."""
_BEYOND_MODEL_M = 0.0065
"""Girth of the surface beyond the model's own from which a head is covered: -6 to 4.2 mm in 136
scans of the family and of sculpted bodies, 9 to 56 where 1 to 3 cm of hair cover it."""
_ALL_AROUND_M = 0.006
"""The same by the median distance between both beside and behind the forehead: 7 to 84 mm with such
hair, at most 5.5 with buns, 3.2 with ponytails on sculpted bodies."""


@dataclass(frozen=True, slots=True)
class Hair:
    """Patches of a scan that are hair and no part of the body."""

    on_head: tuple[Patch, ...] = ()
    """On the head alone, and beards: another scan would show them again."""
    hanging: tuple[Patch, ...] = ()
    """On neck or shoulders, which it hides, and could be tied up."""


def zone_of_head(model: BodyModel, levels: tuple[float, float], side: float) -> Mask:
    """Mask (P,) of what faces the front (1) or the back (-1) between two levels of the head."""
    ahead = -vertex_normals(model.mean, model.faces)[:, 1]
    return np.asarray(_band_of_head(model, levels) & (side * ahead > _FACING))


def _band_of_head(model: BodyModel, levels: tuple[float, float]) -> Mask:
    head = model.of_parts(("head",))
    height = model.mean[:, 2]
    level = (height - height[head].min()) / np.ptp(height[head])
    return np.asarray(head & (level > levels[0]) & (level < levels[1]))


def hair_of(model: BodyModel, patches: Sequence[Patch], vertices: Array, cloud: PointCloud) -> Hair:
    """Those patches beside a fitted surface (P, 3) that are hair.

    A head that the fit lost leaves patches, too; but then its points do not lie on the face.
    """
    parts = {model.part_names.index(name) for name in _NEXT_TO_HEAD}
    head, neck = model.part_names.index("head"), model.part_names.index("neck")
    beside = [
        patch
        for patch in patches
        if parts.issuperset(patch.parts)
        and patch.distance_m < _FARTHEST_M
        and patch.area_m2 < _LARGEST_M2
        and np.isin(model.part_of_vertex[patch.vertices], (head, neck)).any()
    ]
    if not beside or not _has_face(model, vertices, cloud):
        return Hair()
    on_head = tuple(p for p in beside if p.parts == (head,) or _is_beard(model, p))
    return Hair(on_head, hanging=tuple(p for p in beside if p not in on_head))


def _is_beard(model: BodyModel, patch: Patch) -> bool:
    """Whether a patch begins at the head, and all skin next to it is in front and below the face:
    long hair lies beside it, straps begin at the neck."""
    if model.part_names.index("head") not in patch.parts:
        return False
    ahead = -vertex_normals(model.mean, model.faces)[patch.vertices, 1]
    across = np.abs(model.mean[patch.vertices, 0])
    return bool(ahead.mean() > 0.0 and across.max() < _BESIDE_FACE_M)


def _has_face(model: BodyModel, vertices: Array, cloud: PointCloud) -> bool:
    """Whether the points lie on the face of a fitted surface (P, 3)."""
    face = vertices[zone_of_head(model, _FACE_LEVELS, 1.0)]
    near = (cloud.points > face.min(axis=0)) & (cloud.points < face.max(axis=0))
    found = np.flatnonzero(near.all(axis=1))
    away, vertex = cKDTree(vertices).query(cloud.points[found], distance_upper_bound=_FACE_REACH_M)
    paired = np.isfinite(away)
    if paired.sum() < _LEAST_FACE_POINTS:
        return False
    found, vertex = found[paired], vertex[paired]
    normals = vertex_normals(vertices, model.faces)[vertex]
    off = np.einsum("ni,ni->n", cloud.points[found] - vertices[vertex], normals)
    return bool(np.mean(off**2) < _FACE_OFF_M**2 + cloud.excess_noise_m**2)


def head_cover_m(
    model: BodyModel, vertices: Array, reference: Array | None, rotations: Array
) -> float:
    """Thickness at most (95 %) of hair or a cap all around a head, metres; 0 where there is none.

    Args:
        vertices: (P, 3), the fitted surface.
        reference: (P, 3), the model's own surface before it; None where there is none.
        rotations: (L, 3, 3), the parts' rotations from the neutral pose to the world.
    """
    brow = _band_of_head(model, BROW_LEVELS)
    level_of_head = rotations[model.part_names.index("head")][:, :2]

    def girth_m(surface: Array) -> float:
        # Of points in a plane, qhull's area is the perimeter.
        return float(ConvexHull(surface[brow] @ level_of_head).area)

    girth = girth_m(vertices)
    covered = girth > _LARGEST_GIRTH_M
    if not covered and reference is not None and girth - girth_m(reference) > _BEYOND_MODEL_M:
        # A bun makes one side larger, hair all of it but the forehead.
        normals = vertex_normals(reference, model.faces)
        out_m = np.einsum("ni,ni->n", vertices - reference, normals)
        hairy = brow & ~zone_of_head(model, BROW_LEVELS, 1.0)
        covered = 2.0 * np.pi * float(np.median(out_m[hairy])) > _ALL_AROUND_M
    if not covered:
        return 0.0
    smallest = _HEAD_GIRTH_M - 2.0 * _HEAD_GIRTH_SIGMA_M
    return max(0.0, girth - smallest) / (2.0 * np.pi * _HAIRY_SHARE)
