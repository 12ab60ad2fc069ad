"""From single detections to a first state that the joint solution can start from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.detections import FLOOR, BallDetection, PlaneObservation
from station.calibration.solve import depth_correction
from station.calibration.solve.pairwise import GATE_M, Track
from station.calibration.solve.problem import Problem, Sightings, State, Surface
from station.calibration.solve.trajectory import TimeGrid
from station.core.geometry import transform
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RADIUS_SLACK = 0.03
_RADIUS_SIGMAS = 4.0
_LEAST_AT_REST = 5
_REST_GATE_M = 0.02
_THINNEST_PX = 12.0
"""A narrower strip of a surface does not say how it leans."""
_SAME_COSINE = np.cos(np.radians(4.0))
_SAME_DISTANCE_M = 0.08
"""Within which planes may be one, before depth errors are corrected."""


@dataclass(frozen=True, slots=True)
class Detections:
    """One camera's detections in the order of time, other round things left out."""

    waved: tuple[BallDetection, ...]
    track: Track


def sorted_detections(
    detections: Sequence[BallDetection], cameras: Sequence[str], radius_m: float
) -> dict[str, Detections]:
    """Each camera's detections whose radius is the ball's to within noise and depth error."""
    found = {}
    for name in cameras:
        own = sorted(
            (
                detection
                for detection in detections
                if detection.camera == name
                and abs(detection.radius_m - radius_m)
                < _RADIUS_SIGMAS * detection.radius_sigma_m + _RADIUS_SLACK * radius_m
            ),
            key=lambda detection: detection.time_s,
        )
        found[name] = Detections(
            tuple(own),
            Track(
                np.array([detection.time_s for detection in own]),
                np.array([detection.center_m for detection in own]).reshape(-1, 3),
            ),
        )
    return found


def confirmed(detections: Mapping[str, Detections], poses: Mapping[str, Array]) -> dict[str, Mask]:
    """Detections with which at least one other camera agrees."""
    in_reference = {
        name: Track(own.track.times_s, transform(poses[name], own.track.points))
        for name, own in detections.items()
        if name in poses
    }
    found = {}
    for name, track in in_reference.items():
        agreed = np.zeros(len(track.times_s), bool)
        for other, theirs in in_reference.items():
            if other != name:
                places, known = theirs.at(track.times_s)
                near = np.linalg.norm(places - track.points, axis=1) < GATE_M
                agreed |= known & near
        found[name] = agreed
    return found


def at_rest(
    detections: Sequence[BallDetection], camera: CameraCalibration, radius_m: float
) -> Sightings | None:
    """A camera's detections of a resting ball that agree with their median."""
    own = sorted_detections(detections, [camera.name], radius_m)[camera.name]
    if len(own.waved) < _LEAST_AT_REST:
        return None
    middle = np.median(own.track.points, axis=0)
    near = np.linalg.norm(own.track.points - middle, axis=1) < _REST_GATE_M
    if near.sum() < _LEAST_AT_REST:
        return None
    return Sightings.of(camera, [d for d, good in zip(own.waved, near, strict=True) if good])


def named_surfaces(
    planes: Sequence[PlaneObservation],
    cameras: Mapping[str, CameraCalibration],
    poses: Mapping[str, Array],
) -> list[Surface]:
    """Each view of a surface under the name of the side that it sees: a board has two.

    Views that do not agree with the largest number of others are of something else.
    """
    found: list[Surface] = []
    planes = [seen for seen in planes if np.ptp(seen.patches[:, :2], axis=0).min() > _THINNEST_PX]
    for surface in dict.fromkeys(seen.surface for seen in planes):
        views = [
            (seen, _facing(Surface.of(cameras[seen.camera], seen, surface), poses))
            for seen in planes
            if seen.surface == surface and seen.camera in poses
        ]
        while views:
            groups = [[other for other in views if _one_plane(view[1], other[1])] for view in views]
            largest = max(groups, key=lambda group: sum(seen.points for seen, _ in group))
            side = FLOOR if surface == FLOOR else f"{surface} from {largest[0][0].camera}"
            found += [Surface.of(cameras[seen.camera], seen, side) for seen, _ in largest]
            if surface == FLOOR:
                break
            views = [view for view in views if all(view is not member for member in largest)]
    return found


def _facing(surface: Surface, poses: Mapping[str, Array]) -> tuple[Array, float]:
    """Unit normal (3,) away from the camera, reference frame, and d of normal . X = d."""
    pose = poses[surface.camera]
    away = pose[:3, :3] @ surface.plane
    length = np.linalg.norm(away)
    return away / length, float((1.0 + away @ pose[:3, 3]) / length)


def _one_plane(view: tuple[Array, float], other: tuple[Array, float]) -> bool:
    return bool(view[0] @ other[0] > _SAME_COSINE and abs(view[1] - other[1]) < _SAME_DISTANCE_M)


def resting_places(
    resting: Mapping[str, Sequence[Sightings]], poses: Mapping[str, Array]
) -> dict[str, Array]:
    """Places (3,) of the resting ball in the reference frame: the mean over the cameras."""
    return {
        place: np.mean(
            [transform(poses[s.camera], s.centers.mean(axis=0)) for s in sightings], axis=0
        )
        for place, sightings in resting.items()
    }


def spread_m(centers: Array) -> float:
    """Rms distance of resting balls (n, 3) from one line; without it a floor's slope is unknown."""
    away = centers - centers.mean(axis=0)
    return float(np.sqrt(np.maximum(np.linalg.eigvalsh(away.T @ away / len(away))[1], 0.0)))


def floor_below(centers: Array, radius_m: float) -> Array:
    """q (3,) of the plane q . X = 1 that balls with centres (n, 3) lie on; the origin is above."""
    middle = centers.mean(axis=0)
    down = np.linalg.svd(centers - middle)[2][2]
    down = down * np.sign(down @ middle)
    return np.asarray(down / (down @ middle + radius_m))


def first_state(problem: Problem, poses: Mapping[str, Array]) -> State:
    """Poses as the pairs gave them, no depth correction, the path through all detections."""
    times, points = [], []
    for name, seen in problem.waved.items():
        times.append(seen.times_s)
        points.append(transform(poses[name], seen.centers))
    every_time, every_point = np.concatenate(times), np.concatenate(points)
    grid = TimeGrid.over(every_time)
    controls = grid.fit(every_time, every_point, np.full(len(every_time), 1e6))
    places = resting_places(problem.resting, poses)
    planes: dict[str, Array] = {}
    for surface in problem.surfaces:
        if surface.surface not in planes:
            normal, distance_m = _facing(surface, poses)
            planes[surface.surface] = normal / distance_m
    if FLOOR not in planes:
        planes[FLOOR] = floor_below(np.array(list(places.values())), problem.radius_m)
    return State(
        poses=dict(poses),
        clock_s=dict.fromkeys(problem.cameras, 0.0),
        corrections={name: np.zeros(depth_correction.PARAMETERS) for name in problem.cameras},
        grid=grid,
        controls=controls,
        places=places,
        planes=planes,
    )
