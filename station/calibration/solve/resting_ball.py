"""Refusals and advice on the resting ball: its heights, the plumb line and the floor's slope."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.contacts import PLUMB, contact_error_m, plumb_ends
from station.calibration.adjust.problem import Problem, State
from station.calibration.detect.step_names import AROUND, FRONT, MARK
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError

Array = NDArray[np.float64]

_FRONT_M = 0.2
"""Least distance of the ball in front of the mark from it."""
_MARK_TOLERANCE_M = 0.008
_HEIGHT_TOLERANCE_M = 0.2
"""Largest error of a stated height before anything is solved, with poses good to centimetres."""
_SURELY_WRONG, _MAYBE_WRONG = 0.5, 0.08
"""Probabilities from which on something is wrong of what people said of the resting ball, and from
which on it is mentioned; up to 0.04 where all is right."""
_LARGEST_SLOPE_RAD = np.radians(0.15)
"""A body's head is 5 mm to one side at it; heights hardly change (0.01 mm)."""
_MEASURE_AGAIN = (
    "measure the height of its underside above the floor again, and show the ball at its heights "
    "anew (station calibrate stand)"
)
HANGING_WORDS = (
    "hang the ball from one and the same hook at two heights, and let it come to rest (station "
    "calibrate stand --hanging)"
)
_HANG_ANEW = (
    f"{HANGING_WORDS}; if it did hang so, something lay under the ball on the floor, or the floor "
    "slopes by more than 5 mm per metre: take it away, or put the ball on a stand, and start again "
    "with station calibrate --new"
)
AROUND_WORDS = (
    "lay the ball to the left, to the right and behind the mark, 0.6 m away, where a lower camera "
    "sees it (station calibrate around)"
)


def _leveled_by(problem: Problem) -> str:
    """Words of what the world's horizontal is taken from."""
    return "the floor's slope" if plumb_ends(problem) is None else "what is vertical"


def slope_words(problem: Problem) -> str:
    """Advice against a doubtful vertical: of what helps, the next that was not done; "" if all
    was."""
    if not any(place.startswith(AROUND) for place in problem.resting):
        return AROUND_WORDS
    return HANGING_WORDS if plumb_ends(problem) is None else ""


def check_slope(problem: Problem, world_poses: WorldPoses) -> None:
    if world_poses.slope_sigma_rad > _LARGEST_SLOPE_RAD:
        advice = slope_words(problem) or _HANG_ANEW
        raise CalibrationError(
            f"{_leveled_by(problem)} is only known to within "
            f"{np.degrees(world_poses.slope_sigma_rad):.2f} degrees: {advice}"
        )


def height_words(problem: Problem, start: State) -> str | None:
    """Words on a height that is decimetres off: two that were exchanged would be another radius."""
    offs_m = {place: contact_error_m(problem, start, place) for place in problem.resting}
    laid = [abs(off_m) for place, off_m in offs_m.items() if place not in problem.heights_m]
    if max(laid, default=0.0) > 0.5 * _HEIGHT_TOLERANCE_M:
        # Something else was taken for the ball on the floor: the solution shows what.
        return None
    for place, height_m in problem.heights_m.items():
        off_m = offs_m[place]
        if abs(off_m) > _HEIGHT_TOLERANCE_M:
            return (
                f"the ball that was said to be {height_m:.2f} m above the floor was seen near "
                f"{height_m + off_m:.2f} m: {_MEASURE_AGAIN}"
            )
    return None


def doubt_words(problem: Problem, state: State) -> str:
    """Advice against a height that may be wrong by some millimetres; "" where none is."""
    for doubt in state.doubts:
        place = doubt.places[0]
        if place in problem.heights_m and doubt.probability > _MAYBE_WRONG:
            return (
                f"the ball at the height of {problem.heights_m[place]:.3f} m seems "
                f"{1e3 * abs(doubt.off_m):.0f} mm too {'high' if doubt.off_m > 0.0 else 'low'}: "
                f"{_MEASURE_AGAIN}"
            )
    return ""


def check_doubts(problem: Problem, state: State) -> None:
    """Refuse a ball that was not where it was said to be: at a height, plumb, on the floor.

    Without a stand and a visible floor, one box tilts the world.
    """
    if sum(doubt.probability for doubt in state.doubts) < _SURELY_WRONG:
        return
    worst = state.doubts[0]
    if worst.places[0] in problem.heights_m:
        heights = ", ".join(f"{problem.heights_m[place]:.3f}" for place in worst.places)
        raise CalibrationError(
            f"the ball at the height of {heights} m was seen {1e3 * abs(worst.off_m):.0f} mm too "
            f"{'high' if worst.off_m > 0.0 else 'low'}: {_MEASURE_AGAIN}; if it was right, let the "
            "sensors warm up and wave the ball again"
        )
    if worst.places == (PLUMB,):
        raise CalibrationError(
            f"the hanging ball's places are {1e3 * worst.off_m:.0f} mm from above one another: "
            f"{_HANG_ANEW}"
        )
    raise CalibrationError(
        "the places of the ball on the floor do not lie on one floor (one is "
        f"{1e3 * abs(worst.off_m):.0f} mm off): take away what the ball lay on, or lay it where "
        "the floor is even; start again with station calibrate --new"
    )


def check_front(places: Mapping[str, Array]) -> None:
    """Refuse a ball that was not moved off the mark: it says nothing of where people face."""
    if FRONT in places and np.linalg.norm(places[FRONT] - places[MARK]) < _FRONT_M:
        raise CalibrationError(
            "the ball in front of the mark lay where it lay on the mark: lay it 0.5 m in front, "
            "and run station calibrate mark --front"
        )


def check_mark(world_poses: WorldPoses, radius_m: float) -> None:
    off = world_poses.mark_height_m - radius_m
    if abs(off) > _MARK_TOLERANCE_M:
        raise CalibrationError(
            f"the ball on the mark is {1e3 * abs(off):.0f} mm too {'high' if off > 0 else 'low'} "
            "for one that rests on the floor: put it on the floor itself, and clear the floor"
        )
