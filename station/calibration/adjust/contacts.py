"""Contacts of the resting ball: with the floor, with a stand of measured height above it, or with
the plumb line on which it hangs.

People say that it lies or hangs there, and may be wrong: something is under the ball, a height was
misread, the hook moved. What may be wrong is a belief with a prior probability; the solution is
averaged over all beliefs (`station.calibration.adjust.averaging`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.ball_shape import SHAPE, shape_terms
from station.calibration.adjust.problem import BOW_SIZE, Indices, Layout, Problem, State
from station.calibration.detect.detections import FLOOR
from station.calibration.detect.step_names import HANGING
from station.core.geometry import level_axes

Array = NDArray[np.float64]

CONTACT_M = 0.0005
"""Standard deviation of a ball's height on an even floor."""
TAPE_M = 0.001
"""Standard deviation of a height that was measured with a tape."""
PLUMB_M = 0.0015
"""Standard deviation, along each horizontal axis, of a ball's places above one another that hangs
from one hook at two heights: the string lies a millimetre or two elsewhere on the hook, and the
ball, whose middle is a millimetre from below its knot where its wall is uneven, has turned."""
PLUMB = "plumb"
"""Name of the plumb line among the places."""
_TAIL = 4.0
"""Degrees of freedom (Student's t) of a contact: the ball may lie on something else."""
_SURE_TAIL = 20.0
"""Degrees of freedom of a measured height and a plumb line, which are hardly wrong: sensors whose
errors have an unexpected form must not push them aside."""
_FLOOR_WRONG, _HEIGHT_WRONG, _ALL_WRONG, _HOOK_WRONG = 3e-4, 0.06, 0.05, 0.1
"""Odds against all being as was said, of something that lies under the ball at one place, of one
height that was measured wrongly, of all heights being wrong by the same amount (measured with a
tape whose hook is loose, or from a carpet), and of a string that was hung elsewhere between two
heights."""
_ONE_WRONG_M, _ALL_WRONG_M, _HOOK_WRONG_M = 0.015, 0.008, 0.008
"""Standard deviations of these errors."""


@dataclass(frozen=True, slots=True)
class Belief:
    """An assumption on what people said of the resting ball, and what is wrong of it."""

    wrong: tuple[str, ...]
    """Places whose height is wrong, or `PLUMB`; none where all is as it was said."""
    probability: float
    """Before anything is seen."""
    size_m: float
    """Standard deviation of the error, which these places share; of `PLUMB`, along each axis."""


@dataclass(frozen=True, slots=True)
class Contacts:
    """All places of the resting ball, linear about a state."""

    places: tuple[str, ...]
    """(k,): a place for its height, and `PLUMB` for each of two horizontal axes."""
    rows: Array
    """(k, m): derivatives of the errors by the border's unknowns."""
    off_m: Array
    """(k,): how much too high the ball is, or how far its places are from above one another."""
    sigma_m: Array
    """(k,)"""
    weight: Array
    """(k,), 1/m^2: what the solution weighs them by; less where the ball is far off."""

    @classmethod
    def of(cls, problem: Problem, layout: Layout, state: State) -> Contacts:
        places = tuple(problem.resting)
        rows = np.array([_row(problem, layout, state, place) for place in places])
        off_m = np.array([contact_error_m(problem, state, place) for place in places])
        raised = np.array([place in problem.heights_m for place in places])
        sigma_m = np.where(raised, np.hypot(CONTACT_M, TAPE_M), CONTACT_M)
        # A ball that lies on something else must not tilt the floor before that is found out.
        tail = np.where(raised, _SURE_TAIL, _TAIL)
        if (ends := plumb_ends(problem)) is not None:
            plumb_rows, plumb_off_m = _plumb(layout, state, *ends)
            places += (PLUMB, PLUMB)
            rows, off_m = np.concatenate([rows, plumb_rows]), np.append(off_m, plumb_off_m)
            sigma_m, tail = np.append(sigma_m, [PLUMB_M] * 2), np.append(tail, [_SURE_TAIL] * 2)
        weight = sigma_m**-2.0 * tail / (tail + (off_m / sigma_m) ** 2)
        return cls(places, rows, off_m, sigma_m, weight)

    def covariance(self, belief: Belief) -> Array:
        """Covariance (k, k), m^2, of the errors under a belief."""
        wrong = self._doubted(belief)
        shared = np.eye(len(wrong)) if PLUMB in belief.wrong else np.ones((len(wrong),) * 2)
        return np.diag(self.sigma_m**2) + belief.size_m**2 * shared * np.outer(wrong, wrong)

    def size_m(self, belief: Belief, step: Array) -> float:
        """Error of what a belief doubts, after a step (m,): upwards, or from the plumb line."""
        off_m = (self.off_m + self.rows @ step)[self._doubted(belief)]
        return float(np.linalg.norm(off_m) if PLUMB in belief.wrong else off_m.mean())

    def _doubted(self, belief: Belief) -> NDArray[np.bool_]:
        return np.isin(self.places, belief.wrong)


def beliefs(problem: Problem) -> Sequence[Belief]:
    """All that may be wrong, one thing at a time, after the belief that nothing is."""
    raised = tuple(problem.heights_m)
    odds: dict[tuple[str, ...], tuple[float, float]] = {
        (place,): (_HEIGHT_WRONG if place in raised else _FLOOR_WRONG, _ONE_WRONG_M)
        for place in problem.resting
    }
    if len(raised) > 1:
        odds[raised] = _ALL_WRONG, _ALL_WRONG_M
    if plumb_ends(problem) is not None:
        odds[PLUMB,] = _HOOK_WRONG, _HOOK_WRONG_M
    whole = 1.0 + sum(odd for odd, _ in odds.values())
    doubtful = (Belief(wrong, odd / whole, size_m) for wrong, (odd, size_m) in odds.items())
    return [Belief((), 1.0 / whole, 0.0), *doubtful]


def plumb_ends(problem: Problem) -> tuple[str, str] | None:
    """The lowest and the highest place at which the ball hung; None unless there are two."""
    heights_m = problem.heights_m
    hung = sorted((at for at in heights_m if at.startswith(HANGING)), key=heights_m.__getitem__)
    return (hung[0], hung[-1]) if len(hung) > 1 else None


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


def _plumb(layout: Layout, state: State, low: str, high: str) -> tuple[Array, Array]:
    """Derivatives (2, m) of how far one place is from above another along two horizontal axes, and
    how far it is (2,), metres.

    The horizontal is that of the floor's plane, from which the floor itself may slope.
    """
    q = state.planes[FLOOR]
    length = np.linalg.norm(q)
    up = -q / length
    axes = level_axes(up)
    between = state.places[high] - state.places[low]
    rows = np.zeros((2, layout.size))
    rows[:, layout.triple(high)], rows[:, layout.triple(low)] = axes, -axes
    # The axes turn with the floor: what is high above another place moves most.
    rows[:, layout.triple(FLOOR)] = (up @ between) * axes / length
    return rows, axes @ between
