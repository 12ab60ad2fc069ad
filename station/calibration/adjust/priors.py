"""Priors of the unknowns: sensors, clocks, the ball's radius and shape, the floor's bow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from station.calibration.adjust.ball_shape import SHAPE
from station.calibration.adjust.contacts import plumb_ends
from station.calibration.adjust.problem import BOW_SIZE, Indices, Layout, Problem, State
from station.calibration.adjust.sensor_model import LAW, LAW_DIFFERENCE, LAW_SIGMA
from station.calibration.adjust.widths import BOW, BOW_TOLERANCE, RADIUS, sigma

Array = NDArray[np.float64]

FLOOR_SLOPE_RAD = 3e-3
"""Standard deviation of a whole floor's slope along each axis. The levelness number F_L (ASTM
E1155) is 12.5 over three standard deviations of the rise, in inches, across 10 feet: ordinary
floors, of F_L 13 to 25, slope by 1.4 to 2.7 mm per metre (one standard deviation), others by more.
"""
_CONSTANT_SHAPE = 0.5
"""Share of the variance of a ball's shape that stays while it is waved."""
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
    laws = np.array([layout.sensor(name)[LAW] for name in problem.cameras])
    spread = np.full((len(laws), len(laws)), LAW_SIGMA**2) + LAW_DIFFERENCE**2 * np.eye(len(laws))
    shares = np.array([state.sensors[name][LAW] for name in problem.cameras])
    yield Prior(laws, np.asarray(np.linalg.inv(spread), np.float64), shares)
    radius_sigma_m = sigma(RADIUS, widths.radius) * problem.radius_m
    off_m = np.array([state.radius_m - problem.radius_m])
    yield Prior(layout.radius, np.array([[radius_sigma_m**-2.0]]), off_m)
    bow_sigma = np.hypot(sigma(BOW, widths.bow) * BOW_TOLERANCE, slope_sigma(problem))
    yield Prior(layout.bow, np.diag(bow_sigma**-2.0), state.bow)
    if len(layout.shapes):
        precision = shape_precision(problem, layout) / widths.shape**2
        yield Prior(layout.shapes, precision, shape_values(state))


def slope_sigma(problem: Problem) -> Array:
    """Standard deviations (9,) of what a whole floor's slope adds to its bow, metres at 1 m.

    Where a plumb line shows what is vertical the floor's plane is level, and the floor may slope
    from it; otherwise the plane has the slope of the floor.
    """
    slopes = np.zeros(BOW_SIZE)
    if plumb_ends(problem) is not None:
        slopes[:2] = FLOOR_SLOPE_RAD
    return slopes


def shape_precision(problem: Problem, layout: Layout) -> Array:
    """Prior information of all shapes, of unit variance.

    Half of the variance of the waved ball's shape is constant, as where nobody turns it.
    """
    count = problem.shape_grid.count
    waved = np.full((count, count), _CONSTANT_SHAPE) + (1.0 - _CONSTANT_SHAPE) * np.eye(count)
    places = np.eye(len(layout.place_shapes))
    return np.kron(block_diag(np.linalg.inv(waved), places), np.eye(SHAPE))


def shape_values(state: State) -> Array:
    """All shapes in the order of their unknowns."""
    return np.concatenate([state.shape.ravel(), *state.place_shapes.values()])
