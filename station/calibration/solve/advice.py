"""Advice on a calibration that can be used: observations that would make it better."""

from __future__ import annotations

import numpy as np

from station.calibration.adjust.contacts import plumb_ends
from station.calibration.adjust.problem import Problem, State
from station.calibration.detect.coverage import Coverage
from station.calibration.detect.step_names import HANGING, WALL
from station.calibration.solve import refusals, resting_ball
from station.calibration.solve.refusals import SIGMAS_95, Limits
from station.calibration.solve.world import WorldPoses
from station.core.rig import PredictedError

_GOOD_SLOPE_RAD = np.radians(0.1)


def advice(
    problem: Problem, state: State, predicted: PredictedError, world_poses: WorldPoses,
    limits: Limits, coverage: Coverage,
) -> tuple[str, ...]:  # fmt: skip
    """Sentences on what could be better."""
    weak = [] if coverage.enough else [coverage.advice()]
    if words := resting_ball.doubt_words(problem, state):
        weak.append(words)
    if SIGMAS_95 * predicted.height_sigma_m > 0.5 * limits.height_m:
        weak.append(f"for heights, {refusals.heights_remedy(problem.heights_m.values())}")
    elif not problem.heights_m:
        weak.append(f"for heights, {refusals.STAND_WORDS}")
    if not boarded(problem):
        weak.append(f"for girths, {refusals.BOARD_WORDS}")
    if any(at.startswith(HANGING) for at in problem.heights_m) and plumb_ends(problem) is None:
        weak.append(f"to know what is vertical, {resting_ball.HANGING_WORDS}")
    elif world_poses.slope_sigma_rad > _GOOD_SLOPE_RAD and (
        words := resting_ball.slope_words(problem)
    ):
        weak.append(f"for the floor's slope, {words}")
    return tuple(weak)


def boarded(problem: Problem) -> bool:
    """True if the flat board was seen."""
    return any(surface.surface.startswith(WALL) for surface in problem.surfaces)
