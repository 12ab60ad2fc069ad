"""A first state for the joint solution, from single detections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.equations import bow_terms, corrected_centers
from station.calibration.adjust.problem import Problem, Sightings, State, Surface, seen_shape
from station.calibration.adjust.trajectory import TimeGrid, path_points
from station.calibration.detect.detections import FLOOR, BallDetection, PlaneObservation
from station.calibration.detect.step_names import MARK
from station.calibration.solve.pairwise import GATE_M, Track
from station.core.geometry import transform
from station.core.lens import pixel_rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RADIUS_ALIKE = 0.05
"""Distance of a detection's own radius from the camera's median, as a share of the radius."""
_RADIUS_SLACK = 0.10
"""Distance from the stated radius: a depth error of 1 % changes it by 1 %."""
_MIN_AT_REST = 5
_LONGEST_GAP_S = 10.0
_PATH_WEIGHT = 1e6
"""1/m^2: a first path passes its points within a millimetre, ..."""
_SINGLE_WEIGHT = 6e4
"""... single detections within 4 mm."""
_BRIDGED_M = 0.1
"""Distance of a true detection from a path that bridges a second."""
_REST_GATE_M = 0.02
_THINNEST_PX = 12.0
"""A narrower strip of a surface does not say how it leans."""
_SAME_COSINE = np.cos(np.radians(4.0))
_SAME_DISTANCE_M = 0.08
"""Tolerance for two views of one plane, before depth errors are corrected."""


@dataclass(frozen=True, slots=True)
class Detections:
    """One camera's detections in the order of time, other round things left out."""

    waved: tuple[BallDetection, ...]
    track: Track


def sorted_detections(
    detections: Sequence[BallDetection],
    cameras: Sequence[str],
    radius_m: float,
    *,
    held: bool = True,
) -> dict[str, Detections]:
    """Each camera's detections of the ball, in the order of time.

    A hand that covers part of the ball, a head or a fist shows as a radius of its own: only
    detections are kept whose radius is that of the camera's typical detection and, with ``held``,
    certain.
    """
    found = {}
    for name in cameras:
        sure = [
            detection
            for detection in detections
            if detection.camera == name
            and (not held or detection.certain(radius_m))
            and abs(detection.radius_m - radius_m) < _RADIUS_SLACK * radius_m
        ]
        typical_m = float(np.median([ball.radius_m for ball in sure])) if sure else radius_m
        own = sorted(
            (ball for ball in sure if abs(ball.radius_m - typical_m) < _RADIUS_ALIKE * radius_m),
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


def agreeing_detections(
    detections: Mapping[str, Detections],
    others: Mapping[str, Detections],
    poses: Mapping[str, Array],
) -> dict[str, Mask]:
    """Masks of the detections that agree with any of another camera's ``others``."""
    in_reference = {
        name: Track(own.track.times_s, transform(poses[name], own.track.points))
        for name, own in others.items()
    }
    found = {}
    for name, own in detections.items():
        points = transform(poses[name], own.track.points)
        agreed = np.zeros(len(points), bool)
        for other, theirs in in_reference.items():
            if other != name:
                places, known = theirs.at(own.track.times_s)
                agreed |= known & (np.linalg.norm(places - points, axis=1) < GATE_M)
        found[name] = agreed
    return found


def resting_sightings(
    detections: Sequence[BallDetection], camera: CameraCalibration, radius_m: float
) -> Sightings | None:
    """A camera's detections of a resting ball that agree with their median."""
    own = sorted_detections(detections, [camera.name], radius_m, held=False)[camera.name]
    if len(own.waved) < _MIN_AT_REST:
        return None
    middle = np.median(own.track.points, axis=0)
    near = np.linalg.norm(own.track.points - middle, axis=1) < _REST_GATE_M
    if near.sum() < _MIN_AT_REST:
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


def without_gaps(balls: Sequence[BallDetection]) -> list[BallDetection]:
    """The detections in the order of time, at times in which long gaps are shorter: what nobody saw
    takes no memory."""
    found = sorted(balls, key=lambda ball: ball.time_s)
    gaps_s = np.diff([ball.time_s for ball in found], prepend=found[0].time_s if found else 0.0)
    earlier_s = np.cumsum(np.maximum(0.0, gaps_s - _LONGEST_GAP_S))
    return [
        replace(ball, time_s=ball.time_s - float(shift))
        for ball, shift in zip(found, earlier_s, strict=True)
    ]


def resting_places(
    resting: Mapping[str, Sequence[Sightings]], poses: Mapping[str, Array]
) -> dict[str, Array]:
    """Positions (3,) of the resting ball, reference frame: the mean over the cameras."""
    return {
        place: np.mean(
            [transform(poses[s.camera], s.centers.mean(axis=0)) for s in sightings], axis=0
        )
        for place, sightings in resting.items()
    }


def spread_m(centers: Array) -> float:
    """Rms distance of resting balls (n, 3) from one line: on one line they leave the slope open."""
    away = centers - centers.mean(axis=0)
    return float(np.sqrt(np.maximum(np.linalg.eigvalsh(away.T @ away / len(away))[1], 0.0)))


def floor_below(centers: Array, radius_m: float) -> Array:
    """q (3,) of the plane q . X = 1 that balls with centres (n, 3) lie on; the origin is above."""
    middle = centers.mean(axis=0)
    down = np.linalg.svd(centers - middle)[2][2]
    down = down * np.sign(down @ middle)
    return np.asarray(down / (down @ middle + radius_m))


def add_bow_terms(problem: Problem, poses: Mapping[str, Array]) -> Problem:
    """The problem with the terms of the floor's bow, about the mark.

    Poses good to centimetres are enough: the bow is smooth over decimetres.
    """
    start = first_state(problem, poses)
    q, mark = start.planes[FLOOR], start.places[MARK]
    up = -q / np.linalg.norm(q)
    surfaces = []
    for surface in problem.surfaces:
        if surface.surface == FLOOR:
            towards = np.column_stack(
                [
                    pixel_rays(problem.cameras[surface.camera], surface.pixels),
                    np.ones(len(surface.pixels)),
                ]
            )
            points = transform(poses[surface.camera], towards / (towards @ surface.plane)[:, None])
            surface = replace(surface, bow_terms=bow_terms(points, mark, up))
        surfaces.append(surface)
    below = {place: bow_terms(at[None], mark, up)[0] for place, at in start.places.items()}
    return replace(problem, surfaces=surfaces, bow_terms=below)


def first_state(problem: Problem, poses: Mapping[str, Array]) -> State:
    """Poses as the pairs gave them, no depth correction, the path through all detections."""
    times, points = [], []
    for name, seen in problem.waved.items():
        times.append(seen.times_s)
        points.append(transform(poses[name], seen.centers))
    every_time, every_point = np.concatenate(times), np.concatenate(points)
    grid = TimeGrid.over(every_time)
    controls = grid.fit(every_time, every_point, np.full(len(every_time), _PATH_WEIGHT))
    places = resting_places(problem.resting, poses)
    planes: dict[str, Array] = {}
    for surface in problem.surfaces:
        if surface.surface not in planes:
            normal, distance_m = _facing(surface, poses)
            planes[surface.surface] = normal / distance_m
    if FLOOR not in planes:
        laid = [at for place, at in places.items() if place not in problem.heights_m]
        planes[FLOOR] = floor_below(np.array(laid), problem.radius_m)
    return State(
        poses=dict(poses),
        clock_s=dict.fromkeys(problem.cameras, 0.0),
        sensors={name: np.zeros(problem.model.size) for name in problem.cameras},
        grid=grid,
        controls=controls,
        places=places,
        planes=planes,
        radius_m=problem.radius_m,
    )


def extended_state(problem: Problem, training: Problem, solved: State) -> State:
    """The state that a solution without the held-out seconds gives all of the problem.

    The path goes through its own points at the times that were solved for, and through corrected
    detections near it in the seconds between. (Through all detections, false ones included, it
    would be bent by decimetres, and a sensor's field would follow it.)
    """
    known = np.concatenate(
        [seen.times_s + solved.clock_s[name] for name, seen in training.waved.items()]
    )
    first, value, _ = solved.grid.basis(known)
    points = path_points(solved.controls, first, value)
    grid = TimeGrid.over(np.concatenate([seen.times_s for seen in problem.waved.values()]))
    weights = np.full(len(known), _PATH_WEIGHT)
    bridged = grid.fit(known, points, weights)
    times, places = [known], [points]
    for name, seen in problem.waved.items():
        centers = corrected_centers(
            seen, problem.cameras[name], problem.model, solved.sensors[name], solved.radius_m,
            seen_shape(problem, solved, name, seen.times_s),
        )  # fmt: skip
        found, when = transform(solved.poses[name], centers), seen.times_s + solved.clock_s[name]
        first, value, _ = grid.basis(when)
        near = np.linalg.norm(found - path_points(bridged, first, value), axis=1) < _BRIDGED_M
        times.append(when[near])
        places.append(found[near])
    every, there = np.concatenate(times), np.concatenate(places)
    weights = np.append(weights, np.full(len(every) - len(known), _SINGLE_WEIGHT))
    return replace(solved, grid=grid, controls=grid.fit(every, there, weights))
