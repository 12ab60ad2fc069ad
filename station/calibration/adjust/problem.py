"""Measurements of a calibration as arrays, and the unknowns that explain them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.sensor_model import FULL, SensorModel, image_place
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.adjust.widths import BOW, BOW_TOLERANCE, RADIUS, Widths, sigma
from station.calibration.detect.detections import FLOOR, BallDetection, PlaneObservation
from station.core.geometry import se3_exp
from station.core.lens import pixel_rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POSE_AND_CLOCK = 7
"""Pose (6) and clock (1) come before a camera's sensor parameters."""
BOW_SIZE = 7
"""Terms of the floor's bow: x^2, x y, y^2, x^3, x^2 y, x y^2, y^3 about the mark."""


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
    """(n, 7) of a floor that may be bowed."""

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
    """(7,) of the floor below each place."""
    model: SensorModel = FULL


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
    """Coefficients (7,) of the floor's bow, metres at 1 m from the mark."""
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Information of the border's unknowns, priors included; empty unless asked for."""
    gradient: Array = field(default_factory=lambda: np.zeros(0))
    """Gradient of half the squared deviations by the border's unknowns."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Covariance of the border's unknowns."""
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
        return cls(
            starts, size + 1 + BOW_SIZE, problem.reference, frozenset(problem.cameras), per_camera
        )

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

    @property
    def radius(self) -> Indices:
        """Index (1,) of the ball's radius."""
        return np.array([self.size - 1 - BOW_SIZE])

    @property
    def bow(self) -> Indices:
        """Indices (7,) of the floor's bow."""
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


CLOCK_TOLERANCE_S = 0.005
"""Standard deviation of one camera's clock against another's, before it is solved for."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior of some unknowns of the border, a normal distribution."""

    index: Indices
    information: Array
    """(k, k)"""
    values: Array
    """(k,) deviations of the unknowns from its mean."""


def priors(problem: Problem, layout: Layout, state: State) -> Iterator[Prior]:
    """All priors of a problem at a state."""
    widths = problem.widths
    for name in problem.cameras:
        own = state.sensors[name]
        information = problem.model.prior(own, widths.sensor(name), widths.field_per_m)
        yield Prior(layout.sensor(name), information, own)
        if name != layout.reference:
            clock = np.array([[CLOCK_TOLERANCE_S**-2.0]])
            yield Prior(layout.camera(name)[6:7], clock, np.array([state.clock_s[name]]))
    radius_sigma_m = sigma(RADIUS, widths.radius) * problem.radius_m
    off_m = np.array([state.radius_m - problem.radius_m])
    yield Prior(layout.radius, np.array([[radius_sigma_m**-2.0]]), off_m)
    bow_sigma = sigma(BOW, widths.bow) * BOW_TOLERANCE
    yield Prior(layout.bow, np.diag(bow_sigma**-2.0), state.bow)


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
    )
