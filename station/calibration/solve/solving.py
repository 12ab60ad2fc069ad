"""A booth's calibration from its observations: the joint solution, its test, the verdict.

Faulty input is refused with its cause and remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from station.calibration.adjust.averaging import averaged_state, most_probable_widths
from station.calibration.adjust.ball_shape import SHAPE
from station.calibration.adjust.joint import solve_joint
from station.calibration.adjust.problem import ROUND, Problem, State
from station.calibration.adjust.sensor_model import COARSE, SensorModel
from station.calibration.detect.coverage import Coverage
from station.calibration.detect.detections import Observations
from station.calibration.solve import acceptance, refusals, resting_ball, warming, world
from station.calibration.solve.acceptance import HeldOut
from station.calibration.solve.advice import advice, boarded
from station.calibration.solve.first_problem import first_problem
from station.calibration.solve.initial import (
    extended_state,
    first_state,
    without_gaps,
)
from station.calibration.solve.predicted import predict_errors
from station.calibration.solve.refusals import Limits
from station.calibration.solve.solution import Solution
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.rig import CameraCalibration, Rig

Array = NDArray[np.float64]
Progress = Callable[[str], None]

_FINE_ITERATIONS = 16
_COARSELY, _TO_TEST, _FINALLY = 1.0, 0.3, 0.2
"""Steps, in standard deviations, at which a solution has settled: one that is refined, one that is
tested and tells the widths, and the one that is used."""


def solve(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    *,
    radius_m: float,
    reference: str,
    front_cameras: Sequence[str],
    created: str,
    progress: Progress = lambda _: None,
    limits: Limits = Limits(),  # noqa: B008  # frozen
) -> Solution:
    """The calibration that agrees best with all that was seen.

    ``cameras`` give lens and serial; their poses and corrections are not used. ``front_cameras``
    stand in front of the person: they give the heading where the ball was not put in front of the
    mark.

    Raises:
        CalibrationError: naming the camera or the step that spoils it, and what to do.
    """
    # One BLAS thread: other processes use the second core, and more threads wait for each other.
    with threadpool_limits(limits=1, user_api="blas"):
        progress("checking the detections")
        observations = replace(observations, balls=without_gaps(observations.balls))
        coverage = Coverage(cameras, reference, radius_m)
        for ball in observations.balls:
            coverage.add(ball)
        refusals.check_counts(coverage)
        measured_m = refusals.check_radius(observations.balls, radius_m)
        refusals.check_rest(observations, front_cameras)
        warming.check_warm(observations.depth_changes)
        progress("finding the relative positions of the cameras")
        problem, poses = first_problem(observations, cameras, radius_m, reference)
        if words := resting_ball.height_words(problem, first_state(problem, poses)):
            raise CalibrationError(words)
        progress("solving, with a fifth of the seconds kept for the test")
        training, tested, found = _tested(problem, poses)

        progress("solving with all detections")
        problem, state = _final(problem, training, tested)
        world_poses = world.poses_in_world(problem, state, front_cameras)
        refusals.check_upright(world_poses)
        # A camera that was moved far makes the ball seem another one, but not the other way round.
        refusals.check_unmoved(problem, state)
        refusals.check_solved_radius(problem, state)
        resting_ball.check_doubts(problem, state)
        resting_ball.check_slope(problem, world_poses)
        resting_ball.check_mark(world_poses, radius_m)
        rig = _rig(problem, world_poses, state, created, acceptance.overall_rms(found))
        predicted = predict_errors(problem, state, world_poses, rig.cameras)
        predicted = acceptance.widen_by_test(predicted, found)
        heights_m = problem.heights_m.values()
        refusals.check_predicted(predicted, limits, coverage, heights_m, boarded(problem))
        changes = observations.depth_changes
        predicted = warming.widen_by_warming(predicted, changes, limits.girth_m)
        rig = replace(rig, predicted=predicted)
        weak = advice(problem, state, predicted, world_poses, limits, coverage)
        if words := warming.warming_words(changes):
            weak = (words, *weak)
        return Solution(rig, world_poses, found, weak, state.clock_s, measured_m)


def _tested(
    problem: Problem, poses: Mapping[str, Array]
) -> tuple[Problem, State, dict[str, HeldOut]]:
    """The problem without the held-out seconds, its solution, and the test on these seconds."""
    seconds = acceptance.held_out_seconds(problem.waved)
    training = acceptance.without_held_out(
        replace(problem, model=COARSE, shape_grid=ROUND), seconds
    )
    coarse = solve_joint(training, first_state(training, poses), settled=_COARSELY, informed=False)
    refusals.check_converged(coarse, refusals.DIVERGED)
    training = replace(training, model=problem.model, shape_grid=problem.shape_grid)
    start = _refined(coarse, COARSE, problem)
    tested = solve_joint(training, start, _FINE_ITERATIONS, settled=_TO_TEST)
    refusals.check_converged(tested, refusals.DIVERGED)
    found = acceptance.compare_held_out(problem, seconds, tested)
    refusals.check_corrected(
        {
            name: acceptance.corrected(seen, training, tested)
            for name, seen in training.waved.items()
        }
    )
    refusals.check_scatter(tested)
    refusals.check_held_out(found)
    return training, tested, found


def _refined(state: State, coarse: SensorModel, problem: Problem) -> State:
    """The state with the parameters that the problem's finer model adds at zero."""
    sensors = {name: coarse.expanded(own, problem.model) for name, own in state.sensors.items()}
    return replace(
        state,
        sensors=sensors,
        shape=np.zeros((problem.shape_grid.count, SHAPE)),
        place_shapes={place: np.zeros(SHAPE) for place in problem.resting},
    )


def _final(problem: Problem, training: Problem, tested: State) -> tuple[Problem, State]:
    """The problem under the most probable widths, and its solution averaged over all of them.

    ``tested`` solves ``training``, which lacks the held-out seconds.
    """
    try:
        problem = replace(problem, widths=most_probable_widths(training, tested))
        start = extended_state(problem, training, tested)
        state = solve_joint(problem, start, _FINE_ITERATIONS, settled=_FINALLY)
        averaged = averaged_state(problem, state)
        if not refusals.converged(state):
            # A wrong height may be what does not let it settle.
            resting_ball.check_doubts(problem, averaged)
        refusals.check_converged(state)
        return problem, averaged
    except np.linalg.LinAlgError:
        # Equations without a solution come from detections that contradict one another.
        refusals.check_converged(replace(tested, last_step=np.inf))
        raise


def _rig(
    problem: Problem, world_poses: WorldPoses, state: State, created: str, rms_m: float
) -> Rig:
    solved = {}
    for i, (name, camera) in enumerate(problem.cameras.items()):
        own = np.s_[6 * i : 6 * i + 6]
        solved[name] = replace(
            problem.model.camera(camera, state.sensors[name]),
            depth_correction=problem.model.correction(state.sensors[name]),
            world_from_camera=world_poses.world_from_camera[name],
            covariance=world_poses.covariance[own, own],
        )
    return Rig(created, problem.reference, solved, rms_m)
