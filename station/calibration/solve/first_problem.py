"""The problem that observations pose, with the widest priors, and first poses of the cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from station.calibration.adjust.problem import SHAPE_KNOT_S, Problem, Sightings
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.adjust.widths import Widths
from station.calibration.detect.detections import FLOOR, Observations
from station.calibration.detect.step_names import FRONT, MARK, raised_height_m
from station.calibration.solve import refusals, resting_ball
from station.calibration.solve.initial import (
    Detections,
    add_bow_terms,
    agreeing_detections,
    first_state,
    named_surfaces,
    resting_places,
    resting_sightings,
    sorted_detections,
    spread_m,
    without_gaps,
)
from station.calibration.solve.pairwise import chain_poses, estimate_pairs
from station.core.errors import CalibrationError
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]

_MIN_SPREAD_M = 0.15
"""Least rms distance of the resting ball's places from one line, where no camera sees the floor."""


def first_problem(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    radius_m: float,
    reference: str,
) -> tuple[Problem, Mapping[str, Array]]:
    """The problem with the widest priors, and first poses of the cameras."""
    # Balls that are partly covered are good enough for first poses, and to tell what is a ball.
    seen = sorted_detections(observations.balls, list(cameras), radius_m, held=False)
    pairs = estimate_pairs({name: own.track for name, own in seen.items()})
    refusals.check_pairs(seen, pairs)
    poses = chain_poses(pairs, reference, list(cameras))
    refusals.check_connected(cameras, poses)
    return _problem(observations, cameras, seen, poses, radius_m, reference), poses


def height_words(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    *,
    radius_m: float,
    reference: str,
) -> str | None:
    """Words on a raised ball that was seen decimetres from the height that was told; None where all
    are right, or where nothing can be solved from what was seen so far."""
    observations = replace(observations, balls=without_gaps(observations.balls))
    with threadpool_limits(limits=1, user_api="blas"):
        try:
            problem, poses = first_problem(observations, cameras, radius_m, reference)
        except CalibrationError:
            return None
        return resting_ball.height_words(problem, first_state(problem, poses))


def _problem(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    seen: Mapping[str, Detections],
    poses: Mapping[str, Array],
    radius_m: float,
    reference: str,
) -> Problem:
    detections = sorted_detections(observations.balls, list(cameras), radius_m)
    agreed = agreeing_detections(detections, seen, poses)
    waved = {
        name: Sightings.of(
            camera,
            [d for d, good in zip(detections[name].waved, agreed[name], strict=True) if good],
        )
        for name, camera in cameras.items()
    }
    if not any(len(own.times_s) for own in waved.values()):
        raise CalibrationError(
            "no camera saw the whole ball where another one saw it: hold it with few fingers, and "
            "wave it where several cameras see it"
        )
    resting: dict[str, list[Sightings]] = {}
    places = {MARK: observations.mark, FRONT: observations.front, **observations.around}
    for place, balls in places.items():
        views = [resting_sightings(balls, camera, radius_m) for camera in cameras.values()]
        there = [view for view in views if view is not None]
        if there:
            resting[place] = there
    if MARK not in resting:
        raise CalibrationError(
            "no camera saw the ball rest on the mark; put it there and leave the booth for the "
            "two seconds that this step takes"
        )
    resting_ball.check_front(resting_places(resting, poses))
    heights_m = {
        place: height_m for place in resting if (height_m := raised_height_m(place)) is not None
    }
    surfaces = named_surfaces(observations.planes, cameras, poses)
    if not any(surface.surface == FLOOR for surface in surfaces):
        laid = {place: seen for place, seen in resting.items() if place not in heights_m}
        spread = spread_m(np.array(list(resting_places(laid, poses).values())))
        if spread < _MIN_SPREAD_M:
            raise CalibrationError(
                "no camera saw enough of the floor, and the ball did not lie on it at three "
                f"places that form a triangle: {resting_ball.AROUND_WORDS}"
            )
    problem = Problem(
        cameras, reference, radius_m, waved, resting, surfaces, Widths.widest(cameras), heights_m,
        shape_grid=TimeGrid.over(
            np.concatenate([seen.times_s for seen in waved.values()]), knot_s=SHAPE_KNOT_S
        ),
    )  # fmt: skip
    return add_bow_terms(problem, poses)
