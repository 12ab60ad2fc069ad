"""Reasons to refuse a calibration, each with its cause and remedy for the operator."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.problem import Problem, State
from station.calibration.adjust.residuals import MEDIAN
from station.calibration.detect.coverage import Coverage
from station.calibration.detect.detections import (
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
SIGMAS_95 = 1.96
_ONE_HEIGHT_M = 0.3
"""Heights that differ by less are one: a ball on a stand, and hung up as high."""
_START_AGAIN = "fix it, and start again with station calibrate --new"
STAND_WORDS = (
    "hang the ball above the mark, or put it on a stand, at measured heights (station calibrate "
    "stand)"
)
BOTH_HEIGHTS_WORDS = "show the ball at two measured heights, not one (station calibrate stand)"
BOARD_WORDS = "show a flat board at three distances (station calibrate depth)"


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
            "ball again; if it says so again, check the lenses (station calibrate board)"
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


def heights_remedy(heights_m: Collection[float]) -> str:
    """Advice against uncertain heights, where the ball was seen at these measured ones."""
    if not heights_m:
        return _remedy(STAND_WORDS)
    one = max(heights_m) - min(heights_m) < _ONE_HEIGHT_M
    return _remedy(BOTH_HEIGHTS_WORDS if one else "")


def _remedy(step: str) -> str:
    """Advice with the step that helps; "" where it was done."""
    return f"{step}, and wave the ball longer" if step else "wave the ball longer"


def check_predicted(
    predicted: PredictedError,
    limits: Limits,
    coverage: Coverage,
    heights_m: Collection[float],
    boarded: bool,
) -> None:
    """Refuse a calibration that may spoil heights or girths by more than the booth allows."""
    for what, sigma_m, limit_m, advice in (
        ("heights", predicted.height_sigma_m, limits.height_m, heights_remedy(heights_m)),
        (
            "girths",
            predicted.girth_sigma_m,
            limits.girth_m,
            _remedy("" if boarded else BOARD_WORDS),
        ),
    ):
        if not SIGMAS_95 * sigma_m <= limit_m:
            more = "" if coverage.enough else f"; {coverage.advice()}"
            raise CalibrationError(
                f"with this calibration, {what} could be wrong by up to "
                f"{1e3 * SIGMAS_95 * sigma_m:.1f} mm, but the limit is "
                f"{1e3 * limit_m:.0f} mm (calibrate.{what[:-1]}_limit_m): "
                f"{advice}{more}"
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


def check_upright(world_poses: WorldPoses) -> None:
    for name, pose in world_poses.world_from_camera.items():
        if pose[2, 3] < 0.0:
            raise CalibrationError(
                f"camera {name} would be {-pose[2, 3]:.2f} m below the floor: another object was "
                "taken for the ball on the mark; leave the booth, lay the ball on the "
                "mark, and run station calibrate mark"
            )
