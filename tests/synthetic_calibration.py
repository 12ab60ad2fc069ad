"""Detections as they would come from images, drawn directly: hundreds of times as fast.

Each camera sees its side of the ball's exact surface through its own depth error, patch by patch,
with the sensor's noise; no arm, no false detections. For tests of the solution alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.ball_image import ball_inverse_depth
from station.calibration.detect.detections import (
    FLOOR,
    BallDetection,
    Observations,
    PlaneObservation,
)
from station.calibration.solve import depth_correction
from station.calibration.solve.depth_correction import MIDDLE, correction_of
from station.calibration.solve.joint import local_equations
from station.calibration.solve.problem import Sightings
from station.core.geometry import invert, se3_exp, transform
from station.core.kinect_v1 import ROUNDING, SQUARE_ERROR
from station.core.rig import CameraCalibration, DepthCorrection, Rig
from station.simulation.noise import UnitError
from station.simulation.procedure import AROUND, BALL, VirtualProcedure
from station.simulation.scene import default_rig
from station.simulation.sensor import SimulatedBooth, SimulatedUnit

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
    rig = replace(rig, cameras=cameras)
    return SimulatedBooth(
        rig=rig, seed=seed, bias_m=bias_m, uneven_floor_m=5e-4, uneven_board_m=2e-4
    )


def factory(rig: Rig) -> dict[str, CameraCalibration]:
    """The cameras without their places."""
    return {
        name: replace(camera, world_from_camera=np.eye(4)) for name, camera in rig.cameras.items()
    }


def true_correction(error: UnitError) -> DepthCorrection:
    """The correction that undoes a unit's depth error."""
    shift = 0.25 * error.bias_m
    tilt_x, tilt_y = error.tilt
    parameters = (shift, error.gain, error.curvature, shift * tilt_x, shift * tilt_y)
    return correction_of(np.array(parameters))


def observations(
    procedure: VirtualProcedure, *, rate_hz: float = 10.0, clock_error_s: float = 0.0
) -> Observations:
    """A whole calibration's detections."""
    waved: list[BallDetection] = []
    mark: list[BallDetection] = []
    front: list[BallDetection] = []
    planes = []
    beside = [(f"{AROUND}-{i}", at) for i, at in enumerate(procedure.around_m)]
    around: dict[str, list[BallDetection]] = {step: [] for step, _ in beside}
    start_s = procedure.starts_s(BALL)
    low = np.array([0.0, 0.0, procedure.radius_m])
    for index, (name, camera) in enumerate(procedure.booth.rig.cameras.items()):
        rng = np.random.default_rng((procedure.booth.seed, index, 9))
        unit = SimulatedUnit.of(procedure.booth, name)
        late_s = clock_error_s * rng.standard_normal()
        for time_s in np.arange(start_s + unit.phase_s, start_s + procedure.waving_s, 1 / rate_hz):
            seen = _ball(camera, unit, procedure.ball_center_m(time_s), procedure, rng)
            if seen is not None:
                waved.append(replace(seen, time_s=float(time_s + late_s)))
        places = [(low, mark), (low - (0.0, procedure.front_m, 0.0), front)]
        places += [(np.array([x, y, low[2]]), around[step]) for step, (x, y) in beside]
        for place, found in places:
            looks = [_ball(camera, unit, place, procedure, rng) for _ in range(15)]
            found += [detection for detection in looks if detection is not None]
        planes.append(_floor(camera, unit, rng))
    return Observations(
        waved, mark, front, [plane for plane in planes if plane is not None], around
    )


def detections(
    procedure: VirtualProcedure, cameras: Sequence[str], center_m: Array, time_s: float
) -> list[BallDetection]:
    """Detections that some cameras make, at one time, of something as round as the ball."""
    rng = np.random.default_rng((procedure.booth.seed, round(1e3 * time_s)))
    found = []
    for name in cameras:
        unit = SimulatedUnit.of(procedure.booth, name)
        seen = _ball(procedure.booth.rig.cameras[name], unit, center_m, procedure, rng)
        if seen is not None:
            found.append(replace(seen, time_s=time_s))
    return found


def _measured(
    unit: SimulatedUnit, camera: CameraCalibration, u: Array, v: Array, w: Array
) -> Array:
    """Inverse depths as the unit reports them, its error written down once more."""
    error = unit.error
    x, y = 2.0 * u / (camera.width - 1) - 1.0, 2.0 * v / (camera.height - 1) - 1.0
    tilted = 1.0 + error.tilt[0] * x + error.tilt[1] * y
    shift = 0.25 * error.bias_m * tilted
    return np.asarray(w - shift - error.gain * w - error.curvature * (w - MIDDLE) ** 2)


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
        covariance: Array = np.linalg.inv(normal[0, :3, :3]).astype(np.float64)
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


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that goes wrong while a booth is calibrated, and what the operator must read."""

    name: str
    spoil: Callable[[Observations], Observations]
    words: str
    radius_m: float = 0.1


def _balls(
    seen: Observations, change: Callable[[BallDetection], BallDetection | None]
) -> Observations:
    changed = [change(ball) for ball in seen.balls]
    return replace(seen, balls=[ball for ball in changed if ball is not None])


def _middle(seen: Observations) -> float:
    return float(np.median([ball.time_s for ball in seen.balls]))


def _later(seen: Observations, camera: str, jump_s: float) -> Observations:
    middle_s = _middle(seen)

    def late(ball: BallDetection) -> BallDetection:
        moved = ball.camera == camera and ball.time_s > middle_s
        return replace(ball, time_s=ball.time_s + jump_s) if moved else ball

    return _balls(seen, late)


def _bumped(seen: Observations, camera: str) -> Observations:
    """The camera turns by a degree midway: all it sees turns the other way."""
    middle_s, turn = _middle(seen), se3_exp([0.0, np.radians(2.5), 0.0, 0.0, 0.0, 0.0])
    shift_px = 585.0 * np.tan(np.radians(2.5))

    def turned(ball: BallDetection) -> BallDetection:
        if ball.camera != camera or ball.time_s < middle_s:
            return ball
        patches = ball.patches.copy()
        patches[:, 0] += shift_px
        return replace(ball, center_m=transform(turn, ball.center_m), patches=patches)

    return _balls(seen, turned)


def _head_on_mark(seen: Observations) -> Observations:
    """One camera took a head for the resting ball, and no camera saw the floor."""
    highest = min(
        (ball for ball in seen.balls if ball.camera == "back-upper"),
        key=lambda ball: float(ball.center_m[1] / ball.center_m[2]),
    )
    return replace(seen, mark=[highest] * 15, planes=[])


def _scattering(seen: Observations, camera: str) -> Observations:
    rng = np.random.default_rng(5)

    def scattered(ball: BallDetection) -> BallDetection:
        if ball.camera != camera:
            return ball
        patches = ball.patches.copy()
        patches[:, 2] += rng.normal(0.0, 6e-3)
        shift_m = rng.normal(0.0, 0.01, 3)
        return replace(ball, center_m=ball.center_m + shift_m, patches=patches)

    return _balls(seen, scattered)


def _near(seen: Observations, seconds: float) -> Observations:
    start_s = min(ball.time_s for ball in seen.balls)
    return _balls(seen, lambda ball: ball if ball.time_s < start_s + seconds else None)


FAULTS = (
    Fault(
        "a camera that sees nothing",
        lambda seen: _balls(seen, lambda b: None if b.camera == "back-lower" else b),
        "camera back-lower saw the ball in 0 frames",
    ),
    Fault("a sensor that scatters", lambda seen: _scattering(seen, "front-lower"), "front-lower"),
    Fault("another ball", lambda seen: seen, "the ball measures 100 mm in radius", 0.11),
    Fault("too short", lambda seen: _near(seen, 14.0), "camera "),
    Fault("nothing on the mark", lambda seen: replace(seen, mark=()), "on the mark"),
    Fault("a head above the mark", _head_on_mark, "below the floor"),
    Fault("no floor", lambda seen: replace(seen, planes=(), around={}), "the floor"),
    Fault(
        "no floor, and the ball on one line",
        lambda seen: replace(seen, planes=(), around={"around-2": seen.around["around-2"]}),
        "away from one line",
    ),
    Fault(
        "a clock reset by a second",
        lambda seen: _later(seen, "back-upper", 1.0),
        "the clock of camera back-upper jumped",
    ),
    Fault(
        "a clock that slips by a frame",
        lambda seen: _later(seen, "front-lower", 0.033),
        "the clock of camera front-lower jumped",
    ),
    Fault("a camera bumped midway", lambda seen: _bumped(seen, "back-lower"), "back-lower"),
)
