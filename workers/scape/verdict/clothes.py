"""Loose clothing, which hides the body and is measured as part of it.

The model follows cloth as it follows skin: a T-shirt makes a heavier person, whose girths are wrong
by 5 to 20 cm. What few bodies have is the edge where cloth ends: a step to the skin below it, most
of the way around, at the same level on the left and on the right. Beside a band that presses into
flesh the skin comes out again; below cloth it does not. And where cloth hangs over the hips, the
model follows them far worse than the head.

Heavy flesh of trunk and legs can hang over an edge all around, too. One sign there is therefore a
remark; a sleeve's edge, or signs at two of arms, legs and trunk, are a reason to scan again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree

from workers.cloud.observed import PointCloud
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.displacement import SurfaceFit
from workers.scape.verdict.seen import TRUNK, thinned

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Limb = Literal["arm", "leg"]

_LIMBS: dict[Limb, tuple[str, ...]] = {
    "arm": ("shoulder", "upper_arm", "forearm", "hand"),
    "leg": ("thigh", "shin", "foot"),
}
"""Parts of a limb, outwards. A leg goes on upwards with its half of the trunk."""
_SIDES = ("left", "right")
_POINTS = 20_000
_REACH_M = 0.08
_BIN_M, _BINS = 0.01, 200
_SECTORS, _LEAST_SECTORS = 12, 6
_COMPARED_BINS = 3
"""Bins above an edge, and below it, whose means are compared."""
_SLANT_BINS, _UNEVEN_BINS = 5, 3
"""Bins within which an edge lies all around, and within which both sides' edges do."""
_AROUND = 0.3
"""Share of the sectors that an edge may leave out."""
_LASTING_BINS, _LASTING_SHARE = 4, 0.5
"""Bins below an edge within which the skin must not come out again, and the share of the step that
must be left of it: beside bands that press 4 to 8 mm into flesh at most 0.28 is left, below hems
0.26 to 1. Of a share that is less, so much less of the step counts."""
_STEP_M, _SLEEVE_M = 0.0038, 0.0065
"""Step from which an edge may be one of clothing, and from which one around both arms is a
sleeve's: lipoedema of 1.5 to 2 cm above both elbows has 4.2 to 4.6 mm, sleeves have 4 to 23."""
_REGIONS = (
    ("pelvis",), ("head",), ("chest",), ("abdomen",),
    *((f"{part}_left", f"{part}_right") for part in ("upper_arm", "forearm", "thigh", "shin")),
)  # fmt: skip
"""Parts whose misfits are compared: the hips, then the head, which is bare."""
_HIPS_M, _HIPS_TO_HEAD = 0.0055, 3.5
"""Misfit of the hips, also relative to the head's, from which clothing may hang over them: of 36
dressed people 6.4 mm and 3.8 times and more, of bare ones at most 4.6 mm."""
_TO_HEAD = 2.5
"""Misfit, relative to the head's, from which a region is covered too if anything is."""
_THICKNESS_TO_STEP, _THICKNESS_TO_MISFIT = 6.0, 2.5
"""Thickness at most (95 %) of cloth over the skin, in steps at its edge and in the hips' misfit."""
_THICKEST_M = 0.04
"""The same where the step is large: garments are up to 25 cm wider than the body."""
_PLURALS = {
    "chest": "chest", "abdomen": "waist", "pelvis": "hips", "thigh": "thighs", "shin": "shins",
    "foot": "feet", "shoulder": "shoulders", "upper_arm": "upper arms", "forearm": "forearms",
    "hand": "hands",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Clothing:
    """Sign of clothing: an edge around both limbs of a pair or around the trunk, or loose hips."""

    at: str
    """Part that shows it, without its side."""
    covered: tuple[str, ...]
    """Parts that it may hide."""
    thickness_m: float
    """Thickness at most (95 %) of the cloth over the skin."""
    is_sure: bool = False
    """Whether this sign is enough."""


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    """Limb of one side, straight in the template. P vertices."""

    mask: Mask
    axis: Array
    """(3,), outwards."""
    along_m: Array
    """(P,), from the middle of the bins."""
    sector: NDArray[np.intp]
    """(P,), by the direction from the axis."""


def clothing_signs(
    model: BodyModel,
    reference: Array | None,
    rotations: Array,
    surface: SurfaceFit,
    cloud: PointCloud,
) -> list[Clothing]:
    """Signs of clothing in a scan.

    Args:
        reference: (P, 3), the model's own surface; None where there is none, and no sign is found.
        rotations: (L, 3, 3), the parts' rotations from the neutral pose to the world.
        surface: fitted to the cloud.
    """
    if reference is None:
        return []
    normals = vertex_normals(reference, model.faces)
    moved_m = np.einsum("ni,ni->n", surface.vertices - reference, normals)
    misfits_m = _misfits(model, moved_m, surface.seen)
    loose = [
        part
        for parts, misfit_m in zip(_REGIONS, misfits_m, strict=True)
        for part in parts
        if misfit_m > _TO_HEAD * misfits_m[1]
    ]
    # A shirt hangs over the hips, too: without that, an edge around both arms is muscles or flesh.
    bare_hips = misfits_m[0] < _HIPS_M
    signs = [*_loose_hips(misfits_m), *_hems(model, reference, normals, rotations, cloud)]
    return [
        replace(sign, covered=tuple(dict.fromkeys((*TRUNK, *sign.covered, *loose))))
        for sign in signs
        if sign.is_sure or not (bare_hips and sign.at in _LIMBS["arm"])
    ]


def _misfits(model: BodyModel, moved_m: Array, seen: Mask) -> Array:
    """Distances of the surface from the model's own, rms by region; NaN for what was not seen.

    Args:
        moved_m: (P,), along the normals.
    """
    regions = [model.of_parts(parts) & seen for parts in _REGIONS]
    return np.array(
        [np.sqrt(np.mean(moved_m[region] ** 2)) if region.any() else np.nan for region in regions]
    )


def _loose_hips(misfits_m: Array) -> list[Clothing]:
    """Hips that the model follows far worse than the head."""
    hips_m, head_m = (float(misfit_m) for misfit_m in misfits_m[:2])
    if not hips_m > _HIPS_M or hips_m < _HIPS_TO_HEAD * head_m:
        return []
    thighs = ("thigh_left", "thigh_right")
    return [Clothing("pelvis", thighs, min(_THICKNESS_TO_MISFIT * hips_m, _THICKEST_M))]


def _hems(
    model: BodyModel, reference: Array, normals: Array, rotations: Array, cloud: PointCloud
) -> list[Clothing]:
    """The clearest edge around both arms, and that around both legs or the trunk."""
    points, _ = thinned(cloud, _POINTS)
    tree = cKDTree(reference, balanced_tree=False)
    away, vertex = tree.query(points, distance_upper_bound=_REACH_M)
    near = np.isfinite(away)
    vertex = vertex[near]
    offset = points[near] - reference[vertex]
    out_m = np.einsum("ni,ni->n", offset, normals[vertex])
    along_skin = offset - out_m[:, None] * normals[vertex]
    shift = np.einsum("nji,nj->ni", rotations[model.part_of_vertex[vertex]], along_skin)
    found = []
    for limb in _LIMBS:
        columns = [_column(model, limb, side) for side in _SIDES]
        edges = [_edges(column, vertex, shift, out_m) for column in columns]
        both_m = np.minimum(*(maximum_filter1d(edge, _UNEVEN_BINS) for edge in edges))
        level = int(np.argmax(both_m))
        if both_m[level] > _STEP_M:
            found.append(_hem(model, limb, columns[0], level, float(both_m[level])))
    return found


def _edges(column: _Column, vertex: NDArray[np.intp], shift: Array, out_m: Array) -> Array:
    """Step (bins,) that the surface recedes by, outwards, and stays back in most sectors; 0 where
    too few show it.

    Args:
        vertex: (n,), next to each point.
        shift: (n, 3), of the point from it along the skin, in the neutral pose.
        out_m: (n,), distance of the point from the model's surface.
    """
    own = column.mask[vertex]
    at = vertex[own]
    level = ((column.along_m[at] + shift[own] @ column.axis) / _BIN_M).astype(np.intp)
    inside = (level >= 0) & (level < _BINS)
    cell = level[inside] * _SECTORS + column.sector[at[inside]]
    count, total = (
        np.bincount(cell, weights, _BINS * _SECTORS).reshape(_BINS, _SECTORS).cumsum(axis=0)
        for weights in (np.ones(len(cell)), out_m[own][inside])
    )
    w = _COMPARED_BINS
    counts, totals = count[w:] - count[:-w], total[w:] - total[:-w]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(counts >= w, totals / counts, np.nan)
    size = _LASTING_BINS + 1
    farthest = maximum_filter1d(np.nan_to_num(mean, nan=-np.inf), size, axis=0, origin=-(size // 2))
    above = mean[: -w - 1]
    lasting = (above - farthest[w + 1 :]) / _LASTING_SHARE
    step = np.full((_BINS, _SECTORS), -np.inf)
    step[w + 1 : _BINS - w] = np.nan_to_num(np.minimum(above - mean[w + 1 :], lasting), nan=-np.inf)
    step = np.sort(maximum_filter1d(step, _SLANT_BINS, axis=0), axis=1)
    shown = np.isfinite(step).sum(axis=1)
    weakest = _SECTORS - shown + (_AROUND * shown).astype(np.intp)
    chosen = step[np.arange(_BINS), np.minimum(weakest, _SECTORS - 1)]
    return np.where(shown >= _LEAST_SECTORS, np.maximum(chosen, 0.0), 0.0)


def _hem(model: BodyModel, limb: Limb, column: _Column, level: int, step_m: float) -> Clothing:
    away = np.where(column.mask, np.abs(column.along_m / _BIN_M - level), np.inf)
    there = away < max(_SLANT_BINS, away.min() + 1.0)
    part = model.part_names[int(np.bincount(model.part_of_vertex[there]).argmax())]
    stem = part.removesuffix(f"_{_SIDES[0]}")
    chain = _LIMBS[limb]
    before = chain[: chain.index(stem) + 1] if stem in chain else ()
    covered = tuple(f"{name}_{side}" for name in before for side in _SIDES)
    above_crotch = level * _BIN_M < column.along_m[model.landmarks["crotch"]]
    # Vests end there, and bellies; the part with most of the skin may be the thigh.
    at = "pelvis" if stem == "thigh" and above_crotch else stem
    thickness_m = min(_THICKNESS_TO_STEP * step_m, _THICKEST_M)
    return Clothing(at, covered, thickness_m, is_sure=limb == "arm" and step_m > _SLEEVE_M)


def is_worn(signs: Sequence[Clothing], lost: Collection[str]) -> bool:
    """Whether signs are enough: a sure one, of two of arms, legs and trunk, or one where limbs that
    it may hide are lost.

    What the trunk shows counts once: flesh that hangs has an edge and is followed badly, too.

    Args:
        lost: parts that do not match the scan.
    """
    limbs = set(lost).difference(TRUNK)
    places = {"trunk" if sign.at in TRUNK else sign.at for sign in signs}
    return len(places) > 1 or any(
        sign.is_sure or not limbs.isdisjoint(sign.covered) for sign in signs
    )


def clothing_reasons(signs: Sequence[Clothing]) -> list[str]:
    """The reason to scan again; none for no sign."""
    return [
        f"loose clothing hides the body, as seen at the {_PLURALS[sign.at]}: take it off, or wear "
        "something close-fitting"
        for sign in signs[:1]
    ]


def clothing_remarks(signs: Sequence[Clothing]) -> list[str]:
    """Remarks on what may be clothing, one for each part that shows it."""
    thickest_m: dict[str, float] = {}
    for sign in signs:
        thickest_m[sign.at] = max(sign.thickness_m, thickest_m.get(sign.at, 0.0))
    return [
        f"clothing may lie up to {1e3 * thickness_m:.0f} mm off the skin at the "
        f"{_PLURALS[part]}: if any is loose there, take it off and scan again"
        for part, thickness_m in thickest_m.items()
    ]


@lru_cache(maxsize=8)
def _column(model: BodyModel, limb: Limb, side: str) -> _Column:
    chain = [f"{part}_{side}" for part in _LIMBS[limb]]
    mask = model.of_parts(chain)
    if limb == "leg":
        middle = model.mean[model.of_parts(chain[:1])].mean(axis=0)
        mask |= model.of_parts(TRUNK) & (model.mean[:, 0] * middle[0] > 0.0)
        axis = np.array([0.0, 0.0, -1.0])
    else:
        middle, beyond = (model.mean[model.of_parts([part])].mean(axis=0) for part in chain[1:3])
        axis = (beyond - middle) / np.linalg.norm(beyond - middle)
    away = model.mean - middle
    along_m = away @ axis
    across = np.cross(axis, (0.0, 1.0, 0.0))
    across /= np.linalg.norm(across)
    angle = np.arctan2(away @ np.cross(axis, across), away @ across)
    sector = (_SECTORS * (0.5 + angle / (2.0 * np.pi))).astype(np.intp) % _SECTORS
    return _Column(mask, axis, along_m + 0.5 * _BINS * _BIN_M, sector)
