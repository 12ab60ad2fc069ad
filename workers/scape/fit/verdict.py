"""Can the result be trusted? Per-part residuals and coverage, in the operator's words."""

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

_SEEN_ENOUGH = 0.22
_EXTREMITY_SEEN_ENOUGH = 0.10
_PART_RESIDUAL_M = 0.012
_UNEXPLAINED_SHARE = 0.015
_UNEXPLAINED_M = 0.03
_LOST_POINTS_SHARE = 0.001
_UNMET_SHARE = 0.15
_CAMERA_SHIFT_M = 0.002
"""Rightly placed cameras are moved by tenths of a millimetre, one that is 5 mm off by 3 or more."""
_STATURE_M = (1.30, 2.25)
_IMPLAUSIBLE_BETA = 6.0
_TRUNK = ("pelvis", "abdomen", "chest")
_SIDES = {"front": -1.0, "back": 1.0}
"""The template faces -y."""
_FACING = 0.7
_EXTREMITIES = ("hand", "foot", "shoulder", "neck")


@dataclass(frozen=True, slots=True)
class PartReport:
    """How well one part of the body was seen and met."""

    name: str
    coverage: float
    """Share of its area that cameras saw."""
    residual_rms_m: float
    """Of the points that belong to it."""
    unmet: float
    """Share of the points around it that lie farther than 3 cm from it."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """ "ok" or "rescan", and why."""

    status: str
    reasons: tuple[str, ...]


def report_parts(
    model: BodyModel, vertices: Array, seen: NDArray[np.bool_], cloud: PointCloud
) -> tuple[tuple[PartReport, ...], float, float]:
    """Reports by part, the point-to-surface rms in metres and the share of unexplained points."""
    areas = vertex_areas(vertices, model.faces)
    normals = vertex_normals(vertices, model.faces)
    points, directions = _thinned(cloud, 10_000)
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
        reports.append(PartReport(name, coverage, rms, _unmet(around, unexplained)))
    rms = float(np.sqrt(np.mean(away[~unexplained] ** 2))) if (~unexplained).any() else 1.0
    return tuple(reports), rms, float(unexplained.mean())


def sides_seen(model: BodyModel, vertices: Array, seen: NDArray[np.bool_]) -> dict[str, float]:
    """Shares of the trunk's front and back that cameras saw.

    A part that is seen from one side alone may still be seen by half.
    """
    areas = vertex_areas(vertices, model.faces)
    toward = vertex_normals(model.mean, model.faces)[:, 1]
    trunk = np.isin(model.part_of_vertex, [model.part_names.index(name) for name in _TRUNK])
    shares = {}
    for side, sign in _SIDES.items():
        there = trunk & (sign * toward > _FACING)
        shares[side] = float(areas[there & seen].sum() / max(areas[there].sum(), 1e-12))
    return shares


def _unmet(around: NDArray[np.bool_], unexplained: NDArray[np.bool_]) -> float:
    """A few stray points are noise; a cluster of them is a limb that the fit lost."""
    lost = int(np.count_nonzero(around & unexplained))
    if lost < _LOST_POINTS_SHARE * len(around):
        return 0.0
    return lost / int(np.count_nonzero(around))


def unexplained_share(model: BodyModel, vertices: Array, cloud: PointCloud) -> float:
    """Share of the points farther than 3 cm from the body's surface: a lost limb, a second body."""
    points, directions = _thinned(cloud, 5000)
    normals = vertex_normals(vertices, model.faces)
    vertex = OrientedTree.build(vertices, normals).nearest(points, directions)
    away = np.linalg.norm(points - vertices[vertex], axis=1)
    return float(np.mean(away > _UNEXPLAINED_M))


def _thinned(cloud: PointCloud, count: int) -> tuple[Array, Array]:
    every = slice(None, None, max(1, len(cloud.points) // count))
    return cloud.points[every], cloud.normals[every]


def _groups(model: BodyModel) -> dict[str, list[int]]:
    """Parts as the operator names them: a hand with its fingers is one."""
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
    """Decide whether to scan again."""
    reasons = [finding.message for finding in findings]
    if unexplained > _UNEXPLAINED_SHARE:
        reasons.append(
            f"{100 * unexplained:.1f} % of what the cameras saw is not met by the body: a limb was "
            "lost, or something else is in the booth"
        )
    if not _STATURE_M[0] < stature_m < _STATURE_M[1]:
        reasons.append(f"the body is {stature_m:.2f} m tall; only adults can be measured")
    if float(np.abs(beta[:10]).max(initial=0.0)) > _IMPLAUSIBLE_BETA:
        reasons.append("what stands in the booth does not look like a person")
    for side, share in sides.items():
        if share < _SEEN_ENOUGH:
            reasons.append(f"the person's {side} not seen ({100 * share:.0f} % of it)")
    for part in parts:
        words = words_of(part.name)
        enough = _EXTREMITY_SEEN_ENOUGH if part.name.startswith(_EXTREMITIES) else _SEEN_ENOUGH
        if part.coverage < enough:
            reasons.append(f"{words} not seen ({100 * part.coverage:.0f} % of it)")
        elif part.unmet > _UNMET_SHARE:
            reasons.append(f"{words} not met by the fit ({100 * part.unmet:.0f} % of its points)")
        elif part.residual_rms_m > _PART_RESIDUAL_M:
            reasons.append(f"{words} not met ({1e3 * part.residual_rms_m:.0f} mm off)")
    for camera, shift in camera_shifts_m.items():
        if shift > _CAMERA_SHIFT_M:
            reasons.append(
                f"camera {camera} looks {1e3 * shift:.0f} mm or more off its calibration; "
                "run station check"
            )
    return Verdict("rescan" if reasons else "ok", tuple(reasons))


def words_of(part: str) -> str:
    """A part's name as the operator reads it."""
    stem, _, side = part.rpartition("_")
    return f"{side} {stem.replace('_', ' ')}" if side in ("left", "right") else part
