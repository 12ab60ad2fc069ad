"""Detections as they would come from images, drawn directly: hundreds of times as fast.

Each camera sees its side of the ball's exact surface through its own depth error, patch by patch,
with the sensor's noise; no arm, no false detections. For tests of the solution alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.ball_shape import SHAPE
from station.calibration.adjust.equations import ball_rows, center_equations, corrected_centers
from station.calibration.adjust.problem import Sightings
from station.calibration.adjust.sensor_model import COARSE, image_place
from station.calibration.detect.ball_image import ball_inverse_depth
from station.calibration.detect.detections import (
    FLOOR,
    BallDetection,
    Observations,
    PlaneObservation,
)
from station.calibration.detect.planes import mean_share
from station.calibration.detect.step_names import AROUND, BALL, FRONT, HANGING, MARK, RAISED
from station.calibration.detect.swing import LOOK_S, whole_swings
from station.core.depth.correction import DepthCorrection
from station.core.geometry import invert, se3_exp, transform
from station.core.kinect_v1 import ROUNDING, SQUARE_ERROR
from station.core.lens import pixel_rays, project
from station.core.rig import CameraCalibration, Rig
from station.simulation import violations
from station.simulation.noise import UnitError
from station.simulation.procedure import VirtualProcedure
from station.simulation.scene import default_rig
from station.simulation.sensor import SimulatedBooth, SimulatedUnit

Array = NDArray[np.float64]

_CELL_PX = 9


def booth(seed: int, bias_m: float = 0.015, switches: Iterable[str] = ()) -> SimulatedBooth:
    """A booth that somebody has put up by eye: no two are alike.

    ``switches``: names of `station.simulation.violations`.
    """
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
        rig=rig,
        seed=seed,
        bias_m=bias_m,
        violations=frozenset(switches),
        uneven_floor_m=5e-4,
        uneven_board_m=2e-4,
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
    parameters = (shift, error.gain, error.curvature, shift * tilt_x, shift * tilt_y, 0.0)
    return COARSE.correction(np.array(parameters))


def observations(
    procedure: VirtualProcedure,
    *,
    rate_hz: float = 10.0,
    clock_error_s: float = 0.0,
    boards: bool = False,
    stands: bool = False,
) -> Observations:
    """A whole calibration's detections; with boards and the ball on its stand where wanted."""
    waved: list[BallDetection] = []
    planes: list[PlaneObservation | None] = []
    steps = [MARK, FRONT, *(step for step in procedure.steps if step.startswith(AROUND))]
    steps += [step for step in procedure.steps if stands and step.startswith(RAISED)]
    resting: dict[str, list[BallDetection]] = {step: [] for step in steps}
    start_s = procedure.starts_s(BALL)
    for index, name in enumerate(procedure.booth.rig.cameras):
        rng = np.random.default_rng((procedure.booth.seed, index, 9))
        unit = SimulatedUnit.of(procedure.booth, name)
        late_s = clock_error_s * rng.standard_normal()
        looks = [
            replace(seen, time_s=float(time_s + late_s))
            for time_s in np.arange(
                start_s + unit.phase_s, start_s + procedure.waving_s, 1 / rate_hz
            )
            if (seen := _ball(unit, procedure.ball_center_m(time_s), procedure.axis(BALL, time_s),
                              procedure, rng))
        ]  # fmt: skip
        waved += _fitted(procedure, name, looks)
        for step, found in resting.items():
            axis = procedure.axis(step, 0.0)
            looks = [
                replace(seen, time_s=time_s)
                for time_s in np.arange(0.0, LOOK_S, 0.2)
                if (seen := _ball(unit, procedure.resting_m(step, time_s), axis, procedure, rng))
            ]
            looks = _fitted(procedure, name, looks)
            found += whole_swings(looks) if step.startswith(HANGING) else looks
        planes.append(_floor(unit, procedure.booth, rng))
        for place, y in enumerate(procedure.board_at_m if boards else ()):
            planes.append(_board(unit, f"wall-{place}", y, rng))
    mark, front = resting.pop(MARK), resting.pop(FRONT)
    return Observations(
        waved, mark, front, [plane for plane in planes if plane is not None], resting
    )


def detections(
    procedure: VirtualProcedure, cameras: Sequence[str], center_m: Array, time_s: float
) -> list[BallDetection]:
    """Detections that some cameras make, at one time, of something as round as the ball."""
    rng = np.random.default_rng((procedure.booth.seed, round(1e3 * time_s)))
    found = []
    for name in cameras:
        unit = SimulatedUnit.of(procedure.booth, name)
        seen = _ball(unit, center_m, procedure.axis(BALL, time_s), procedure, rng)
        if seen is not None:
            found += _fitted(procedure, name, [replace(seen, time_s=time_s)])
    return found


def reported(unit: SimulatedUnit, pixels: Array, depth_m: Array) -> Array:
    """Depths (...) that the station reads of true depths at pixels (..., 2), without noise."""
    x, y = np.moveaxis(image_place(unit.camera, pixels), -1, 0)
    return np.asarray(unit.error.decoded_m(depth_m + unit.error.offset_m(x, y, depth_m)))


def _noise(unit: SimulatedUnit, variance: Array, frames: int, rng: np.random.Generator) -> Array:
    """Noise of means over frames, of which a part is the same in all of them."""
    share = unit.error.frozen_share
    sigma = np.sqrt(variance * (share + (1.0 - share) / frames))
    return np.asarray(rng.normal(0.0, sigma))


def _ball(
    unit: SimulatedUnit,
    center_m: Array,
    axis: Array,
    procedure: VirtualProcedure,
    rng: np.random.Generator,
) -> BallDetection | None:
    lens = unit.camera
    camera_from_world = invert(lens.world_from_camera)
    center = transform(camera_from_world, center_m)
    if center[2] < 0.6:
        return None
    radius = procedure.true_radius_m
    middle = project(lens, center)
    reach = 0.88 * radius * lens.K[0, 0] / center[2]
    size = np.array([lens.width, lens.height])
    if (middle < reach / 2).any() or (middle > size - reach / 2).any():
        return None
    grid = np.rint(np.arange(-reach, reach + 1, _CELL_PX))
    pixels = np.rint(middle + np.array(np.meshgrid(grid, grid)).reshape(2, -1).T)
    inside = np.linalg.norm(pixels - middle, axis=1) < reach
    inside &= ((pixels >= 0) & (pixels < size)).all(axis=1)
    pixels = pixels[inside]
    ray = pixel_rays(lens, pixels)
    w = ball_inverse_depth(center[None], ray[None], radius)[0][0]
    towards = np.append(ray, np.ones((len(ray), 1)), axis=1)
    outward = (towards / w[:, None] - center) / radius
    length = np.linalg.norm(towards, axis=1)
    cosine = np.abs(np.sum(outward * towards, axis=1)) / length
    higher_m = radius * procedure.oval_share * (outward @ camera_from_world[:3, :3] @ axis) ** 2
    depth = 1.0 / w - higher_m / cosine / length
    variance = (SQUARE_ERROR / cosine + ROUNDING) / _CELL_PX**2
    measured = 1.0 / reported(unit, pixels, depth) + rng.normal(0.0, np.sqrt(variance))
    patches = np.column_stack([pixels, measured, variance])
    seen_px = len(pixels) * _CELL_PX**2
    # Where a detection lies says the lens that is believed.
    beside = pixel_rays(procedure.booth.rig.cameras[lens.name], middle)
    center = np.append(beside, 1.0) * center[2]
    return BallDetection(
        lens.name, 0.0, center, np.eye(3), seen_px, procedure.radius_m, 2e-3, patches
    )


def _fitted(
    procedure: VirtualProcedure, name: str, seen: Sequence[BallDetection]
) -> list[BallDetection]:
    """One camera's detections with the centres that their readings give, and their covariances."""
    if not seen:
        return []
    believed, stated = procedure.booth.rig.cameras[name], procedure.radius_m
    sightings = Sightings.of(believed, list(seen))
    nothing, sphere = np.zeros(COARSE.size), np.zeros((len(seen), SHAPE))
    centers = corrected_centers(sightings, believed, COARSE, nothing, stated, sphere)
    rows = ball_rows(sightings, believed, COARSE, centers, nothing, stated, sphere)
    covariances = np.linalg.inv(center_equations(sightings, rows)[0][:, :3, :3])
    return [
        replace(one, center_m=center, covariance_m2=covariance)
        for one, center, covariance in zip(seen, centers, covariances, strict=True)
    ]


def _cells() -> Array:
    """Middles (n, 2) of cells of 12 x 12 pixels."""
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[6:480:12, 6:640:12])
    return np.stack([u, v], axis=1)


def _floor(
    unit: SimulatedUnit, booth: SimulatedBooth, rng: np.random.Generator
) -> PlaneObservation | None:
    pose, pixels = unit.camera.world_from_camera, _cells()
    towards = np.append(pixel_rays(unit.camera, pixels), np.ones((len(pixels), 1)), axis=1)
    turned = towards @ pose[:3, :3].T
    down = -turned[:, 2]
    cosine = down / np.linalg.norm(towards, axis=1)
    seen = (cosine > 0.3) & (down > 0.3 * pose[2, 3])
    if seen.sum() < 40:
        return None
    pixels, turned, down, cosine = pixels[seen], turned[seen], down[seen], cosine[seen]
    depth = pose[2, 3] / down
    for _ in range(3):
        x, y = (pose[:2, 3] + depth[:, None] * turned[:, :2]).T
        depth = (pose[2, 3] - violations.bow_m(booth.violations, booth.seed, x, y)) / down
    return _plane(unit, FLOOR, pixels, depth, cosine, 5e-4, rng)


def _board(
    unit: SimulatedUnit, surface: str, y_m: float, rng: np.random.Generator
) -> PlaneObservation | None:
    pose, pixels = unit.camera.world_from_camera, _cells()
    towards = np.append(pixel_rays(unit.camera, pixels), np.ones((len(pixels), 1)), axis=1)
    turned = towards @ pose[:3, :3].T
    side_m = y_m + 0.01 * np.sign(pose[1, 3] - y_m)
    depth = (side_m - pose[1, 3]) / turned[:, 1]
    at = pose[:3, 3] + depth[:, None] * turned
    seen = (np.abs(at[:, 0]) < 0.58) & (at[:, 2] > 0.03) & (at[:, 2] < 2.08) & (depth > 0.6)
    seen &= depth < 3.2
    if seen.sum() < 40:
        return None
    cosine = np.abs(turned[:, 1]) / np.linalg.norm(towards, axis=1)
    return _plane(unit, surface, pixels[seen], depth[seen], cosine[seen], 2e-4, rng)


def _plane(
    unit: SimulatedUnit,
    surface: str,
    pixels: Array,
    depth: Array,
    cosine: Array,
    uneven_m: float,
    rng: np.random.Generator,
) -> PlaneObservation:
    w = 1.0 / reported(unit, pixels, depth)
    noise = (SQUARE_ERROR / cosine + ROUNDING) / 12**2
    uneven = (uneven_m * w**2) ** 2
    measured = w + _noise(unit, noise, 30, rng) + rng.normal(0.0, np.sqrt(uneven))
    patches = np.column_stack([pixels, measured, noise * mean_share(30) + uneven])
    return PlaneObservation(unit.camera.name, surface, 12**2 * len(pixels), patches)


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


def _moved(balls: Iterable[BallDetection], camera: str, xi: Sequence[float]) -> list[BallDetection]:
    """The balls as a camera sees them that was turned and shifted: to its right, down, forward."""
    lens, now_from_then = default_rig().cameras[camera], invert(se3_exp(xi))
    moved = []
    for ball in balls:
        if ball.camera == camera:
            patches = ball.patches.copy()
            ray = np.column_stack([pixel_rays(lens, patches[:, :2]), np.ones(len(patches))])
            points = transform(now_from_then, ray / patches[:, 2:3])
            patches[:, :2], patches[:, 2] = project(lens, points), 1.0 / points[:, 2]
            center_m = transform(now_from_then, ball.center_m)
            ball = replace(ball, center_m=center_m, patches=patches)
        moved.append(ball)
    return moved


def _nudged(seen: Observations, camera: str) -> Observations:
    """The camera is shifted by 4 mm midway."""
    middle_s = _middle(seen)
    early = [ball for ball in seen.balls if ball.time_s < middle_s]
    late = [ball for ball in seen.balls if ball.time_s >= middle_s]
    return replace(seen, balls=[*early, *_moved(late, camera, (0.0, 0.0, 0.0, 0.004, 0.0, 0.0))])


def _moved_later(seen: Observations, camera: str, xi: Sequence[float]) -> Observations:
    """The camera is shifted after the waving."""
    rest = {place: _moved(balls, camera, xi) for place, balls in seen.around.items()}
    mark, front = (_moved(balls, camera, xi) for balls in (seen.mark, seen.front))
    return replace(seen, mark=mark, front=front, around=rest)


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
    Fault("another ball", lambda seen: seen, "the ball measures 100.0 mm in radius", 0.11),
    Fault("too short", lambda seen: _near(seen, 14.0), "camera "),
    Fault("nothing on the mark", lambda seen: replace(seen, mark=()), "on the mark"),
    Fault("a head above the mark", _head_on_mark, "below the floor"),
    Fault("no floor", lambda seen: replace(seen, planes=(), around={}), "the floor"),
    Fault(
        "no floor, and the ball on one line",
        lambda seen: replace(seen, planes=(), around={"around-2": seen.around["around-2"]}),
        "that form a triangle",
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
    Fault(
        "a camera nudged midway",
        lambda seen: _nudged(seen, "back-lower"),
        "camera back-lower, or one that saw the ball with it, was moved while",
    ),
    Fault(
        "a camera moved after the waving",
        lambda seen: _moved_later(seen, "back-lower", (0.0, 0.0, 0.0, 0.006, 0.0, 0.0)),
        "it, or one beside it, was moved in between",
    ),
    Fault(
        "a camera moved far after the waving",
        lambda seen: _moved_later(seen, "front-lower", (-7e-3, 2e-3, -4e-3, 5e-3, 10e-3, -4e-3)),
        "it, or one beside it, was moved in between",
    ),
)
