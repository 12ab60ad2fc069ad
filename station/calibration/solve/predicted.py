"""Errors of heights, girths and the cloud that follow from a calibration's covariance.

A standing body is replaced by rings of points about the mark. A camera that sees a point at the
depth z with the ray d reports X = T d z; its change by the pose's twist and the sensor's parameters
gives one row per point. A tilted world moves the whole body, which spoils no shape: rigid motions
are left out of all rings together. A girth is that of the merged cloud: the mean over its ring of
what the cameras see of each point, times 2 pi. The cloud's error is that of each camera's own
points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.contacts import plumb_ends
from station.calibration.adjust.priors import FLOOR_SLOPE_RAD
from station.calibration.adjust.problem import Indices, Layout, Problem, State
from station.calibration.adjust.sensor_model import LENS, POLYNOMIAL, SensorModel, image_place
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.geometry import invert, skew, transform
from station.core.lens import pixel_rays, project
from station.core.rig import CameraCalibration, PredictedError

Array = NDArray[np.float64]

_TRUNK_M, _HEAD_M = (0.17, 0.12), (0.075, 0.095)
"""Half widths and depths."""
_GIRTHS_M, _LEGS_M = (1.28, 1.08, 0.88), (0.65, 0.4, 0.15)
"""Heights of chest, waist and hip, and of places of the legs."""
_ARMS_M = ((1.2, 0.30, 0.045), (0.95, 0.42, 0.035))
"""Heights of upper arm and forearm, their distances from the middle, and their radii."""
_HEAD_HEIGHT_M, _CROWN_M = 1.62, 1.75
_AROUND = 24
_FACING = 0.35
"""Least cosine between a surface's normal and the direction to a camera that counts."""
_DEPTHS_M = (0.6, 3.0)


def predict_errors(
    problem: Problem,
    state: State,
    world_poses: WorldPoses,
    cameras: Mapping[str, CameraCalibration],
) -> PredictedError:
    """Standard deviations of what the calibration adds to a scan; ``cameras`` as solved.

    Raises:
        CalibrationError: no camera sees a height at which a body is measured.
    """
    layout = Layout.of(problem)

    def seen(ring: _Ring) -> list[_View]:
        return _views(problem.model, layout, world_poses, cameras, ring)

    def surely_seen(ring: _Ring) -> list[_View]:
        views = seen(ring)
        if not views:
            raise CalibrationError(
                f"no camera sees {ring.points[0, 2]:.2f} m above the mark: turn a camera there, "
                "and calibrate again"
            )
        return views

    def sigma(row: Array) -> float:
        return float(np.sqrt(max(float(row @ state.covariance @ row), 0.0)))

    trunk = [_Ring.around(height_m, *_TRUNK_M) for height_m in (*_GIRTHS_M, *_LEGS_M)]
    views = [surely_seen(ring) for ring in trunk]
    merged, covered = zip(*map(_merged, views), strict=True)
    rigid = [ring.rigid[at] for ring, at in zip(trunk, covered, strict=True)]
    whole = _not_rigid(np.concatenate(merged), np.concatenate(rigid))
    rings = np.split(whole, np.cumsum([len(rows) for rows in merged])[:-1])
    girths = [sigma(rows.mean(axis=0)) for rows in rings[: len(_GIRTHS_M)]]
    crown = surely_seen(
        _Ring(np.array([[0.0, 0.0, _CROWN_M]]), np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    )
    limbs = [_Ring.around(_HEAD_HEIGHT_M, *_HEAD_M)]
    for height_m, beside_m, radius_m in _ARMS_M:
        limbs += [_Ring.around(height_m, radius_m, radius_m, x) for x in (-beside_m, beside_m)]
    points = [*chain(*views), *chain(*map(seen, limbs))]
    # Where nothing hung, the floor counts as level.
    unknown_rad = FLOOR_SLOPE_RAD if plumb_ends(problem) is None else 0.0
    return PredictedError(
        height_sigma_m=sigma(_merged(crown)[0][0]),
        girth_sigma_m=2.0 * np.pi * max(girths),
        normal_rms_m=_cloud_rms(points, state.covariance),
        tilt_sigma_rad=float(np.hypot(world_poses.slope_sigma_rad, unknown_rad)),
    )


@dataclass(frozen=True, slots=True)
class _Ring:
    """Points around a part of a body."""

    points: Array
    """(n, 3)"""
    normals: Array
    """(n, 3)"""
    arc: Array
    """(n,): by how much of the body's surface each counts, up to a factor."""

    @classmethod
    def around(
        cls, height_m: float, half_width_m: float, half_depth_m: float, x_m: float = 0.0
    ) -> _Ring:
        """A level ellipse, at even turns of its normals."""
        turn = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
        nx, ny = np.cos(turn), np.sin(turn)
        length = np.hypot(half_width_m * nx, half_depth_m * ny)
        x, y = half_width_m**2 * nx / length, half_depth_m**2 * ny / length
        points = np.stack([x_m + x, y, np.full(_AROUND, height_m)], axis=1)
        arc = (half_width_m * half_depth_m) ** 2 / length**3
        return cls(points, np.stack([nx, ny, np.zeros(_AROUND)], axis=1), arc)

    @property
    def rigid(self) -> Array:
        """Derivatives (n, 6) of the points along their normals by a motion of the whole body."""
        return np.concatenate([np.cross(self.points, self.normals), self.normals], axis=1)


@dataclass(frozen=True, slots=True)
class _View:
    """One camera's view of a ring."""

    ring: _Ring
    place: Indices
    """(k,): which of its points these are."""
    weight: Array
    """(k,): cosine between the normal and the ray; 1 of what faces up."""
    rows: Array
    """(k, m): derivatives of its readings along the normals by all unknowns."""


def _not_rigid(rows: Array, rigid: Array) -> Array:
    """Rows (n, m) without what moves the whole body rigidly, whose rows are (n, 6)."""
    return np.asarray(rows - rigid @ np.linalg.lstsq(rigid, rows, rcond=None)[0])


def _merged(views: Sequence[_View]) -> tuple[Array, NDArray[np.bool_]]:
    """Derivatives (k, m) of a ring's points where the cameras' clouds are merged, of those that are
    seen, and which these are (n,)."""
    count = len(views[0].ring.points)
    total, seen = np.zeros((count, views[0].rows.shape[1])), np.zeros(count)
    for view in views:
        total[view.place] += view.weight[:, None] * view.rows
        seen[view.place] += view.weight
    covered = seen > 0.0
    return np.asarray(total[covered] / seen[covered, None]), covered


def _cloud_rms(views: Sequence[_View], covariance: Array) -> float:
    """Rms over all cameras' points along their normals.

    A camera's cloud has the more points of a place the more this faces it.
    """
    weight = np.concatenate([view.ring.arc[view.place] * view.weight for view in views])
    root = np.sqrt(weight)[:, None]
    rigid = np.concatenate([view.ring.rigid[view.place] for view in views])
    rows = _not_rigid(root * np.concatenate([view.rows for view in views]), root * rigid)
    variance = float(np.einsum("ni,ij,nj->", rows, covariance, rows, optimize=True))
    return float(np.sqrt(variance / weight.sum()))


def _views(
    model: SensorModel, layout: Layout, world_poses: WorldPoses,
    cameras: Mapping[str, CameraCalibration], ring: _Ring,
) -> list[_View]:  # fmt: skip
    """The views of the cameras that see any of a ring."""
    points, directions = ring.points, ring.normals
    found = []
    for place, (name, camera) in enumerate(cameras.items()):
        pose = world_poses.world_from_camera[name]
        local = transform(invert(pose), points)
        pixels = project(camera, local)
        towards = pose[:3, 3] - points
        facing = np.einsum("ni,ni->n", directions, towards) / np.linalg.norm(towards, axis=1)
        upward = directions[:, 2] > 0.9
        size = (camera.width - 1, camera.height - 1)
        good = (np.where(upward, 1.0, facing) > _FACING) & (local[:, 2] > _DEPTHS_M[0])
        good &= (local[:, 2] < _DEPTHS_M[1]) & ((pixels >= 0) & (pixels <= size)).all(axis=1)
        if not good.any():
            continue
        local, pixels, along = local[good], pixels[good], directions[good] @ pose[:3, :3]
        weight = np.where(upward, 1.0, facing)[good]
        row = np.zeros((len(local), layout.size))
        twist = np.concatenate([-np.einsum("ni,nij->nj", along, skew(local)), along], axis=1)
        row += twist @ world_poses.jacobian[6 * place : 6 * place + 6]
        index = layout.sensor(name)
        inverse = 1.0 / local[:, 2]
        where = image_place(camera, pixels)
        nearer = -np.einsum("ni,ni->n", along, local) / inverse
        row[:, index[:POLYNOMIAL]] += nearer[:, None] * model.polynomial_design(inverse, where)
        design = model.lens_design(camera, pixel_rays(camera, pixels))
        sideways = np.einsum("ni,nij->nj", along[:, :2], design) / inverse[:, None]
        row[:, index[POLYNOMIAL : POLYNOMIAL + LENS]] += sideways
        control, share = model.field_design(inverse, where)
        rows = np.arange(len(local))[:, None]
        np.add.at(row, (rows, index[model.field_start :][control]), nearer[:, None] * share)
        found.append(_View(ring, np.flatnonzero(good), weight, row))
    return found
