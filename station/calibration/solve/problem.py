"""The calibration problem: observations as arrays, and the unknowns that explain them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.detections import FLOOR, BallDetection, PlaneObservation
from station.calibration.solve import depth_correction
from station.calibration.solve.trajectory import TimeGrid
from station.core.geometry import se3_exp
from station.core.lens import pixel_rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FOOT = 7
"""Unknowns of a camera before its depth correction: pose (6) and clock (1)."""
PER_CAMERA = FOOT + depth_correction.PARAMETERS


@dataclass(frozen=True, slots=True)
class Sightings:
    """One camera's detections as arrays; shorter patch lists are padded with weight zero."""

    camera: str
    times_s: Array
    """(n,)"""
    centers: Array
    """(n, 3), camera frame, as detected without depth correction."""
    ray: Array
    """(n, k, 2): x, y of rays (x, y, 1)."""
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
        return cls(
            camera=camera.name,
            times_s=np.array([detection.time_s for detection in detections]),
            centers=np.array([detection.center_m for detection in detections]).reshape(-1, 3),
            ray=pixel_rays(camera, patches[..., :2]),
            inverse=patches[..., 2],
            weight=1.0 / patches[..., 3],
            place=depth_correction.image_place(camera, patches[..., :2]),
        )

    def take(self, chosen: NDArray[np.bool_]) -> Sightings:
        """Some of them."""
        return Sightings(
            self.camera, self.times_s[chosen], self.centers[chosen], self.ray[chosen],
            self.inverse[chosen], self.weight[chosen], self.place[chosen],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Surface:
    """One camera's view of a flat surface, as normal equations of (m, depth correction)."""

    camera: str
    surface: str
    normal: Array
    """(8, 8)"""
    pull: Array
    """(8,) at m = 0 and no correction."""

    @classmethod
    def of(cls, camera: CameraCalibration, seen: PlaneObservation, name: str) -> Surface:
        patches = seen.patches
        ray = np.concatenate(
            [pixel_rays(camera, patches[:, :2]), np.ones((len(patches), 1))], axis=1
        )
        weight = 1.0 / patches[:, 3]
        m = np.linalg.solve(ray.T @ (ray * weight[:, None]), ray.T @ (weight * patches[:, 2]))
        place = depth_correction.image_place(camera, patches[:, :2])
        rows = np.concatenate([-ray, depth_correction.design(ray @ m, place)], axis=1)
        weighted = rows / patches[:, 3:]
        return cls(camera.name, name, weighted.T @ rows, weighted.T @ patches[:, 2])

    @property
    def plane(self) -> Array:
        """m (3,) of 1/z = m . (x, y, 1) without correction."""
        return np.asarray(np.linalg.solve(self.normal[:3, :3], -self.pull[:3]))


@dataclass(frozen=True, slots=True)
class Problem:
    """Observations that the solution must explain."""

    cameras: Mapping[str, CameraCalibration]
    reference: str
    radius_m: float
    waved: Mapping[str, Sightings]
    resting: Mapping[str, Sequence[Sightings]]
    """Name of a place -> what each camera saw of the ball resting there."""
    surfaces: Sequence[Surface]


@dataclass(frozen=True)
class State:
    """A solution, or the way to it, in the reference camera's frame."""

    poses: Mapping[str, Array]
    """reference_from_camera, 4x4."""
    clock_s: Mapping[str, float]
    """Offset added to a camera's times, seconds."""
    corrections: Mapping[str, Array]
    """(5,) each, ``depth_correction``'s parameters."""
    grid: TimeGrid
    controls: Array
    """(count, 3) of the ball's path."""
    places: Mapping[str, Array]
    """Places (3,) of the resting ball."""
    planes: Mapping[str, Array]
    """q (3,) of q . X = 1."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Covariance of the border's unknowns, by ``Layout``."""
    deviations: Mapping[str, Array] = field(default_factory=dict)
    """Squared deviation (n,) of each waved detection's centre in units of its noise."""
    scale: float = 1.0
    """Observed over expected standard deviation."""
    last_step: float = np.inf
    """On the way here, in standard deviations."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Positions of the border's unknowns."""

    starts: Mapping[str, int]
    """First index of each camera, place and plane; the reference has its depth correction alone."""
    size: int
    reference: str

    @classmethod
    def of(cls, problem: Problem) -> Layout:
        starts, size = {}, 0
        for name in problem.cameras:
            # The reference's missing pose and clock point before its start, and are left out.
            starts[name] = size - (FOOT if name == problem.reference else 0)
            size += PER_CAMERA - (FOOT if name == problem.reference else 0)
        # A floor that no camera sees is known by the places where the ball rests on it.
        surfaces = dict.fromkeys((FLOOR, *(seen.surface for seen in problem.surfaces)))
        for name in (*problem.resting, *surfaces):
            starts[name] = size
            size += 3
        return cls(starts, size, problem.reference)

    def camera(self, name: str) -> Indices:
        """Indices (12,) of pose, clock and correction; -1 where they are fixed."""
        index = np.arange(PER_CAMERA) + self.starts[name]
        if name == self.reference:
            index[:FOOT] = -1
        return index

    def correction(self, name: str) -> Indices:
        """Indices (5,) of the depth correction."""
        return self.camera(name)[FOOT:]

    def triple(self, name: str) -> Indices:
        """Indices (3,) of a place or plane."""
        return np.arange(3) + self.starts[name]


def moved_state(problem: Problem, layout: Layout, state: State, step: Array) -> State:
    """The state after a step of the border's unknowns."""
    poses, clocks, corrections = {}, {}, {}
    for name in problem.cameras:
        index = layout.camera(name)
        moved = name != layout.reference
        poses[name] = state.poses[name] @ se3_exp(step[index[:6]]) if moved else state.poses[name]
        clocks[name] = state.clock_s[name] + (float(step[index[6]]) if moved else 0.0)
        corrections[name] = state.corrections[name] + step[index[FOOT:]]
    return replace(
        state,
        poses=poses,
        clock_s=clocks,
        corrections=corrections,
        places={name: at + step[layout.triple(name)] for name, at in state.places.items()},
        planes={name: q + step[layout.triple(name)] for name, q in state.planes.items()},
    )
