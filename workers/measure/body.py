"""Measurements of a body in the template's topology, by the table of definitions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.core.words.tables import Pose
from workers.measure.coverage import Basis, SeenSkin
from workers.measure.intervals import content_interval, intervals, row_values
from workers.measure.kinds import Route, Top
from workers.measure.scan_errors import ScanErrors
from workers.measure.standing import stood_upright
from workers.measure.tracing import Trace, trace_all
from workers.scape.model.body_model import FLOOR, BodyModel, BodyState
from workers.scape.model.deformation import signed_volume, vertex_areas

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ORDINARY = ScanErrors()
"""Errors of a scan that adds none of its own."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """Value of one row, with the line that was measured."""

    name: str
    standard: str
    value_m: float
    """NaN where the body has no such line."""
    interval95_m: tuple[float, float]
    path: Array
    """(n, 3) on the mesh as scanned, world frame, whatever the pose that the value is for."""
    closed: bool
    basis: Basis
    """Whether cameras saw the line."""
    parts: frozenset[str]
    """Parts of the body that the line or its landmarks lie on, and `FLOOR` where it ends there."""


@dataclass(frozen=True, slots=True)
class Content:
    """A volume in cubic metres or a surface in square metres."""

    value: float
    interval95: tuple[float, float]


@dataclass(frozen=True, slots=True)
class MeasuredBody:
    """All measurements of a body in one pose."""

    pose: Pose
    rows: tuple[Measurement, ...]
    volume_m3: Content
    surface_m2: Content


def measure_body(
    model: BodyModel,
    vertices: Array,
    vertex_sigma_m: Array | None = None,
    vertex_seen: Mask | None = None,
    scan_errors: ScanErrors = ORDINARY,
) -> MeasuredBody:
    """All measurements of a body as it stands.

    Args:
        vertices: (P, 3) in the template's topology, z up, floor at 0, metres.
        vertex_sigma_m: (P,), the fit's standard deviation along the normals. Without it the mesh
            counts as exact and intervals have no width.
        vertex_seen: (P,), vertices that cameras saw. Without it all count as seen.
        scan_errors: what concerns the whole scan.

    Raises:
        InputError: a place is not a number, or many planes miss the part that they should cut.
    """
    return _measured(
        model, vertices, vertices, "as-scanned", vertex_sigma_m, vertex_seen, scan_errors
    )


def measure_standing(
    model: BodyModel,
    vertices: Array,
    state: BodyState,
    vertex_sigma_m: Array | None = None,
    vertex_seen: Mask | None = None,
    scan_errors: ScanErrors = ORDINARY,
) -> MeasuredBody:
    """All measurements of a body in the standard standing pose; their lines lie on the mesh as it
    was scanned.

    Args:
        vertices: (P, 3) as scanned.
        state: the parameters that the vertices were fitted with.
        vertex_sigma_m, vertex_seen, scan_errors: as in `measure_body`.
    """
    standing = stood_upright(model, vertices, state)
    return _measured(
        model, standing, vertices, "standard", vertex_sigma_m, vertex_seen, scan_errors
    )


def _measured(
    model: BodyModel,
    vertices: Array,
    shown: Array,
    pose: Pose,
    vertex_sigma_m: Array | None,
    vertex_seen: Mask | None,
    scan_errors: ScanErrors,
) -> MeasuredBody:
    traces = trace_all(model, vertices)
    values = row_values(traces, pose)
    skin = None if vertex_seen is None else SeenSkin.build(model, shown, vertex_seen)
    rows = tuple(
        Measurement(
            trace.definition.name,
            trace.definition.standard,
            value,
            interval,
            trace.path(shown),
            trace.closed,
            basis,
            _parts_of(model, trace),
        )
        for trace, value, interval, basis in zip(
            traces,
            values,
            intervals(traces, values, vertex_sigma_m, pose, scan_errors),
            _bases(skin, traces, scan_errors),
            strict=True,
        )
    )
    volume = signed_volume(vertices, model.faces)
    areas = vertex_areas(vertices, model.faces)
    surface = float(areas.sum())
    further = scan_errors.of_contents(volume, areas, float(np.ptp(vertices[:, 2])))

    def content(name: str, value: float, its_further: float) -> Content:
        noise_m = scan_errors.excess_noise_m
        interval = content_interval(name, value, vertex_sigma_m, pose, noise_m, its_further)
        return Content(value, interval)

    return MeasuredBody(
        pose,
        rows,
        content("volume", volume, further.volume),
        content("surface", surface, further.surface),
    )


def _bases(skin: SeenSkin | None, traces: Sequence[Trace], scan_errors: ScanErrors) -> list[Basis]:
    """The bases of all rows. The top of a head counts as seen where the cameras saw the head end,
    for it gives no readings itself.
    """
    if skin is None:
        return ["seen"] * len(traces)
    top: Basis = "inferred" if scan_errors.crown_sigma_m > 0.0 else "seen"
    of_others = iter(skin.bases([row for row in traces if not _is_top(row)]))
    return [top if _is_top(row) else next(of_others) for row in traces]


def _is_top(trace: Trace) -> bool:
    return isinstance(trace.definition.kind, Top)


def _parts_of(model: BodyModel, trace: Trace) -> frozenset[str]:
    landmarks = [model.landmarks[name] for name in trace.definition.landmarks]
    vertices = np.concatenate([trace.points.tail, np.array(landmarks, np.intp)])
    parts = {model.part_names[part] for part in np.unique(model.part_of_vertex[vertices])}
    kind = trace.definition.kind
    if isinstance(kind, Top) or (isinstance(kind, Route) and "floor" in kind.legs):
        parts.add(FLOOR)
    return frozenset(parts)
