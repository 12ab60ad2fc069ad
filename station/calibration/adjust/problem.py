"""Measurements of a calibration as arrays, and the unknowns that explain them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.ball_shape import SHAPE, shape_turn
from station.calibration.adjust.sensor_model import (
    FULL,
    SensorModel,
    image_place,
)
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.adjust.widths import Widths
from station.calibration.detect.detections import FLOOR, BallDetection, PlaneObservation
from station.core.geometry import se3_exp
from station.core.lens import pixel_rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POSE_AND_CLOCK = 7
"""Pose (6) and clock (1) come before a camera's sensor parameters."""
BOW_SIZE = 9
"""Terms of the floor's bow about the mark: x, y, x^2, x y, y^2, x^3, x^2 y, x y^2, y^3."""
ROUND = TimeGrid(0.0, 0)
SHAPE_KNOT_S = 2.5
"""Somebody who walks around the mark with a ball turns it by less than half a right angle
meanwhile."""


@dataclass(frozen=True, slots=True)
class Sightings:
    """One camera's detections as arrays; shorter patch lists are padded with weight zero."""

    camera: str
    times_s: Array
    """(n,)"""
    centers: Array
    """(n, 3), camera frame, as detected without any correction."""
    pixels: Array
    """(n, k, 2)"""
    inverse: Array
    """(n, k)"""
    weight: Array
    """(n, k): 1 / variance."""
    place: Array
    """(n, k, 2): x, y in the image, from -1 to 1."""

    @classmethod
    def of(cls, camera: CameraCalibration, detections: Sequence[BallDetection]) -> Sightings:
        longest = max((len(detection.patches) for detection in detections), default=1)
        patches = np.zeros((len(detections), longest, 4))
        patches[..., 2:] = (0.6, np.inf)
        for row, detection in zip(patches, detections, strict=True):
            row[: len(detection.patches)] = detection.patches
            # Padding lies where the ball is, so that nothing about it is out of range.
            row[len(detection.patches) :, :2] = detection.patches[:, :2].mean(axis=0)
        return cls(
            camera=camera.name,
            times_s=np.array([detection.time_s for detection in detections]),
            centers=np.array([detection.center_m for detection in detections]).reshape(-1, 3),
            pixels=patches[..., :2],
            inverse=patches[..., 2],
            weight=1.0 / patches[..., 3],
            place=image_place(camera, patches[..., :2]),
        )

    def take(self, chosen: NDArray[np.bool_]) -> Sightings:
        """The chosen detections."""
        return Sightings(
            self.camera, self.times_s[chosen], self.centers[chosen], self.pixels[chosen],
            self.inverse[chosen], self.weight[chosen], self.place[chosen],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Surface:
    """One camera's view of a flat surface."""

    camera: str
    surface: str
    pixels: Array
    """(n, 2)"""
    inverse: Array
    """(n,)"""
    weight: Array
    """(n,): 1 / variance."""
    place: Array
    """(n, 2): x, y in the image, from -1 to 1."""
    plane: Array
    """m (3,) of 1/z = m . (x, y, 1) through the readings, uncorrected."""
    bow_terms: Array | None = None
    """(n, 9) of a floor that may be bowed."""

    @classmethod
    def of(cls, camera: CameraCalibration, seen: PlaneObservation, name: str) -> Surface:
        pixels, weight = seen.patches[:, :2], 1.0 / seen.patches[:, 3]
        ray = np.column_stack([pixel_rays(camera, pixels), np.ones(len(pixels))])
        m = np.linalg.solve(ray.T @ (ray * weight[:, None]), ray.T @ (weight * seen.patches[:, 2]))
        place = image_place(camera, pixels)
        return cls(
            camera.name, name, pixels, seen.patches[:, 2], weight, place, np.asarray(m, np.float64)
        )


@dataclass(frozen=True, slots=True)
class Problem:
    """All measurements, and what is unknown of the sensors."""

    cameras: Mapping[str, CameraCalibration]
    reference: str
    radius_m: float
    """As stated."""
    waved: Mapping[str, Sightings]
    resting: Mapping[str, Sequence[Sightings]]
    """Name of a place -> what each camera saw of the ball resting there."""
    surfaces: Sequence[Surface]
    widths: Widths
    """Widths of the priors."""
    heights_m: Mapping[str, float] = field(default_factory=dict)
    """Measured height of the ball's underside above the floor at a place; the floor itself where a
    place is not named."""
    bow_terms: Mapping[str, Array] = field(default_factory=dict)
    """(9,) of the floor below each place."""
    model: SensorModel = FULL
    shape_grid: TimeGrid = ROUND
    """Times between which the shape of the waved ball changes; ``ROUND`` for a ball that is a
    sphere."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Probability that people were wrong about some places of the ball."""

    places: tuple[str, ...]
    probability: float
    off_m: float
    """Height of the ball there above what people said, or distance from the plumb line, if so."""


@dataclass(frozen=True)
class State:
    """A solution, or a step towards it, in the reference camera's frame."""

    poses: Mapping[str, Array]
    """reference_from_camera, 4x4."""
    clock_s: Mapping[str, float]
    """Offset added to a camera's times."""
    sensors: Mapping[str, Array]
    """Parameters of each sensor, by the problem's model."""
    grid: TimeGrid
    controls: Array
    """(count, 3) of the ball's path."""
    places: Mapping[str, Array]
    """Positions (3,) of the resting ball."""
    planes: Mapping[str, Array]
    """q (3,) of q . X = 1."""
    radius_m: float
    bow: Array = field(default_factory=lambda: np.zeros(BOW_SIZE))
    """Coefficients (9,) of the floor's bow, metres at 1 m from the mark."""
    shape: Array = field(default_factory=lambda: np.zeros((0, SHAPE)))
    """Control points (k, 5) of the waved ball's shape, reference frame; by ``shape_grid``."""
    place_shapes: Mapping[str, Array] = field(default_factory=dict)
    """The resting ball's shape (5,), reference frame."""
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Information of the border's unknowns, priors included; empty unless asked for."""
    gradient: Array = field(default_factory=lambda: np.zeros(0))
    """Gradient of half the squared deviations by the border's unknowns."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Covariance of the border's unknowns."""
    doubts: Sequence[Doubt] = ()
    """Possible errors of what people said, the likeliest first; nothing where not asked for."""
    deviations: Mapping[str, Array] = field(default_factory=dict)
    """Squared deviation (n,) of each waved detection's centre in units of its noise."""
    scale: float = 1.0
    """Observed over expected standard deviation."""
    last_step: float = np.inf
    """Size of the last step, in standard deviations."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Positions of the border's unknowns: cameras, places, planes, the radius, the floor's bow."""

    starts: Mapping[str, int]
    """Start of each camera, place and plane; the reference has its sensor parameters alone."""
    size: int
    reference: str
    cameras: frozenset[str]
    per_camera: int
    waved_shape: slice
    place_shapes: Mapping[str, int]
    """Start of each place's shape; none of a ball that is a sphere."""

    @classmethod
    def of(cls, problem: Problem) -> Layout:
        starts, size = {}, 0
        per_camera = POSE_AND_CLOCK + problem.model.size
        for name in problem.cameras:
            # The reference's missing pose and clock point before its start, and are left out.
            starts[name] = size - (POSE_AND_CLOCK if name == problem.reference else 0)
            size += per_camera - (POSE_AND_CLOCK if name == problem.reference else 0)
        # A floor that no camera sees is known by the places where the ball rests on it.
        surfaces = dict.fromkeys((FLOOR, *(seen.surface for seen in problem.surfaces)))
        for name in (*problem.resting, *surfaces):
            starts[name] = size
            size += 3
        waved_shape = slice(size, size + SHAPE * problem.shape_grid.count)
        size = waved_shape.stop
        place_shapes = {}
        for name in problem.resting if problem.shape_grid.count else ():
            place_shapes[name] = size
            size += SHAPE
        return cls(
            starts, size + 1 + BOW_SIZE, problem.reference, frozenset(problem.cameras), per_camera,
            waved_shape, place_shapes,
        )  # fmt: skip

    def camera(self, name: str) -> Indices:
        """Indices of pose, clock and sensor parameters; -1 where they are fixed."""
        index = np.arange(self.per_camera) + self.starts[name]
        if name == self.reference:
            index[:POSE_AND_CLOCK] = -1
        return index

    def sensor(self, name: str) -> Indices:
        """Indices of the sensor parameters."""
        return self.camera(name)[POSE_AND_CLOCK:]

    def triple(self, name: str) -> Indices:
        """Indices (3,) of a place or plane."""
        return np.arange(3) + self.starts[name]

    def place_shape(self, name: str) -> Indices:
        """Indices (5,) of the shape of the ball at a place; -1 of a ball that is a sphere."""
        start = self.place_shapes.get(name)
        return np.full(SHAPE, -1) if start is None else np.arange(SHAPE) + start

    @property
    def shapes(self) -> Indices:
        """Indices of all shapes."""
        start = self.waved_shape.start
        return np.arange(start, self.waved_shape.stop + SHAPE * len(self.place_shapes))

    @property
    def radius(self) -> Indices:
        """Index (1,) of the ball's radius."""
        return np.array([self.size - 1 - BOW_SIZE])

    @property
    def bow(self) -> Indices:
        """Indices (9,) of the floor's bow."""
        return np.arange(self.size - BOW_SIZE, self.size)

    @property
    def geometry(self) -> Indices:
        """Indices of what places the cameras in the world: poses, places and planes."""
        parts = [
            self.camera(name)[:6] if name in self.cameras else self.triple(name)
            for name in self.starts
        ]
        index = np.concatenate(parts)
        return np.asarray(index[index >= 0])


def seen_shape(problem: Problem, state: State, camera: str, times_s: Array) -> Array:
    """Shape (n, 5) of the waved ball in a camera's frame, at times of the camera's clock."""
    if not problem.shape_grid.count:
        return np.zeros((len(times_s), SHAPE))
    first, value, _ = problem.shape_grid.basis(times_s + state.clock_s[camera])
    controls = state.shape[first[:, None] + np.arange(4)]
    turn = shape_turn(state.poses[camera][:3, :3].T)
    return np.einsum("nk,nkm->nm", value, controls) @ turn.T


def moved_state(problem: Problem, layout: Layout, state: State, step: Array) -> State:
    """The state after a step of the border's unknowns."""
    poses, clocks, sensors = {}, {}, {}
    for name in problem.cameras:
        index = layout.camera(name)
        moved = name != layout.reference
        poses[name] = state.poses[name] @ se3_exp(step[index[:6]]) if moved else state.poses[name]
        clocks[name] = state.clock_s[name] + (float(step[index[6]]) if moved else 0.0)
        sensors[name] = state.sensors[name] + step[index[POSE_AND_CLOCK:]]
    return replace(
        state,
        poses=poses,
        clock_s=clocks,
        sensors=sensors,
        places={name: at + step[layout.triple(name)] for name, at in state.places.items()},
        planes={name: q + step[layout.triple(name)] for name, q in state.planes.items()},
        radius_m=state.radius_m + float(step[layout.radius][0]),
        bow=state.bow + step[layout.bow],
        shape=state.shape + step[layout.waved_shape].reshape(state.shape.shape),
        place_shapes={
            name: own + step[layout.place_shape(name)] for name, own in state.place_shapes.items()
        },
    )
