"""Each reason to refuse a calibration, by itself: its cause and its remedy are named."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from station.calibration.adjust.problem import Doubt, Problem, State
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.detect.coverage import Coverage
from station.calibration.detect.detections import FLOOR, BallDetection, Observations
from station.calibration.detect.step_names import raised_height_m
from station.calibration.solve import jumps, refusals, resting_ball
from station.calibration.solve.acceptance import HeldOut
from station.calibration.solve.initial import Detections, sorted_detections, without_gaps
from station.calibration.solve.pairwise import Pair, Track
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.rig import PredictedError
from station.simulation.scene import default_rig

CAMERAS = default_rig().cameras
NAMES = tuple(CAMERAS)
RADIUS_M = 0.1


def ball(
    radius_m: float = RADIUS_M, sigma_m: float = 1e-3, distance_m: float = 1.5, time_s: float = 0.0
) -> BallDetection:
    center = np.array([0.0, 0.0, distance_m])
    return BallDetection(
        NAMES[0], time_s, center, 1e-6 * np.eye(3), 2000, radius_m, sigma_m, np.zeros((0, 4))
    )


def seen(*, mark: bool) -> Observations:
    return Observations([], [ball()] if mark else [], [], [], {})


def coverage(balls: int, covered: int = 0) -> Coverage:
    found = Coverage(CAMERAS, NAMES[0], RADIUS_M)
    for sigma_m in [1e-4] * balls + [0.2 * RADIUS_M] * covered:
        found.add(ball(sigma_m=sigma_m))
    return found


def state(last_step: float = 0.0, deviation: float = 1.0) -> State:
    return State(
        poses={name: np.eye(4) for name in NAMES},
        clock_s=dict.fromkeys(NAMES, 0.0),
        sensors={},
        grid=TimeGrid(0.0, 8),
        controls=np.zeros((8, 3)),
        places={},
        planes={FLOOR: np.array([0.0, 0.5, 0.0])},
        radius_m=RADIUS_M,
        deviations={NAMES[0]: np.full(9, deviation)},
        last_step=last_step,
    )


def world(
    height_m: float = 1.0, mark_height_m: float = RADIUS_M, slope_sigma_rad: float = 1e-3
) -> WorldPoses:
    pose = np.eye(4)
    pose[2, 3] = height_m
    return WorldPoses(
        world_from_camera={NAMES[0]: pose},
        covariance=np.zeros((6, 6)),
        jacobian=np.zeros((6, 6)),
        mark_height_m=mark_height_m,
        slope_sigma_rad=slope_sigma_rad,
    )


def places(*names: str) -> Problem:
    """A problem of which only the resting ball's places are known."""
    heights_m = {name: height for name in names if (height := raised_height_m(name)) is not None}
    resting = dict.fromkeys(names, ())
    return cast(Problem, SimpleNamespace(resting=resting, heights_m=heights_m, bow_terms={}))


def tracks() -> dict[str, Detections]:
    return {name: Detections((), Track(np.zeros(0), np.zeros((0, 3)))) for name in NAMES[:2]}


def pairs(agreeing: float) -> dict[tuple[str, str], Pair]:
    times = np.arange(100.0)
    return {(NAMES[0], NAMES[1]): Pair(np.eye(4), times, times < 100 * agreeing)}


def predicted(height_m: float, girth_m: float) -> PredictedError:
    return PredictedError(height_m, girth_m, 1e-4, 1e-3)


def _raised_to(height_m: float) -> State:
    """A state in which the floor is 2 m below the origin, and the ball is seen at a height."""
    place = np.array([0.0, 2.0 - height_m - RADIUS_M, 0.0])
    return replace(state(), places={"hanging-700": place})


LIMITS = refusals.Limits()
REFUSED: dict[str, Callable[[], object]] = {
    "has not been waved yet: station calibrate ball": partial(refusals.check_counts, coverage(0)),
    "saw the ball in 5 frames only": partial(refusals.check_counts, coverage(5)),
    "and in 9 more partly covered or too far away: hold it with few fingers": partial(
        refusals.check_counts, coverage(5, covered=9)
    ),
    "the ball measures 110.0 mm in radius, but 100.0 mm was given": partial(
        refusals.check_radius, [ball(0.11)] * 3, RADIUS_M
    ),
    "the ball was not seen on the mark": partial(refusals.check_rest, seen(mark=False), NAMES),
    "the direction that the person faces is not known": partial(
        refusals.check_rest, seen(mark=True), ()
    ),
    "no two cameras saw the ball at one time": partial(refusals.check_pairs, tracks(), {}),
    f"only 20 % of what camera {NAMES[0]} saw agrees": partial(
        refusals.check_pairs, tracks(), pairs(0.2)
    ),
    f"the clock of camera {NAMES[1]} jumped by 500 ms": partial(
        refusals.check_clocks, jumps.ClockJump(NAMES[1], 0.5)
    ),
    f"camera {NAMES[1]} saw the ball too rarely together": partial(
        refusals.check_connected, NAMES, {NAMES[0]: np.eye(4)}
    ),
    f"the readings of camera {NAMES[0]} vary 4.0 times as much": partial(
        refusals.check_scatter, state(deviation=16.0 * 2.366)
    ),
    "do not agree on where the ball was": partial(refusals.check_converged, state(np.inf)),
    f"camera {NAMES[0]} could not be tested": partial(
        refusals.check_held_out, {NAMES[0]: HeldOut(3, 0.0, np.zeros(3))}
    ),
    f"in the test, camera {NAMES[0]} saw the ball 10.0 mm away": partial(
        refusals.check_held_out, {NAMES[0]: HeldOut(100, 2e-3, np.array([0.01, 0.0, 0.0]))}
    ),
    "heights could be wrong by up to 9.8 mm, but the limit is 6 mm": partial(
        refusals.check_predicted, predicted(5e-3, 1e-3), LIMITS, coverage(0), (), False
    ),
    "girths could be wrong by up to 9.8 mm, but the limit is 8 mm": partial(
        refusals.check_predicted, predicted(1e-3, 5e-3), LIMITS, coverage(0), (), False
    ),
    "the floor's slope is only known to within 0.29 degrees: lay the ball to the left": partial(
        resting_ball.check_slope, places(), world(slope_sigma_rad=5e-3)
    ),
    "0.29 degrees: hang the ball from one and the same hook at two heights": partial(
        resting_ball.check_slope, places("around-0", "hanging-1700"), world(slope_sigma_rad=5e-3)
    ),
    "what is vertical is only known to within 0.29 degrees: .*; if it did hang": partial(
        resting_ball.check_slope,
        places("around-0", "hanging-400", "hanging-1700"),
        world(slope_sigma_rad=5e-3),
    ),
    "the hanging ball's places are 12 mm from above one another: hang the ball from": partial(
        resting_ball.check_doubts,
        places(),
        replace(state(), doubts=[Doubt(("plumb",), 0.9, 0.012)]),
    ),
    f"camera {NAMES[0]} would be 0.50 m below the floor": partial(
        refusals.check_upright, world(height_m=-0.5)
    ),
    "the ball in front of the mark lay where it lay on the mark": partial(
        resting_ball.check_front, {"mark": np.zeros(3), "front": np.array([0.05, 0.0, 0.0])}
    ),
    "the ball on the mark is 20 mm too high": partial(
        resting_ball.check_mark, world(mark_height_m=0.12), RADIUS_M
    ),
}


def test_a_height_that_is_decimetres_off_is_named() -> None:
    problem = places("hanging-700")
    words = resting_ball.height_words(problem, _raised_to(1.7))
    assert words is not None
    assert "said to be 0.70 m above the floor was seen near 1.70 m: measure the height" in words
    assert resting_ball.height_words(problem, _raised_to(0.75)) is None


def test_a_height_that_may_be_wrong_is_mentioned() -> None:
    """One that was measured 5 mm wrong passed without a word."""
    problem, right = places("hanging-700", "hanging-1805"), Doubt(("hanging-1805",), 0.04, -0.003)
    assert resting_ball.doubt_words(problem, replace(state(), doubts=[right])) == ""
    doubtful = replace(state(), doubts=[replace(right, probability=0.14)])
    said = resting_ball.doubt_words(problem, doubtful)
    assert said.startswith(
        "the ball at the height of 1.805 m seems 3 mm too low: measure the height"
    )


def test_nothing_is_advised_that_was_done() -> None:
    """A ball that had hung at two heights was to be hung at two heights."""
    assert resting_ball.slope_words(places("around-0", "hanging-400", "hanging-1700")) == ""
    assert resting_ball.slope_words(places("around-0", "stand-400", "stand-1700"))


@pytest.mark.parametrize("words", REFUSED)
def test_a_refusal_names_its_cause(words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        REFUSED[words]()


def test_a_camera_that_was_moved_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jumps, "moved_camera", lambda *_: NAMES[1])
    with pytest.raises(CalibrationError, match=f"camera {NAMES[1]} was moved while"):
        refusals.check_pairs(tracks(), pairs(1.0))


def test_long_gaps_between_detections_take_no_memory() -> None:
    """Two runs of waving, an hour apart, took 12 GB."""
    times = (0.0, 0.5, 4000.0, 4003.0)
    found = without_gaps([ball(time_s=time_s) for time_s in reversed(times)])
    assert [one.time_s for one in found] == pytest.approx([0.0, 0.5, 10.5, 13.5])
    assert without_gaps([]) == []


def test_what_is_sound_passes() -> None:
    resting_ball.check_front({"mark": np.zeros(3), "front": np.array([0.5, 0.0, 0.0])})
    refusals.check_rest(replace(seen(mark=True), front=[ball()]), ())
    refusals.check_pairs(tracks(), pairs(1.0))
    refusals.check_connected(NAMES, {name: np.eye(4) for name in NAMES})
    refusals.check_scatter(state())
    refusals.check_converged(state())
    refusals.check_held_out({NAMES[0]: HeldOut(100, 2e-3, np.zeros(3))})
    refusals.check_predicted(predicted(1e-3, 1e-3), LIMITS, coverage(0), (), False)
    resting_ball.check_slope(places(), world())
    refusals.check_upright(world())
    resting_ball.check_mark(world(), RADIUS_M)
    assert refusals.check_radius([ball()] * 3, RADIUS_M) == RADIUS_M


def test_a_ball_that_is_partly_covered_counts_only_where_its_radius_is_certain() -> None:
    """Two metres away the edge of a hand was taken for the ball's, which stood 5 to 12 mm off."""

    def whole_m(distance_m: float) -> float:
        return 3.8e-5 * distance_m**3 / RADIUS_M

    balls = [
        ball(sigma_m=whole_m(2.0), distance_m=2.0, time_s=0.0),
        ball(sigma_m=1.4 * whole_m(2.0), distance_m=2.0, time_s=1.0),
        ball(sigma_m=whole_m(2.2), distance_m=2.2, time_s=2.0),
        ball(sigma_m=1.2 * whole_m(2.2), distance_m=2.2, time_s=3.0),
        ball(sigma_m=2.0 * whole_m(1.4), distance_m=1.4, time_s=4.0),
    ]
    kept = sorted_detections(balls, NAMES[:1], RADIUS_M)[NAMES[0]].waved
    assert [one.time_s for one in kept] == [0.0, 2.0, 4.0]
    assert [one.time_s for one in balls if one.certain(RADIUS_M)] == [0.0, 2.0, 4.0]
    at_rest = sorted_detections(balls, NAMES[:1], RADIUS_M, held=False)[NAMES[0]].waved
    assert len(at_rest) == 5
