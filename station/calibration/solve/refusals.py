"""Reasons to refuse a calibration, each with its cause and remedy for the operator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.contacts import PLUMB, contact_error_m, plumb_ends
from station.calibration.adjust.problem import Problem, State
from station.calibration.adjust.residuals import MEDIAN
from station.calibration.detect.coverage import Coverage
from station.calibration.detect.detections import (
    AROUND,
    FRONT,
    MARK,
    BallDetection,
    Observations,
)
from station.calibration.solve import jumps
from station.calibration.solve.acceptance import HeldOut, resting_offsets
from station.calibration.solve.initial import Detections
from station.calibration.solve.pairwise import Pair, Track
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.rig import PredictedError

Array = NDArray[np.float64]

_RADIUS_SHARE, _SOLVED_SHARE = 0.04, 0.012
"""Largest deviations of the measured radius, relative: as detected, where a depth error of 1 %
changes it by 1 %, and as solved for. Of balls that are .35 % larger and oval by 1.2 %, seen by
cameras with all errors at once, it is up to 1 %."""
_MIN_DETECTIONS = 60
_AGREEING_SHARE = 0.5
_LARGEST_SCATTER = 3.0
CONVERGED, DIVERGED = 0.3, 10.0
"""Largest last steps, in standard deviations, of a final solution and of one whose further checks
can still name the faulty camera."""
_RESTING_OFF_M = 0.002
"""Mean over the places; .1 to 1.0 mm in sound booths, 4 of a camera that was moved by 5."""
_ONE_PLACE_OFF_M = 0.006
"""At one place; up to 2.4 mm in sound booths."""
_FRONT_M = 0.2
"""Least distance of the ball in front of the mark from it."""
_MARK_TOLERANCE_M = 0.008
_HEIGHT_TOLERANCE_M = 0.2
"""Largest error of a stated height before anything is solved, with poses good to centimetres."""
_SURELY_WRONG = 0.5
"""Probability from which on something is wrong of what people said of the resting ball."""
_LARGEST_SLOPE_RAD = np.radians(0.15)
"""A body's head is 5 mm to one side at it; heights hardly change (0.01 mm)."""
SIGMAS_95 = 1.96
_MAYBE_WRONG = 0.08
"""... and from which on it is mentioned; up to 0.04 where all is right."""
_MEASURE_AGAIN = (
    "measure the height of its underside above the floor again, and show the ball at its heights "
    "anew (station calibrate stand)"
)
_START_AGAIN = "fix it, and start again with station calibrate --new"
STAND_WORDS = (
    "hang the ball above the mark, or put it on a stand, at measured heights (station calibrate "
    "stand)"
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
BOARD_WORDS = "show a flat board at three distances (station calibrate depth)"
AROUND_WORDS = (
    "lay the ball to the left, to the right and behind the mark, 0.6 m away, where a lower camera "
    "sees it (station calibrate around)"
)


@dataclass(frozen=True, slots=True)
class Limits:
    """Largest errors (95 %) that a calibration by itself may add, metres."""

    height_m: float = 0.006
    girth_m: float = 0.008


def check_counts(coverage: Coverage) -> None:
    covered = coverage.covered()
    if not any([*coverage.counts().values(), *covered.values()]):
        raise CalibrationError("the ball has not been waved yet: station calibrate ball")
    for name, count in coverage.counts().items():
        if count < min(_MIN_DETECTIONS, covered[name]):
            raise CalibrationError(
                f"camera {name} saw the ball well in {count} frames only ({_MIN_DETECTIONS} are "
                f"needed), and in {covered[name]} more partly covered or too far away: hold it "
                f"with few fingers from the side away from {name}, and wave it nearer to {name}"
            )
        if count < _MIN_DETECTIONS:
            raise CalibrationError(
                f"camera {name} saw the ball in {count} frames only ({_MIN_DETECTIONS} are "
                f"needed): check that the camera works and is not covered, and wave the ball "
                f"where {name} looks"
            )


def check_radius(balls: Sequence[BallDetection], radius_m: float) -> float:
    found = np.array([ball.radius_m for ball in balls])
    sure = 1.0 / np.array([ball.radius_sigma_m for ball in balls])
    order = np.argsort(found)
    total = np.cumsum(sure[order])
    measured = float(found[order][np.searchsorted(total, 0.5 * total[-1])])
    if abs(measured / radius_m - 1.0) > _RADIUS_SHARE:
        raise _other_ball(measured, radius_m)
    return measured


def check_solved_radius(problem: Problem, state: State) -> None:
    """Refuse another ball than was said: girths would be wrong by as much."""
    if abs(state.radius_m / problem.radius_m - 1.0) > _SOLVED_SHARE:
        raise _other_ball(state.radius_m, problem.radius_m)


def check_rest(observations: Observations, front_cameras: Sequence[str]) -> None:
    if not observations.mark:
        raise CalibrationError(
            "the ball was not seen on the mark: lay it there, and run station calibrate mark"
        )
    if not observations.front and not front_cameras:
        raise CalibrationError(
            "the direction that the person faces is not known: list the cameras in front "
            "(calibrate.front in booth.toml), or run station calibrate mark --front"
        )


def check_pairs(
    detections: Mapping[str, Detections], pairs: Mapping[tuple[str, str], Pair]
) -> None:
    if not pairs:
        raise CalibrationError(
            "no two cameras saw the ball at one time: wave it where several of them see it"
        )
    tracks = {name: own.track for name, own in detections.items()}
    check_clocks(jumps.large_jump(tracks, pairs))
    moved = jumps.moved_camera(tracks, pairs)
    if moved is not None:
        raise CalibrationError(f"camera {moved} was moved while the ball was waved: {_START_AGAIN}")
    for name in detections:
        shares = [float(pair.agree.mean()) for key, pair in pairs.items() if name in key]
        if shares and max(shares) < _AGREEING_SHARE:
            raise CalibrationError(
                f"only {100 * max(shares):.0f} % of what camera {name} saw agrees with the other "
                "cameras: another round object is in its view; remove it and wave the ball again"
            )


def check_corrected(tracks: Mapping[str, Track]) -> None:
    """Refuse what only corrected tracks show: a clock that slips, a camera that was bumped."""
    check_clocks(jumps.small_jump(tracks))
    moved = jumps.slightly_moved_camera(tracks)
    if moved is not None:
        raise CalibrationError(
            f"camera {moved}, or one that saw the ball with it, was moved while the ball was "
            f"waved: {_START_AGAIN}"
        )


def check_clocks(jump: jumps.ClockJump | None) -> None:
    if jump is not None:
        raise CalibrationError(
            f"the clock of camera {jump.camera} jumped by {1e3 * jump.jump_s:.0f} ms midway (its "
            "USB connection was lost, or the station is overloaded): wave the ball again"
        )


def check_connected(cameras: Iterable[str], poses: Mapping[str, Array]) -> None:
    apart = [name for name in cameras if name not in poses]
    if apart:
        raise CalibrationError(
            f"camera {apart[0]} saw the ball too rarely together with the others: wave it longer "
            f"where {apart[0]} and another camera see it at a time"
        )


def check_scatter(state: State) -> None:
    for name, deviation in state.deviations.items():
        scatter = float(np.sqrt(np.median(deviation) / MEDIAN)) if len(deviation) else 0.0
        if scatter > _LARGEST_SCATTER:
            raise CalibrationError(
                f"the readings of camera {name} vary {scatter:.1f} times as much as those of a "
                "normal sensor: let it warm up for 20 minutes, keep sunlight out of the booth, or "
                "replace it"
            )


def converged(state: State, largest_step: float = CONVERGED) -> bool:
    return state.last_step < largest_step


def check_converged(state: State, largest_step: float = CONVERGED) -> None:
    if not converged(state, largest_step):
        raise CalibrationError(
            "the cameras do not agree on where the ball was: a head or another round object may "
            "have been taken for the ball; remove it, make sure that no camera moves, and wave the "
            "ball again"
        )


def check_held_out(found: Mapping[str, HeldOut]) -> None:
    untested = [name for name, one in found.items() if not one.tested]
    if untested:
        raise CalibrationError(
            f"camera {untested[0]} could not be tested: wave the ball longer where it and another "
            "camera see it"
        )
    refused = {name: one for name, one in found.items() if not one.acceptable}
    if refused:
        name = max(refused, key=lambda name: refused[name].rms_m)
        away_mm = 1e3 * float(np.linalg.norm(found[name].mean_m))
        raise CalibrationError(
            f"in the test, camera {name} saw the ball {away_mm:.1f} mm away from where the others "
            f"saw it ({1e3 * found[name].rms_m:.1f} mm rms): make sure that no camera moves while "
            "the ball is waved, let the sensors warm up, and wave the ball again"
        )


def remedy(done: bool, step: str) -> str:
    """Advice against uncertain heights or girths; ``done``: the step that helps them was done."""
    return "wave the ball longer" if done else f"{step}, and wave the ball longer"


def slope_words(problem: Problem) -> str:
    """Advice against a doubtful vertical: of what helps, the next that was not done; "" if all
    was."""
    if not any(place.startswith(AROUND) for place in problem.resting):
        return AROUND_WORDS
    return HANGING_WORDS if plumb_ends(problem) is None else ""


def check_predicted(
    predicted: PredictedError, limits: Limits, coverage: Coverage, stood: bool, boarded: bool
) -> None:
    """Refuse a calibration that may spoil heights or girths by more than the booth allows."""
    for what, sigma_m, limit_m, advice in (
        ("heights", predicted.height_sigma_m, limits.height_m, remedy(stood, STAND_WORDS)),
        ("girths", predicted.girth_sigma_m, limits.girth_m, remedy(boarded, BOARD_WORDS)),
    ):
        if not SIGMAS_95 * sigma_m <= limit_m:
            more = "" if coverage.enough else f"; {coverage.advice()}"
            raise CalibrationError(
                f"with this calibration, {what} could be wrong by up to "
                f"{1e3 * SIGMAS_95 * sigma_m:.1f} mm, but the limit is "
                f"{1e3 * limit_m:.0f} mm (calibrate.{what[:-1]}_limit_m): "
                f"{advice}{more}"
            )


def leveled_by(problem: Problem) -> str:
    """Words of what the world's horizontal is taken from."""
    return "the floor's slope" if plumb_ends(problem) is None else "what is vertical"


def check_slope(problem: Problem, world_poses: WorldPoses) -> None:
    if world_poses.slope_sigma_rad > _LARGEST_SLOPE_RAD:
        advice = slope_words(problem) or _HANG_ANEW
        raise CalibrationError(
            f"{leveled_by(problem)} is only known to within "
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
        f"{1e3 * abs(worst.off_m):.0f} mm off): take away what the ball lay on; start again with "
        "station calibrate --new"
    )


def _other_ball(measured_m: float, radius_m: float) -> CalibrationError:
    return CalibrationError(
        f"the ball measures {1e3 * measured_m:.1f} mm in radius, but {1e3 * radius_m:.1f} mm was "
        "given: use the right ball, or correct calibrate.ball_radius_m (what a tape around the "
        "ball shows, divided by 6.283); then start again with station calibrate --new"
    )


def check_unmoved(problem: Problem, state: State) -> None:
    """Refuse a camera that was moved between the waving and the steps at which the ball rests."""
    found = resting_offsets(problem, state)
    means = {
        name: float(np.linalg.norm(np.mean(list(offs.values()), axis=0)))
        for name, offs in found.items()
        if len(offs) > 1
    }
    name = max(means, key=lambda one: means[one], default="")
    if means.get(name, 0.0) > _RESTING_OFF_M:
        raise CalibrationError(
            f"camera {name} sees the resting ball {1e3 * means[name]:.0f} mm away from where the "
            "others see it, but not the waved one: it, or one beside it, was moved in between; "
            f"{_START_AGAIN}"
        )
    for name, offs in found.items():
        for place, off in offs.items():
            if np.linalg.norm(off) > _ONE_PLACE_OFF_M:
                raise CalibrationError(
                    f"at one place ({place}), camera {name} sees the resting ball "
                    f"{1e3 * float(np.linalg.norm(off)):.0f} mm away from where the others see it: "
                    "something else was taken for the ball, or a camera was moved; start again "
                    "with station calibrate --new"
                )


def check_front(places: Mapping[str, Array]) -> None:
    """Refuse a ball that was not moved off the mark: it says nothing of where people face."""
    if FRONT in places and np.linalg.norm(places[FRONT] - places[MARK]) < _FRONT_M:
        raise CalibrationError(
            "the ball in front of the mark lay where it lay on the mark: lay it 0.5 m in front, "
            "and run station calibrate mark --front"
        )


def check_upright(world_poses: WorldPoses) -> None:
    for name, pose in world_poses.world_from_camera.items():
        if pose[2, 3] < 0.0:
            raise CalibrationError(
                f"camera {name} would be {-pose[2, 3]:.2f} m below the floor: another object was "
                "taken for the ball on the mark; leave the booth, lay the ball on the "
                "mark, and run station calibrate mark"
            )


def check_mark(world_poses: WorldPoses, radius_m: float) -> None:
    off = world_poses.mark_height_m - radius_m
    if abs(off) > _MARK_TOLERANCE_M:
        raise CalibrationError(
            f"the ball on the mark is {1e3 * abs(off):.0f} mm too {'high' if off > 0 else 'low'} "
            "for one that rests on the floor: put it on the floor itself, and clear the floor"
        )
