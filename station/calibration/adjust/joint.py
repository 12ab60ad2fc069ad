"""The joint solution: poses, sensors, clock offsets, the ball's path, flat surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.calibration.adjust.normal import NormalEquations
from station.calibration.adjust.problem import Layout, Problem, State, moved_state
from station.calibration.adjust.residuals import FitQuality

_ITERATIONS = 30
_SETTLED = 0.1
"""Step in standard deviations."""


def solve_joint(
    problem: Problem, start: State, iterations: int = _ITERATIONS, *, informed: bool = True
) -> State:
    """The most likely state with each detection's deviation; with its information if ``informed``.

    If the measurements are so inconsistent that there is no solution, ``last_step`` is infinite.
    """
    try:
        with np.errstate(over="raise", invalid="raise"):
            return _settle(problem, start, iterations, informed)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return replace(start, last_step=np.inf)


def _settle(problem: Problem, start: State, iterations: int, informed: bool) -> State:
    layout = Layout.of(problem)
    state, size = start, np.inf
    for _ in range(iterations):
        equations = NormalEquations(problem, layout, state, start.scale)
        step, path_step, size = equations.solve()
        state = moved_state(problem, layout, state, step)
        state = replace(state, controls=state.controls + path_step)
        if size < _SETTLED:
            break
    # The scale applies to the detections only, not to priors and floors.
    fitness = FitQuality.of(problem, state)
    state = replace(state, deviations=fitness.deviations, scale=fitness.scale, last_step=size)
    if informed:
        information, gradient = NormalEquations(problem, layout, state, state.scale).reduced()
        state = replace(state, information=information, gradient=gradient)
    return state
