"""The joint solution: poses, sensors, clock offsets, the ball's path, flat surfaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.calibration.adjust.normal import NormalEquations
from station.calibration.adjust.problem import Layout, Problem, State, moved_state
from station.calibration.adjust.residuals import DetectionResiduals, FitQuality

_ITERATIONS = 30
_CYCLES, _NEARLY = 6, 2.0
"""Steps after which, and length of the last one (standard deviations) below which, a solution is
taken to go in circles: a detection that is off pulls the path until it counts again."""


def solve_joint(
    problem: Problem, start: State, iterations: int = _ITERATIONS, *, settled: float,
    informed: bool = True,
) -> State:  # fmt: skip
    """The most likely state with each detection's deviation; with its information if ``informed``.

    It has settled once a step, over all unknowns but the path, is shorter than ``settled`` standard
    deviations. If the measurements are so inconsistent that there is no solution, ``last_step`` is
    infinite.
    """
    try:
        with np.errstate(over="raise", invalid="raise"):
            return _settle(problem, start, iterations, settled, informed)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return replace(start, last_step=np.inf)


def _settle(
    problem: Problem, start: State, iterations: int, settled: float, informed: bool
) -> State:
    layout = Layout.of(problem)
    state, size = start, np.inf
    for taken in range(iterations):
        if taken >= _CYCLES and size < _NEARLY:
            problem = _without_rejected(problem, state)
        equations = NormalEquations(problem, layout, state, start.scale)
        step, path_step, size = equations.solve()
        state = moved_state(problem, layout, state, step)
        state = replace(state, controls=state.controls + path_step)
        if size < settled:
            break
    # The scale applies to the detections only, not to priors and floors.
    fitness = FitQuality.of(problem, state)
    state = replace(state, deviations=fitness.deviations, scale=fitness.scale, last_step=size)
    if informed:
        information, gradient = NormalEquations(problem, layout, state, state.scale).reduced()
        state = replace(state, information=information, gradient=gradient)
    return state


def _without_rejected(problem: Problem, state: State) -> Problem:
    """The problem without the waved detections that count for nothing: they shall not come back."""
    waved = {
        name: seen.take(DetectionResiduals.along_path(problem, state, seen).robust > 0.0)
        if len(seen.times_s)
        else seen
        for name, seen in problem.waved.items()
    }
    return replace(problem, waved=waved)
