"""A booth's calibration from its observations: pairs, the joint solution, the verdict.

Faulty input is refused with its cause and remedy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from station.calibration.adjust.averaging import averaged_state, most_probable_widths
from station.calibration.adjust.ball_shape import SHAPE
from station.calibration.adjust.contacts import plumb_ends
from station.calibration.adjust.joint import solve_joint
from station.calibration.adjust.problem import ROUND, SHAPE_KNOT_S, Problem, Sightings, State
from station.calibration.adjust.sensor_model import COARSE, SensorModel
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.adjust.widths import Widths
from station.calibration.detect.coverage import Coverage
from station.calibration.detect.detections import FLOOR, Observations
from station.calibration.detect.step_names import FRONT, HANGING, MARK, WALL, raised_height_m
from station.calibration.solve import acceptance, refusals, resting_ball, world
from station.calibration.solve.acceptance import HeldOut
from station.calibration.solve.initial import (
    Detections,
    add_bow_terms,
    agreeing_detections,
    extended_state,
    first_state,
    named_surfaces,
    resting_places,
    resting_sightings,
    sorted_detections,
    spread_m,
    without_gaps,
)
from station.calibration.solve.pairwise import chain_poses, estimate_pairs
from station.calibration.solve.predicted import predict_errors
from station.calibration.solve.refusals import SIGMAS_95, Limits
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.rig import CameraCalibration, PredictedError, Rig

Array = NDArray[np.float64]
Progress = Callable[[str], None]

_MIN_SPREAD_M = 0.15
"""Least rms distance of the resting ball's places from one line, where no camera sees the floor."""
_FINE_ITERATIONS = 16
_GOOD_SLOPE_RAD = np.radians(0.1)


@dataclass(frozen=True, slots=True)
class Solution:
    """A calibration and how good it is."""

    rig: Rig
    world_poses: WorldPoses
    """Poses with the covariance between cameras."""
    held_out: Mapping[str, HeldOut]
    weak: tuple[str, ...]
    """Advice on what could be better; empty where there is none."""
    clock_s: Mapping[str, float]
    """Offset of each camera's clock against the reference's."""
    radius_m: float
    """The ball's, as all cameras measured it."""
    leveled_by: str
    """Words of what the world's horizontal is taken from."""

    def summary(self) -> list[str]:
        """Lines for the operator."""
        rms_mm = 1e3 * self.rig.residual_rms_m
        lines = [
            "the calibration can be used" if self.weak else "the calibration is good",
            "tested on a fifth of the seconds, which were left out at first: cameras see the ball "
            f"{rms_mm:.1f} mm apart (rms)",
        ]
        for name, one in self.held_out.items():
            shift_m, turn_rad = self._sigma(name)
            known = (
                "reference"
                if name == self.rig.reference
                else f"known to within {1e3 * shift_m:.1f} mm and "
                f"{np.degrees(turn_rad):.2f} degrees"
            )
            off_mm = 1e3 * float(np.linalg.norm(one.mean_m))
            lines.append(f"{name}: {known}; off by {off_mm:.1f} mm in {one.detections} tests")
        if self.rig.predicted is not None:
            lines.append(
                "from the calibration alone, heights are accurate to "
                f"{1e3 * SIGMAS_95 * self.rig.predicted.height_sigma_m:.1f} mm and girths to "
                f"{1e3 * SIGMAS_95 * self.rig.predicted.girth_sigma_m:.1f} mm (95 %)"
            )
        slope_deg = np.degrees(self.world_poses.slope_sigma_rad)
        lines.append(f"{self.leveled_by} is known to within {slope_deg:.2f} degrees")
        return lines + [f"could be better: {words}" for words in self.weak]

    @property
    def report(self) -> dict[str, Any]:
        """For a JSON file beside the calibration."""
        names = list(self.world_poses.world_from_camera)
        return {
            "residual_rms_m": self.rig.residual_rms_m,
            "measured_radius_m": self.radius_m,
            "slope_sigma_rad": self.world_poses.slope_sigma_rad,
            "weak": list(self.weak),
            "cameras": {
                name: {
                    "held_out": self.held_out[name].detections,
                    "held_out_rms_m": self.held_out[name].rms_m,
                    "held_out_mean_m": self.held_out[name].mean_m.tolist(),
                    "sigma_to_reference_m": self._sigma(name)[0],
                    "sigma_to_reference_rad": self._sigma(name)[1],
                    "clock_offset_s": self.clock_s[name],
                }
                for name in names
            },
            "joint_covariance": {"cameras": names, "xi": self.world_poses.covariance.tolist()},
        }

    def _sigma(self, name: str) -> tuple[float, float]:
        return world.pose_sigma(self.world_poses, self.rig.reference, name)


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
    stand in front of the subject: they give the heading where the ball was not put in front of the
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
        progress("finding the relative positions of the cameras")
        problem, poses = _first_problem(observations, cameras, radius_m, reference)
        if words := resting_ball.height_words(problem, first_state(problem, poses)):
            raise CalibrationError(words)
        progress("solving, with a fifth of the seconds kept for the test")
        training, tested, found = _tested(problem, poses)

        progress("solving with all detections")
        problem, state = _final(problem, training, tested)
        world_poses = world.poses_in_world(problem, state, front_cameras)
        refusals.check_upright(world_poses)
        refusals.check_solved_radius(problem, state)
        refusals.check_unmoved(problem, state)
        resting_ball.check_doubts(problem, state)
        resting_ball.check_slope(problem, world_poses)
        resting_ball.check_mark(world_poses, radius_m)
        rig = _rig(problem, world_poses, state, created, acceptance.overall_rms(found))
        predicted = predict_errors(problem, state, world_poses, rig.cameras)
        predicted = acceptance.widen_by_test(predicted, found)
        stood, boarded = bool(problem.heights_m), _boarded(problem)
        refusals.check_predicted(predicted, limits, coverage, stood, boarded)
        rig = replace(rig, predicted=predicted)
        weak = _advice(problem, state, predicted, world_poses, limits, coverage)
        leveled_by = resting_ball.leveled_by(problem)
        return Solution(rig, world_poses, found, weak, state.clock_s, measured_m, leveled_by)


def height_words(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    *,
    radius_m: float,
    reference: str,
) -> str | None:
    """Words on a raised ball that was seen decimetres from the height that was told; None where all
    are right, or where nothing can be solved from what was seen so far."""
    observations = replace(observations, balls=without_gaps(observations.balls))
    with threadpool_limits(limits=1, user_api="blas"):
        try:
            problem, poses = _first_problem(observations, cameras, radius_m, reference)
        except CalibrationError:
            return None
        return resting_ball.height_words(problem, first_state(problem, poses))


def _first_problem(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    radius_m: float,
    reference: str,
) -> tuple[Problem, Mapping[str, Array]]:
    """The problem with the widest priors, and first poses of the cameras."""
    # Balls that are partly covered are good enough for first poses, and to tell what is a ball.
    seen = sorted_detections(observations.balls, list(cameras), radius_m, held=False)
    pairs = estimate_pairs({name: own.track for name, own in seen.items()})
    refusals.check_pairs(seen, pairs)
    poses = chain_poses(pairs, reference, list(cameras))
    refusals.check_connected(cameras, poses)
    return _problem(observations, cameras, seen, poses, radius_m, reference), poses


def _final(problem: Problem, training: Problem, tested: State) -> tuple[Problem, State]:
    """The problem under the most probable widths, and its solution averaged over all of them.

    ``tested`` solves ``training``, which lacks the held-out seconds.
    """
    try:
        problem = replace(problem, widths=most_probable_widths(training, tested))
        start = extended_state(problem, training, tested)
        state = solve_joint(problem, start, _FINE_ITERATIONS)
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


def _advice(
    problem: Problem, state: State, predicted: PredictedError, world_poses: WorldPoses,
    limits: Limits, coverage: Coverage,
) -> tuple[str, ...]:  # fmt: skip
    """Sentences on what could be better."""
    weak = [] if coverage.enough else [coverage.advice()]
    if words := resting_ball.doubt_words(problem, state):
        weak.append(words)
    stood = bool(problem.heights_m)
    if SIGMAS_95 * predicted.height_sigma_m > 0.5 * limits.height_m:
        weak.append(f"for heights, {refusals.remedy(stood, refusals.STAND_WORDS)}")
    elif not stood:
        weak.append(f"for heights, {refusals.STAND_WORDS}")
    if not _boarded(problem):
        weak.append(f"for girths, {refusals.BOARD_WORDS}")
    if any(at.startswith(HANGING) for at in problem.heights_m) and plumb_ends(problem) is None:
        weak.append(f"to know what is vertical, {resting_ball.HANGING_WORDS}")
    elif world_poses.slope_sigma_rad > _GOOD_SLOPE_RAD and (
        words := resting_ball.slope_words(problem)
    ):
        weak.append(f"for the floor's slope, {words}")
    return tuple(weak)


def _boarded(problem: Problem) -> bool:
    return any(surface.surface.startswith(WALL) for surface in problem.surfaces)


def _tested(
    problem: Problem, poses: Mapping[str, Array]
) -> tuple[Problem, State, dict[str, HeldOut]]:
    """The problem without the held-out seconds, its solution, and the test on these seconds."""
    seconds = acceptance.held_out_seconds(problem.waved)
    training = acceptance.without_held_out(
        replace(problem, model=COARSE, shape_grid=ROUND), seconds
    )
    coarse = solve_joint(training, first_state(training, poses), informed=False)
    refusals.check_converged(coarse, refusals.DIVERGED)
    training = replace(training, model=problem.model, shape_grid=problem.shape_grid)
    tested = solve_joint(training, _refined(coarse, COARSE, problem), _FINE_ITERATIONS)
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


def _problem(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    seen: Mapping[str, Detections],
    poses: Mapping[str, Array],
    radius_m: float,
    reference: str,
) -> Problem:
    detections = sorted_detections(observations.balls, list(cameras), radius_m)
    agreed = agreeing_detections(detections, seen, poses)
    waved = {
        name: Sightings.of(
            camera,
            [d for d, good in zip(detections[name].waved, agreed[name], strict=True) if good],
        )
        for name, camera in cameras.items()
    }
    resting: dict[str, list[Sightings]] = {}
    places = {MARK: observations.mark, FRONT: observations.front, **observations.around}
    for place, balls in places.items():
        views = [resting_sightings(balls, camera, radius_m) for camera in cameras.values()]
        there = [view for view in views if view is not None]
        if there:
            resting[place] = there
    if MARK not in resting:
        raise CalibrationError(
            "no camera saw the ball rest on the mark; put it there and leave the booth for the "
            "two seconds that this step takes"
        )
    resting_ball.check_front(resting_places(resting, poses))
    heights_m = {
        place: height_m for place in resting if (height_m := raised_height_m(place)) is not None
    }
    surfaces = named_surfaces(observations.planes, cameras, poses)
    if not any(surface.surface == FLOOR for surface in surfaces):
        laid = {place: seen for place, seen in resting.items() if place not in heights_m}
        spread = spread_m(np.array(list(resting_places(laid, poses).values())))
        if spread < _MIN_SPREAD_M:
            raise CalibrationError(
                "no camera saw enough of the floor, and the ball did not lie on it at three "
                f"places that form a triangle: {resting_ball.AROUND_WORDS}"
            )
    problem = Problem(
        cameras, reference, radius_m, waved, resting, surfaces, Widths.widest(cameras), heights_m,
        shape_grid=TimeGrid.over(
            np.concatenate([seen.times_s for seen in waved.values()]), knot_s=SHAPE_KNOT_S
        ),
    )  # fmt: skip
    return add_bow_terms(problem, poses)


def _refined(state: State, coarse: SensorModel, problem: Problem) -> State:
    """The state with the parameters that the problem's finer model adds at zero."""
    sensors = {name: coarse.expanded(own, problem.model) for name, own in state.sensors.items()}
    return replace(
        state,
        sensors=sensors,
        shape=np.zeros((problem.shape_grid.count, SHAPE)),
        place_shapes={place: np.zeros(SHAPE) for place in problem.resting},
    )


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
