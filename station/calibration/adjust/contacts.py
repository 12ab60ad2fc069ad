"""Contacts of the resting ball: with the floor, or with a stand of measured height above it.

People say that it lies there, and may be wrong: something is under the ball, a height was misread.
What may be wrong is a belief with a prior probability; the solution is averaged over all beliefs
(`station.calibration.adjust.averaging`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.ball_shape import SHAPE, shape_terms
from station.calibration.adjust.problem import BOW_SIZE, Indices, Layout, Problem, State
from station.calibration.detect.detections import FLOOR

Array = NDArray[np.float64]

CONTACT_M = 0.0005
"""Standard deviation of a ball's height on an even floor."""
TAPE_M = 0.001
"""Standard deviation of a height that was measured with a tape."""
_TAIL = 4.0
"""Degrees of freedom (Student's t) of a contact: the ball may lie on something else."""
_STAND_TAIL = 20.0
"""Degrees of freedom of a measured height, which is hardly wrong: sensors whose errors have an
unexpected form must not push it aside."""
_FLOOR_WRONG, _STAND_WRONG, _ALL_WRONG = 3e-4, 0.06, 0.05
"""Odds against all being as was said, of something that lies under the ball at one place, of one
stand that was measured wrongly, and of all stands being wrong by the same amount: measured with a
tape whose hook is loose, or from a carpet."""
_ONE_WRONG_M, _ALL_WRONG_M = 0.015, 0.008
"""Standard deviations of these errors."""


@dataclass(frozen=True, slots=True)
class Belief:
    """An assumption on what people said of the resting ball, and what is wrong of it."""

    wrong: tuple[str, ...]
    """Places whose height is wrong; none where all is as it was said."""
    probability: float
    """Before anything is seen."""
    size_m: float
    """Standard deviation of the error, which all these places share."""


@dataclass(frozen=True, slots=True)
class Contacts:
    """All places of the resting ball, linear about a state."""

    places: tuple[str, ...]
    rows: Array
    """(k, m): derivatives of the heights by the border's unknowns."""
    off_m: Array
    """(k,): how much too high the ball is."""
    sigma_m: Array
    """(k,)"""
    weight: Array
    """(k,), 1/m^2: what the solution weighs them by; less where the ball is far off."""

    @classmethod
    def of(cls, problem: Problem, layout: Layout, state: State) -> Contacts:
        places = tuple(problem.resting)
        rows = np.zeros((len(places), layout.size))
        for row, place in zip(rows, places, strict=True):
            row[:] = _row(problem, layout, state, place)
        off_m = np.array([contact_error_m(problem, state, place) for place in places])
        stands = np.array([place in problem.heights_m for place in places])
        sigma_m = np.where(stands, np.hypot(CONTACT_M, TAPE_M), CONTACT_M)
        # A ball that lies on something else must not tilt the floor before that is found out.
        tail = np.where(stands, _STAND_TAIL, _TAIL)
        weight = sigma_m**-2.0 * tail / (tail + (off_m / sigma_m) ** 2)
        return cls(places, rows, off_m, sigma_m, weight)

    def covariance(self, belief: Belief) -> Array:
        """Covariance (k, k), m^2, of the heights' errors under a belief."""
        wrong = np.array([place in belief.wrong for place in self.places])
        return np.asarray(np.diag(self.sigma_m**2) + belief.size_m**2 * np.outer(wrong, wrong))


def beliefs(problem: Problem) -> Sequence[Belief]:
    """All that may be wrong, one thing at a time, after the belief that nothing is."""
    stands = tuple(problem.heights_m)
    odds: dict[tuple[str, ...], float] = {
        (place,): _STAND_WRONG if place in stands else _FLOOR_WRONG for place in problem.resting
    }
    if len(stands) > 1:
        odds[stands] = _ALL_WRONG
    whole = 1.0 + sum(odds.values())
    doubtful = (
        Belief(wrong, odd / whole, _ONE_WRONG_M if len(wrong) == 1 else _ALL_WRONG_M)
        for wrong, odd in odds.items()
    )
    return [Belief((), 1.0 / whole, 0.0), *doubtful]


def contact_error_m(problem: Problem, state: State, place: str) -> float:
    """Height (m) of a resting ball above where it touches the floor or its stand."""
    q = state.planes[FLOOR]
    length = np.linalg.norm(q)
    terms = problem.bow_terms.get(place, np.zeros(BOW_SIZE))
    # The underside of a ball that is not round stands off the sphere as its top does.
    shape = state.place_shapes.get(place, np.zeros(SHAPE))
    radius_m = state.radius_m * (1.0 + shape_terms(q / length) @ shape)
    above = (1.0 - q @ state.places[place]) / length
    return float(above - terms @ state.bow - radius_m - problem.heights_m.get(place, 0.0))


def _row(problem: Problem, layout: Layout, state: State, place: str) -> Array:
    """Derivatives (m,) of `contact_error_m` by the border's unknowns."""
    at, q = state.places[place], state.planes[FLOOR]
    length = np.linalg.norm(q)
    above = (1.0 - q @ at) / length
    parts: tuple[tuple[Indices, Array], ...] = (
        (layout.triple(place), -q / length),
        (layout.triple(FLOOR), -at / length - above * q / length**2),
        (layout.radius, np.array([-1.0])),
        (layout.bow, -problem.bow_terms.get(place, np.zeros(BOW_SIZE))),
        (layout.place_shape(place), -state.radius_m * shape_terms(q / length)),
    )
    row = np.zeros(layout.size)
    for index, values in parts:
        row[index[index >= 0]] = values[index >= 0]
    return row
