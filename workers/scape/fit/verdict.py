"""Verdict on a fit, from the residuals and the coverage of each part of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.cloud.observed import Finding, PointCloud
from workers.scape.evidence.correspondence import OrientedTree
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_areas, vertex_normals

Array = NDArray[np.float64]

_LEAST_COVERAGE = 0.22
"""Least share of a part's area that cameras must have seen; four cameras see 0.5 to 0.9 of it."""
_LEAST_EXTREMITY_COVERAGE = 0.10
"""The same for hands, feet, shoulders and the neck, which hide behind other parts."""
_MOST_PART_RESIDUAL_M = 0.012
"""Largest rms distance of a part's points to the surface: ten times that of a sound fit."""
_UNEXPLAINED_M = 0.03
"""Distance from the surface beyond which a point does not belong to the body."""
_MOST_UNEXPLAINED = 0.015
"""Largest share of such points in the whole scan."""
_MOST_UNEXPLAINED_OF_PART = 0.15
"""Largest share of such points among those nearest to one part: a lost limb has more."""
_STRAY_SHARE = 0.001
"""Share of the scan's points up to which unexplained points near a part are noise."""
_MOST_CAMERA_SHIFT_M = 0.002
"""Largest correction of a camera: well-placed cameras are moved by tenths of a millimetre, one that
is 5 mm off its calibration by 3 mm or more."""
_STATURES_M = (1.30, 2.25)
"""Statures of adults, metres."""
_MOST_BETA = 6.0
"""Largest shape coefficient of the first components, in standard deviations of people."""
_JUDGED_COMPONENTS = 10
_POINTS_FOR_PARTS, _POINTS_FOR_STARTS = 10_000, 5000
"""Points used for the report on parts, and for the comparison of starts."""
_TRUNK = ("pelvis", "abdomen", "chest")
_SIDES = {"front": -1.0, "back": 1.0}
"""Signs of y: the template faces -y."""
_FACING = 0.7
"""Least y component of the normals of a side."""
_EXTREMITIES = ("hand", "foot", "shoulder", "neck")


@dataclass(frozen=True, slots=True)
class PartReport:
    """Coverage and residuals of one part of the body."""

    name: str
    coverage: float
    """Share of the part's area that cameras saw."""
    residual_rms_m: float
    """Rms distance of the part's points to the surface; NaN where it has none."""
    unexplained: float
    """Share of the points nearest to the part that lie farther than 3 cm from it."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether to scan again, and the reasons in words for the operator."""

    status: str
    """"ok" or "rescan"."""
    reasons: tuple[str, ...]


def report_parts(
    model: BodyModel, vertices: Array, seen: NDArray[np.bool_], cloud: PointCloud
) -> tuple[tuple[PartReport, ...], float, float]:
    """Reports on all parts, the point-to-surface rms in metres, the share of unexplained points.

    Args:
        vertices: (P, 3), the fitted surface.
        seen: (P,), vertices with points.
    """
    areas = vertex_areas(vertices, model.faces)
    normals = vertex_normals(vertices, model.faces)
    points, directions = _thinned(cloud, _POINTS_FOR_PARTS)
    vertex = OrientedTree.build(vertices, normals).nearest(points, directions)
    offsets = points - vertices[vertex]
    away = np.abs(np.einsum("ni,ni->n", offsets, normals[vertex]))
    unexplained = np.linalg.norm(offsets, axis=1) > _UNEXPLAINED_M
    part = model.part_of_vertex
    reports = []
    for name, members in _groups(model).items():
        mine = np.isin(part, members)
        if not mine.any():
            continue
        own = np.isin(part[vertex], members) & ~unexplained
        rms = float(np.sqrt(np.mean(away[own] ** 2))) if own.any() else float("nan")
        coverage = float(areas[mine & seen].sum() / areas[mine].sum())
        around = np.isin(part[vertex], members)
        reports.append(PartReport(name, coverage, rms, _unexplained_of(around, unexplained)))
    rms = float(np.sqrt(np.mean(away[~unexplained] ** 2))) if (~unexplained).any() else 1.0
    return tuple(reports), rms, float(unexplained.mean())


def sides_seen(model: BodyModel, vertices: Array, seen: NDArray[np.bool_]) -> dict[str, float]:
    """Shares of the trunk's front and back that cameras saw.

    Coverage by part does not show that one side is missing: half of each part is then still seen.
    """
    areas = vertex_areas(vertices, model.faces)
    toward = vertex_normals(model.mean, model.faces)[:, 1]
    trunk = np.isin(model.part_of_vertex, [model.part_names.index(name) for name in _TRUNK])
    shares = {}
    for side, sign in _SIDES.items():
        there = trunk & (sign * toward > _FACING)
        shares[side] = float(areas[there & seen].sum() / max(areas[there].sum(), 1e-12))
    return shares


def _unexplained_of(around: NDArray[np.bool_], unexplained: NDArray[np.bool_]) -> float:
    """Share of unexplained points around a part, 0 where they are so few that they are noise."""
    lost = int(np.count_nonzero(around & unexplained))
    if lost < _STRAY_SHARE * len(around):
        return 0.0
    return lost / int(np.count_nonzero(around))


def unexplained_share(model: BodyModel, vertices: Array, cloud: PointCloud) -> float:
    """Share of the points farther than 3 cm from the surface: a lost limb, a second person."""
    points, directions = _thinned(cloud, _POINTS_FOR_STARTS)
    normals = vertex_normals(vertices, model.faces)
    vertex = OrientedTree.build(vertices, normals).nearest(points, directions)
    away = np.linalg.norm(points - vertices[vertex], axis=1)
    return float(np.mean(away > _UNEXPLAINED_M))


def _thinned(cloud: PointCloud, count: int) -> tuple[Array, Array]:
    every = slice(None, None, max(1, len(cloud.points) // count))
    return cloud.points[every], cloud.normals[every]


def _groups(model: BodyModel) -> dict[str, list[int]]:
    """Parts by the operator's names: hand, thumb and fingers are one part, the hand."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(model.part_names):
        stem, _, side = name.rpartition("_")
        key = f"hand_{side}" if stem in HAND else name
        groups.setdefault(key, []).append(index)
    return groups


def judge(
    parts: Sequence[PartReport],
    sides: dict[str, float],
    findings: Sequence[Finding],
    unexplained: float,
    stature_m: float,
    beta: Array,
    camera_shifts_m: dict[str, float],
) -> Verdict:
    """Decide whether to scan again.

    Args:
        sides: shares of the trunk's front and back that were seen.
        findings: what preprocessing noticed; each is a reason.
        unexplained: share of the points that do not belong to the body.
        beta: (B,), shape coefficients.
        camera_shifts_m: how far the fit moved each camera's points.
    """
    reasons = [finding.message for finding in findings]
    if unexplained > _MOST_UNEXPLAINED:
        reasons.append(
            f"{100 * unexplained:.1f} % of what the cameras saw does not belong to the measured "
            "body: an arm or a leg is wrong, or something else is in the booth"
        )
    low, high = _STATURES_M
    if not low < stature_m < high:
        reasons.append(
            f"the person is {stature_m:.2f} m tall; only adults of {low:.2f} to {high:.2f} m can "
            "be measured"
        )
    if float(np.abs(beta[:_JUDGED_COMPONENTS]).max(initial=0.0)) > _MOST_BETA:
        reasons.append("what stands in the booth does not look like a person")
    for side, share in sides.items():
        if share < _LEAST_COVERAGE:
            reasons.append(f"the cameras saw only {100 * share:.0f} % of the person's {side}")
    for part in parts:
        reasons += _part_reasons(part)
    for camera, shift in camera_shifts_m.items():
        if shift > _MOST_CAMERA_SHIFT_M:
            reasons.append(
                f"camera {camera} has moved by {1e3 * shift:.0f} mm or more since the calibration; "
                "run: station check"
            )
    return Verdict("rescan" if reasons else "ok", tuple(reasons))


def _part_reasons(part: PartReport) -> list[str]:
    words = part_in_words(part.name)
    extremity = part.name.startswith(_EXTREMITIES)
    if part.coverage < (_LEAST_EXTREMITY_COVERAGE if extremity else _LEAST_COVERAGE):
        return [f"the cameras saw only {100 * part.coverage:.0f} % of the {words}"]
    if part.unexplained > _MOST_UNEXPLAINED_OF_PART:
        share = f"{100 * part.unexplained:.0f} %"
        return [f"the {words} does not match the scan ({share} of its points lie elsewhere)"]
    if part.residual_rms_m > _MOST_PART_RESIDUAL_M:
        return [f"the {words} does not match the scan ({1e3 * part.residual_rms_m:.0f} mm apart)"]
    return []


def part_in_words(part: str) -> str:
    """Name of a part for the operator: "left forearm" of "forearm_left"."""
    stem, _, side = part.rpartition("_")
    return f"{side} {stem.replace('_', ' ')}" if side in ("left", "right") else part
