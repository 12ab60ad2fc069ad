"""Errors of heights, girths and the cloud that follow from a calibration's covariance.

A standing body is replaced by rings of points about the mark. A camera that sees a point at the
depth z with the ray d reports X = T d z; its change by the pose's twist and the sensor's parameters
gives one row per point. A tilted world moves the whole body, which spoils no shape: rigid motions
are left out of all rings together. A girth is then the mean of its ring's rows times 2 pi.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.contacts import plumb_ends
from station.calibration.adjust.priors import FLOOR_SLOPE_RAD
from station.calibration.adjust.problem import Layout, Problem, State
from station.calibration.adjust.sensor_model import LENS, POLYNOMIAL, SensorModel, image_place
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.geometry import invert, skew, transform
from station.core.lens import pixel_rays, project
from station.core.rig import CameraCalibration, PredictedError

Array = NDArray[np.float64]

_RINGS_M = {"chest": 1.28, "waist": 1.08, "hip": 0.88}
_HALF_WIDTH_M, _HALF_DEPTH_M = 0.17, 0.12
_AROUND = 24
_LEGS_M = (0.15, 0.4, 0.65)
_CROWN_M = 1.75
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

    def seen(points: Array, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        rows, covered = _rows(problem.model, layout, world_poses, cameras, points, directions)
        if not len(rows):
            raise CalibrationError(
                f"no camera sees {points[0, 2]:.2f} m above the mark: turn a camera there, and "
                "calibrate again"
            )
        return rows, covered

    def sigma(row: Array) -> float:
        return float(np.sqrt(max(float(row @ state.covariance @ row), 0.0)))

    every, rigid, ring_of = [], [], []
    for height_m in (*_LEGS_M, *_RINGS_M.values()):
        points, normals = _ring(height_m)
        rows, covered = seen(points, normals)
        every.append(rows)
        rigid.append(np.concatenate([np.cross(points, normals), normals], axis=1)[covered])
        ring_of += [height_m] * len(rows)
    crown = seen(np.array([[0.0, 0.0, _CROWN_M]]), np.array([[0.0, 0.0, 1.0]]))[0][0]
    whole = _not_rigid(np.concatenate(every), np.concatenate(rigid))
    rings = [whole[np.array(ring_of) == height_m] for height_m in _RINGS_M.values()]
    # Where nothing hung, the floor counts as level.
    unknown_rad = FLOOR_SLOPE_RAD if plumb_ends(problem) is None else 0.0
    girths = [sigma(2.0 * np.pi * rows.mean(axis=0)) for rows in rings]
    variance = np.einsum("ni,ij,nj->n", whole, state.covariance, whole, optimize=True)
    return PredictedError(
        height_sigma_m=sigma(crown),
        girth_sigma_m=max(girths),
        normal_rms_m=float(np.sqrt(variance.mean())),
        tilt_sigma_rad=float(np.hypot(world_poses.slope_sigma_rad, unknown_rad)),
    )


def _not_rigid(rows: Array, rigid: Array) -> Array:
    """Rows (n, m) without what moves the whole body rigidly, whose rows are (n, 6)."""
    return np.asarray(rows - rigid @ np.linalg.lstsq(rigid, rows, rcond=None)[0])


def _ring(height_m: float) -> tuple[Array, Array]:
    """Points (n, 3) around a body at a height, at even turns of their normals (n, 3)."""
    turn = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    nx, ny = np.cos(turn), np.sin(turn)
    length = np.hypot(_HALF_WIDTH_M * nx, _HALF_DEPTH_M * ny)
    points = np.stack(
        [
            _HALF_WIDTH_M**2 * nx / length,
            _HALF_DEPTH_M**2 * ny / length,
            np.full(_AROUND, height_m),
        ],
        axis=1,
    )
    return points, np.stack([nx, ny, np.zeros(_AROUND)], axis=1)


def _rows(
    model: SensorModel, layout: Layout, world_poses: WorldPoses,
    cameras: Mapping[str, CameraCalibration], points: Array, directions: Array,
) -> tuple[Array, NDArray[np.bool_]]:  # fmt: skip
    """Derivatives (k, m) of points (n, 3) along directions by all unknowns, of those that are
    seen, and which these are (n,)."""
    total, seen = np.zeros((len(points), layout.size)), np.zeros(len(points))
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
        if model.lens:
            design = model.lens_design(camera, pixel_rays(camera, pixels))
            sideways = np.einsum("ni,nij->nj", along[:, :2], design) / inverse[:, None]
            row[:, index[POLYNOMIAL : POLYNOMIAL + LENS]] += sideways
        if model.field:
            control, share = model.field_design(inverse, where)
            rows = np.arange(len(local))[:, None]
            np.add.at(row, (rows, index[model.field_start :][control]), nearer[:, None] * share)
        total[good] += weight[:, None] * row
        seen[good] += weight
    covered = seen > 0.0
    return np.asarray(total[covered] / seen[covered, None]), covered
