"""Shares of the body that were seen, and distances of the points from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.cloud.observed import PointCloud
from workers.scape.evidence.correspondence import OrientedTree
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_areas, vertex_normals

Array = NDArray[np.float64]

TRUNK = ("pelvis", "abdomen", "chest")
_UNEXPLAINED_M = 0.03
"""Distance from the surface beyond which a point does not belong to the body."""
_POINTS_FOR_PARTS, _POINTS_FOR_STARTS = 10_000, 5000
"""Points used for the report on parts, and for the comparison of starts."""
_SIDES = {
    "front": ((0.0, -1.0, 0.0), 0.7),
    "back": ((0.0, 1.0, 0.0), 0.7),
    "left side": ((1.0, 0.0, 0.0), 0.2),
    "right side": ((-1.0, 0.0, 0.0), 0.2),
}
"""Directions of the template's sides, which faces -y, and the least cosine between them and a
side's normals. Flanks hide behind arms, so what faces them less counts too."""


@dataclass(frozen=True, slots=True)
class PartReport:
    """Coverage and residuals of one part of the body."""

    name: str
    coverage: float
    """Share of the part's area that cameras saw."""
    residual_rms_m: float
    """Rms distance of the part's points to the surface; NaN where it has none."""


def report_parts(
    model: BodyModel, vertices: Array, seen: NDArray[np.bool_], cloud: PointCloud
) -> tuple[tuple[PartReport, ...], float]:
    """Reports on all parts, and the point-to-surface rms in metres.

    Args:
        vertices: (P, 3), the fitted surface.
        seen: (P,), vertices with points.
    """
    areas = vertex_areas(vertices, model.faces)
    normals = vertex_normals(vertices, model.faces)
    points, directions = thinned(cloud, _POINTS_FOR_PARTS)
    vertex = OrientedTree.build(vertices, normals).nearest(points, directions)
    offsets = points - vertices[vertex]
    away = np.abs(np.einsum("ni,ni->n", offsets, normals[vertex]))
    unexplained = np.linalg.norm(offsets, axis=1) > _UNEXPLAINED_M
    part = model.part_of_vertex
    reports = []
    for name, members in named_parts(model).items():
        mine = np.isin(part, members)
        if not mine.any():
            continue
        own = np.isin(part[vertex], members) & ~unexplained
        rms = float(np.sqrt(np.mean(away[own] ** 2))) if own.any() else float("nan")
        coverage = float(areas[mine & seen].sum() / areas[mine].sum())
        reports.append(PartReport(name, coverage, rms))
    rms = float(np.sqrt(np.mean(away[~unexplained] ** 2))) if (~unexplained).any() else 1.0
    return tuple(reports), rms


def sides_seen(model: BodyModel, vertices: Array, seen: NDArray[np.bool_]) -> dict[str, float]:
    """Shares of the trunk's front, back, left and right side that cameras saw.

    Coverage by part does not show that one side is missing: half of each part is then still seen.
    """
    areas = vertex_areas(vertices, model.faces)
    normals = vertex_normals(model.mean, model.faces)
    trunk = model.of_parts(TRUNK)
    shares = {}
    for side, (direction, least_cosine) in _SIDES.items():
        there = trunk & (normals @ direction > least_cosine)
        shares[side] = float(areas[there & seen].sum() / max(areas[there].sum(), 1e-12))
    return shares


def unexplained_share(model: BodyModel, vertices: Array, cloud: PointCloud) -> float:
    """Share of the points farther than 3 cm from the surface: a lost limb, a second person."""
    points, directions = thinned(cloud, _POINTS_FOR_STARTS)
    normals = vertex_normals(vertices, model.faces)
    vertex = OrientedTree.build(vertices, normals).nearest(points, directions)
    away = np.linalg.norm(points - vertices[vertex], axis=1)
    return float(np.mean(away > _UNEXPLAINED_M))


def thinned(cloud: PointCloud, count: int) -> tuple[Array, Array]:
    """About so many points (n, 3) of a cloud, evenly chosen, and their normals."""
    every = slice(None, None, max(1, len(cloud.points) // count))
    return cloud.points[every], cloud.normals[every]


def named_parts(model: BodyModel) -> dict[str, list[int]]:
    """Indices of the model's parts by the operator's names: hand, thumb and fingers are one part,
    the hand."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(model.part_names):
        stem, _, side = name.rpartition("_")
        key = f"hand_{side}" if stem in HAND else name
        groups.setdefault(key, []).append(index)
    return groups
