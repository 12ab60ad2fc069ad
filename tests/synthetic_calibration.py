"""Detections as they would come from images, drawn directly: hundreds of times as fast.

Each camera sees its side of the ball's exact surface through its own depth error, patch by patch,
with the sensor's noise; no arm, no false detections. For tests of the solution alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from station.calibration import depth_correction
from station.calibration.detections import FLOOR, BallDetection, Observations, PlaneObservation
from station.calibration.joint import Sightings, ball_inverse_depth, local_equations
from station.calibration.rig import CameraCalibration, Rig
from station.calibration.sensor_noise import ROUNDING, SQUARE_ERROR
from station.drivers.virtual import FRAME_RATE_HZ, SimulatedBooth, SimulatedUnit
from station.drivers.virtual_calibration import BALL, VirtualProcedure
from station.drivers.virtual_noise import Window
from station.drivers.virtual_scene import default_rig
from station.geometry import invert, se3_exp, transform

Array = NDArray[np.float64]

_CELL_PX = 9


def booth(seed: int, bias_m: float = 0.015) -> SimulatedBooth:
    """A booth that somebody has put up by eye: no two are alike."""
    rng = np.random.default_rng((seed, 77))
    rig = default_rig()
    cameras = {
        name: replace(
            camera,
            world_from_camera=camera.world_from_camera
            @ se3_exp(np.concatenate([rng.normal(0, 0.03, 3), rng.normal(0, 0.04, 3)])),
        )
        for name, camera in rig.cameras.items()
    }
    return SimulatedBooth(rig=replace(rig, cameras=cameras), seed=seed, bias_m=bias_m)


def factory(rig: Rig) -> dict[str, CameraCalibration]:
    """The cameras without their places."""
    return {
        name: replace(camera, world_from_camera=np.eye(4)) for name, camera in rig.cameras.items()
    }


def observations(
    procedure: VirtualProcedure, *, rate_hz: float = 10.0, clock_error_s: float = 0.0
) -> Observations:
    """A whole calibration's detections."""
    waved, mark, front, planes = [], [], [], []
    start_s = procedure.starts_s(BALL)
    low = np.array([0.0, 0.0, procedure.radius_m])
    for index, (name, camera) in enumerate(procedure.booth.rig.cameras.items()):
        rng = np.random.default_rng((procedure.booth.seed, index, 9))
        unit = SimulatedUnit.of(procedure.booth, name)
        late_s = clock_error_s * rng.standard_normal()
        step_s = round(FRAME_RATE_HZ / rate_hz) / FRAME_RATE_HZ
        for time_s in np.arange(start_s + unit.phase_s, start_s + procedure.waving_s, step_s):
            seen = _ball(camera, unit, procedure.ball_center_m(time_s), procedure, rng)
            if seen is not None:
                waved.append(replace(seen, time_s=float(time_s + late_s)))
        for place, found in ((low, mark), (low - (0.0, procedure.front_m, 0.0), front)):
            seen = [_ball(camera, unit, place, procedure, rng) for _ in range(15)]
            found += [detection for detection in seen if detection is not None]
        planes.append(_floor(camera, unit, rng))
    return Observations(waved, mark, front, [plane for plane in planes if plane is not None])


def _measured(
    unit: SimulatedUnit, camera: CameraCalibration, u: Array, v: Array, w: Array
) -> Array:
    """Inverse depths as the unit reports them."""
    columns, rows = np.rint(u).astype(int), np.rint(v).astype(int)
    found = [
        float(
            unit.error.apply(
                np.array([[depth]], np.float32),
                Window(int(row), int(column), camera.height, camera.width),
            )[0, 0]
        )
        for depth, row, column in zip(1.0 / w, rows, columns, strict=True)
    ]
    return 1.0 / np.array(found)


def _ball(
    camera: CameraCalibration,
    unit: SimulatedUnit,
    center_m: Array,
    procedure: VirtualProcedure,
    rng: np.random.Generator,
) -> BallDetection | None:
    center = transform(invert(camera.world_from_camera), center_m)
    if center[2] < 0.6:
        return None
    K, radius = camera.K, procedure.radius_m
    middle = (K @ (center / center[2]))[:2]
    reach = 0.88 * radius * K[0, 0] / center[2]
    size = (camera.width, camera.height)
    if (middle < reach / 2).any() or (middle > np.array(size) - reach / 2).any():
        return None
    grid = np.rint(np.arange(-reach, reach + 1, _CELL_PX))
    u, v = (middle[:, None, None] + np.array(np.meshgrid(grid, grid))).reshape(2, -1)
    u, v = np.rint(u), np.rint(v)
    inside = (np.hypot(u - middle[0], v - middle[1]) < reach) & (u >= 0) & (v >= 0)
    inside &= (u < camera.width) & (v < camera.height)
    u, v = u[inside], v[inside]
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)
    w = ball_inverse_depth(center[None], ray[None], radius)[0][0]
    outward = (np.append(ray, np.ones((len(u), 1)), axis=1) / w[:, None] - center) / radius
    towards = np.append(ray, np.ones((len(u), 1)), axis=1)
    cosine = np.abs(np.sum(outward * towards, axis=1)) / np.linalg.norm(towards, axis=1)
    variance = (SQUARE_ERROR / cosine + ROUNDING) / _CELL_PX**2
    measured = _measured(unit, camera, u, v, w) + rng.normal(0.0, np.sqrt(variance))
    patches = np.stack([u, v, measured, variance], axis=1)
    seen = BallDetection(
        camera.name, 0.0, center, np.eye(3), len(u) * _CELL_PX**2, radius, 2e-3, patches
    )
    for _ in range(3):
        sightings = Sightings.of(camera, [seen])
        correction = np.zeros(depth_correction.PARAMETERS)
        normal, pull = local_equations(sightings, seen.center_m[None], correction, radius)
        covariance = np.linalg.inv(normal[0, :3, :3])
        seen = replace(
            seen, center_m=seen.center_m - covariance @ pull[0, :3], covariance_m2=covariance
        )
    return seen


def _floor(
    camera: CameraCalibration, unit: SimulatedUnit, rng: np.random.Generator
) -> PlaneObservation | None:
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[6:480:12, 6:640:12])
    K = camera.K
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=1)
    down = -(ray @ camera.world_from_camera[2, :3])
    w = down / camera.world_from_camera[2, 3]
    cosine = down / np.linalg.norm(ray, axis=1)
    seen = (cosine > 0.3) & (w > 0.3)
    if seen.sum() < 40:
        return None
    u, v, w = u[seen], v[seen], w[seen]
    variance = (SQUARE_ERROR / cosine[seen] + ROUNDING) / (12**2 * 30) + (5e-4 * w**2) ** 2
    measured = _measured(unit, camera, u, v, w) + rng.normal(0.0, np.sqrt(variance))
    return PlaneObservation(
        camera.name, FLOOR, 12**2 * len(u), np.stack([u, v, measured, variance], axis=1)
    )
