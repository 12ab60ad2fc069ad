"""Displacement of the fitted model's surface onto the cloud (the paper's E(Y')).

The skin is the model's surface Y plus an offset d, which minimises

    sum_i w_i (n_i . (p_i - Y(x_i) - d(x_i)))^2 + sum_c d_c^T Q d_c,

with p_i the points, n_i their normals, w_i their information and x_i the nearest place on the
current surface; c runs over the coordinates, and Q is the precision of a Matern field
(`offset_prior`). The field's standard deviation follows from this scan: how far its points lie from
the model's surface, in hands and feet apart from the rest. The whole offset is penalised, not the
step of a round, so that what no camera saw goes back to the model with the distance from what one
did. Rounds narrow the gate and weaken the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from workers.cloud.observed import CameraView, PointCloud
from workers.scape.evidence.correspondence import TrackedPoints
from workers.scape.evidence.crown import crown_rows
from workers.scape.evidence.floor import stand_on_floor
from workers.scape.evidence.rows import Rows
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.model.halves import started
from workers.scape.surface.attachment import Attachments, attached
from workers.scape.surface.contours import contour_places, contour_rows, side_offsets_px
from workers.scape.surface.crossings import Pairs, crossing_pairs
from workers.scape.surface.offset_equations import OffsetRows, solved
from workers.scape.surface.offset_prior import offset_prior
from workers.scape.surface.uncertainty import surface_sigma

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class _Round:
    gate_m: float
    """Largest distance between a point and its place on the surface."""
    angle_rad: float
    """Largest angle between their normals."""
    stiffness: float
    """Factor of the prior's precision."""
    enough: float
    """Energy that is still to be gained, at which the solver stops. What is left then slides along
    the skin: with a hundredth of it, surfaces differ by 1 to 2 mm along themselves, and err as
    much."""


_ROUNDS = (
    _Round(0.030, np.radians(50), 20.0, 30.0),
    _Round(0.020, np.radians(45), 4.0, 3.0),
    _Round(0.015, np.radians(40), 1.0, 0.2),
)
_REACH_M = 0.030
"""Largest distance between a point and the vertex next to it. Edges of trunk and limbs are up to
28 mm long, so that the middle of a triangle is 16 mm away from its corners."""
_SIGMA_PER_MISMATCH = 3.5
"""Standard deviation of the offsets per mismatch of the points and the model's surface, without the
points' noise. More than 1, since folds and edges are steeper than a field of one range."""
_LOCAL_FROM_M = 0.008
"""Standard deviation from which that of a hand or foot by its own mismatch, which grows with the
square, counts: those of the model's family have 3 to 6 mm, fists of another 20."""
_SCAN_SHARE = 0.05
"""Share of the whole scan's mismatch in a vertex's own, for those with few points around."""
_NOISE_LEFT = 0.8
"""Standard deviation of the mean of a vertex's points per that of a point: they share most."""
_EXCESS_LEFT = 0.4
"""The same per the excess noise of a point, after the filter: the mismatch of the family grows from
1.4 to 1.7 mm by 2.6 mm of it."""
_MIN_SIGMA_M = 0.0008
"""Floor of the offsets' standard deviation: what the components leave out of the model's own
bodies."""
_INDEPENDENT = 0.2
"""Share of the points used that count as independent: the sensor's matching windows overlap."""
_SEEN_M = 0.012
"""Largest distance of a vertex that was seen from a point: at 20 mm a fog of points shows all."""
_ON_SURFACE_M = 0.006
"""Largest distance of a point that lies on its triangle."""
_MIN_NOISE_M = 3e-4
"""Floor of a reading's standard deviation: quantisation and calibration do not average out."""
_MAX_POINTS = 25_000
"""Points used at most: twice as many change errors by less than 0.01 mm."""


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """A surface fitted to a cloud. P vertices."""

    vertices: Array
    sigma_m: Array
    """(P,): standard deviation along the normal, in excess of an ordinary scan's."""
    seen: NDArray[np.bool_]
    """(P,): points lie on the vertex or on a neighbour of it."""
    residual_m: Array
    """(P,): mean signed distance of the vertex's points after the fit; NaN where it has none."""
    measured: NDArray[np.bool_]
    """(P,): vertices of triangles with points on them."""
    crossing: Future[Pairs] | None = None
    """Pairs (m, 2) of triangles that cross, which are searched for meanwhile."""


@dataclass(frozen=True, slots=True)
class _Readings:
    """Points of the cloud, which follow the surface."""

    points: Array
    directions: Array
    information: Array
    """(n,): inverse variance, times the share that is independent."""
    noise_m: float
    """Standard deviation of the mean of a vertex's points ..."""
    excess_m: float
    """... and its part that ordinary scans do not have."""
    tracked: TrackedPoints

    @classmethod
    def build(cls, model: BodyModel, cloud: PointCloud) -> _Readings:
        """An even subset of the cloud."""
        every = slice(None, None, -(-len(cloud.points) // _MAX_POINTS))
        points, directions, noise = cloud.points[every], cloud.normals[every], cloud.sigma_m[every]
        excess_m = _EXCESS_LEFT * cloud.excess_noise_m
        return cls(
            points,
            directions,
            _INDEPENDENT / np.maximum(noise, _MIN_NOISE_M) ** 2,
            float(np.hypot(_NOISE_LEFT * np.sqrt(np.mean(noise**2)), excess_m)),
            excess_m,
            TrackedPoints(model.neighbours, points, directions, dense=True),
        )

    def placed(
        self,
        model: BodyModel,
        vertices: Array,
        angle_rad: float,
        *,
        reach_m: float = _REACH_M,
        gate_m: float = np.inf,
    ) -> tuple[Index, Index, Attachments]:
        """Readings (n,) near a surface (P, 3), the vertex next to each, and its place.

        Args:
            angle_rad: largest angle between the normals of a reading and of the vertex.
            reach_m: largest distance between them.
            gate_m: largest distance of a reading from its place.
        """
        used, vertex = self.tracked.pairs(
            vertices,
            vertex_normals(vertices, model.faces),
            max_distance_m=reach_m,
            max_angle_rad=angle_rad,
        )
        places = attached(model, vertices, self.points[used], vertex)
        gap = self.points[used] - places.of(vertices, model.faces)
        near = np.einsum("ni,ni->n", gap, gap) < gate_m**2
        return used[near], vertex[near], places.chosen(near)

    def away_m(self, used: Index, places: Array) -> Array:
        """(n,): distances of some readings from places (n, 3), along the readings' normals."""
        offsets = self.points[used] - places
        return np.asarray(np.einsum("ni,ni->n", self.directions[used], offsets))

    def at_vertices(self, used: Index, vertex: Index, away_m: Array, count: int) -> _AtVertices:
        """Means at the vertices (count,) over some readings."""
        information = self.information[used]
        total: Array = np.bincount(vertex, information, count).astype(np.float64)
        pull: Array = np.bincount(vertex, information * away_m, count).astype(np.float64)
        return _AtVertices(pull / np.where(total > 0.0, total, 1.0), total)


@dataclass(frozen=True, slots=True)
class _AtVertices:
    """The cloud's evidence at the vertices next to its points. P vertices."""

    residual_m: Array
    """(P,): mean distance of the vertex's points; 0 where it has none."""
    information: Array
    """(P,): sum of their inverse variances."""

    @property
    def observed(self) -> NDArray[np.bool_]:
        return np.asarray(self.information > 0.0)

    @property
    def rms_m(self) -> float:
        """Over the vertices that have points; 0 where none has."""
        found = self.residual_m[self.observed]
        return float(np.sqrt(np.mean(found**2))) if len(found) else 0.0


def fit_surface(
    model: BodyModel,
    vertices: Array,
    cloud: PointCloud,
    views: Sequence[CameraView],
    poses: Sequence[Array],
) -> SurfaceFit:
    """Fit the model's surface to a cloud, to the top of the head and to contours.

    There are no points at the top of the head and where skin turns away from all cameras, so the
    smooth field alone would carry on the trend of the points around it. Contours count from the
    second round on: what their edges are off by shows on a surface that follows the points.

    Args:
        vertices: (P, 3), the model's surface.
        views: the cameras' images; none for a bare cloud.
        poses: corrected world_from_camera (4, 4) of each.
    """
    readings = _Readings.build(model, cloud)
    prior = offset_prior(model)
    offset = np.zeros_like(vertices)
    before: _AtVertices | None = None
    sides_px: Array | None = None
    # Images are searched beside the cloud.
    with ThreadPoolExecutor(1) as beside:
        for round_ in _ROUNDS:
            current = vertices + offset
            contours = None
            if views and before is not None:
                contours = beside.submit(contour_places, model, views, poses, current)
            crown = beside.submit(crown_rows, model, views, poses, current)
            used, vertex, places = readings.placed(
                model, current, round_.angle_rad, gate_m=round_.gate_m
            )
            away = readings.away_m(used, places.of(vertices, model.faces))
            if before is None:
                before = readings.at_vertices(used, vertex, away, len(vertices))
                sigma_m = _offset_sigma_m(model, before, readings.noise_m)
            rows = [
                OffsetRows(places, readings.directions[used], away, readings.information[used]),
                _crown_rows(model, crown.result(), offset),
            ]
            if contours is not None:
                found = contours.result()
                if sides_px is None:
                    sides_px = side_offsets_px(found, len(views))
                rows.append(contour_rows(model, found, sides_px, offset))
            of_round_m = sigma_m / np.sqrt(round_.stiffness)
            joined = OffsetRows.joined(*rows)
            offset = solved(model, prior, of_round_m, joined, offset, round_.enough)
    assert before is not None
    fitted = stand_on_floor(model, vertices + offset)
    crossing = started(crossing_pairs, fitted, model.faces)
    return _examined(model, fitted, readings, before, crossing)


def _offset_sigma_m(model: BodyModel, before: _AtVertices, noise_m: float) -> Array:
    """(P,): standard deviation of the offsets in the prior.

    Hands and feet that the model follows far worse than the rest have one of their own.

    Args:
        before: what the cloud says before the surface is displaced.
        noise_m: as in `_Readings`.
    """
    prior, observed = offset_prior(model), before.observed.astype(np.float64)
    total = prior.share_around(observed * before.residual_m**2) + _SCAN_SHARE * before.rms_m**2
    around = total / (prior.share_around(observed) + _SCAN_SHARE)
    whole, local = (
        np.maximum(
            _SIGMA_PER_MISMATCH * np.sqrt(np.maximum(square - noise_m**2, 0.0)), _MIN_SIGMA_M
        )
        for square in (before.rms_m**2, around)
    )
    return np.where(_of_ends(model), np.maximum(whole, local**2 / _LOCAL_FROM_M), whole)


@lru_cache(maxsize=2)
def _of_ends(model: BodyModel) -> NDArray[np.bool_]:
    """Mask (P,) of hands and feet."""
    ends = [name.rpartition("_")[0] in (*HAND, "foot") for name in model.part_names]
    return np.array(ends)[model.part_of_vertex]


def _examined(
    model: BodyModel,
    vertices: Array,
    readings: _Readings,
    before: _AtVertices,
    crossing: Future[Pairs],
) -> SurfaceFit:
    """A fitted surface (P, 3) with what is known of it.

    Args:
        before: what the cloud said at the vertices before the surface was displaced.
    """
    used, vertex, places = readings.placed(model, vertices, _ROUNDS[-1].angle_rad, reach_m=_SEEN_M)
    away = readings.away_m(used, places.of(vertices, model.faces))
    after = readings.at_vertices(used, vertex, away, len(vertices))
    # The template is finer than the pixels: a vertex between others that have points is seen too.
    seen = after.observed | (model.adjacency @ after.information > 0.0)
    on_surface = np.abs(away) < _ON_SURFACE_M
    measured = np.zeros(len(vertices), bool)
    measured[model.faces[places.triangle[on_surface]]] = True
    return SurfaceFit(
        vertices=vertices,
        sigma_m=surface_sigma(model, seen, before.residual_m, before.observed, readings.excess_m),
        seen=seen,
        residual_m=np.where(after.observed, after.residual_m, np.nan),
        measured=measured,
        crossing=crossing,
    )


def _crown_rows(model: BodyModel, rows: Rows, offset: Array) -> OffsetRows:
    """The same rows on the whole offset, each at a corner of a triangle."""
    triangle, weights = _triangle_of_vertex(model)
    already = np.einsum("ni,ni->n", rows.direction, offset[rows.place])
    places = Attachments(triangle[rows.place], weights[rows.place])
    return OffsetRows(places, rows.direction, rows.residual_m + already, rows.weight)


@lru_cache(maxsize=2)
def _triangle_of_vertex(model: BodyModel) -> tuple[NDArray[np.int64], Array]:
    """A triangle of each vertex (P,), and the vertex's barycentric weights (P, 3) in it."""
    corner = np.zeros(model.vertex_count, np.int64)
    corner[model.faces.ravel()] = np.arange(model.faces.size)
    return corner // 3, np.eye(3)[corner % 3]
