"""A booth's calibration from what its cameras saw: pairs, then all at once, then the verdict.

Whatever would make it wrong is refused in the operator's words, with what to do about it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.calibration import acceptance, clocks, world
from station.calibration.acceptance import HeldOut
from station.calibration.coverage import Coverage
from station.calibration.depth_correction import correction_of
from station.calibration.detections import FLOOR, BallDetection, Observations
from station.calibration.initial import (
    Detections,
    at_rest,
    confirmed,
    first_state,
    named_surfaces,
    resting_places,
    sorted_detections,
    spread_m,
)
from station.calibration.joint import solve_joint
from station.calibration.pairwise import Pair, chain, relate_all
from station.calibration.problem import Problem, Sightings, State
from station.calibration.rig import CameraCalibration, Rig
from station.calibration.world import Placed
from station.errors import CalibrationError

Array = NDArray[np.float64]
Progress = Callable[[str], None]

_RADIUS_SHARE = 0.04
"""How far the measured radius may lie from the given one; a depth error of 1 % moves it by 1 %."""
_LEAST_DETECTIONS = 60
_AGREEING_SHARE = 0.5
_LARGEST_SIGMA_M = 0.002
_LARGEST_SIGMA_RAD = np.radians(0.1)
_LARGEST_SCATTER = 3.0
_MARK_TOLERANCE_M = 0.008
_LEAST_SPREAD_M = 0.15
"""Of the places where the ball rested, from one line, where no camera sees the floor."""
_GOOD_SLOPE_RAD, _LARGEST_SLOPE_RAD = np.radians(0.06), np.radians(0.1)
"""A body's head is 3 mm to one side at the latter."""
_AROUND_WORDS = (
    "lay the ball to the left, to the right and behind the mark, 0.6 m away, where a lower camera "
    "sees it (station calibrate around)"
)


@dataclass(frozen=True, slots=True)
class Solution:
    """A calibration and how good it is."""

    rig: Rig
    placed: Placed
    """Poses with the covariance between cameras."""
    held_out: Mapping[str, HeldOut]
    weak: tuple[str, ...]
    """What could be better, and how; empty where nothing need be."""
    clock_s: Mapping[str, float]
    """Offset of each camera's clock against the reference's."""
    radius_m: float
    """The ball's, as all cameras measured it."""

    def summary(self) -> list[str]:
        """What the operator is told."""
        rms_mm = 1e3 * self.rig.residual_rms_m
        lines = [f"tested on every fifth second: {rms_mm:.1f} mm rms between cameras"]
        for name, one in self.held_out.items():
            shift_m, turn_rad = self._sigma(name)
            known = (
                "reference"
                if name == self.rig.reference
                else f"known to {1e3 * shift_m:.1f} mm and {np.degrees(turn_rad):.2f} degrees"
            )
            off_mm = 1e3 * float(np.linalg.norm(one.mean_m))
            lines.append(f"{name}: {known}; off by {off_mm:.1f} mm in {one.detections} tests")
        slope_deg = np.degrees(self.placed.slope_sigma_rad)
        lines.append(f"the floor's slope is known to {slope_deg:.2f} degrees")
        return lines + [f"could be better: {words}" for words in self.weak]

    @property
    def report(self) -> dict[str, Any]:
        """For a JSON file beside the calibration."""
        names = list(self.placed.world_from_camera)
        return {
            "residual_rms_m": self.rig.residual_rms_m,
            "measured_radius_m": self.radius_m,
            "slope_sigma_rad": self.placed.slope_sigma_rad,
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
            "joint_covariance": {"cameras": names, "xi": self.placed.covariance.tolist()},
        }

    def _sigma(self, name: str) -> tuple[float, float]:
        return _sigma_to(self.placed, self.rig.reference, name)


def solve(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    *,
    radius_m: float,
    reference: str,
    front_cameras: Sequence[str],
    created: str,
    progress: Progress = lambda _: None,
) -> Solution:
    """The calibration that agrees best with all that was seen.

    ``cameras`` give lens and serial; their poses and corrections are not used. ``front_cameras``
    stand in front of the subject: they give the heading where the ball was not put in front of the
    mark.

    Raises:
        CalibrationError: naming the camera or the step that spoils it, and what to do.
    """
    progress("checking what was seen")
    covered = Coverage(cameras, reference)
    for ball in sorted(observations.balls, key=lambda ball: ball.time_s):
        covered.add(ball)
    _check_counts(covered)
    measured_m = _check_radius(observations.balls, radius_m)
    detections = sorted_detections(observations.balls, list(cameras), radius_m)
    _check_rest(observations, front_cameras)

    progress("relating pairs of cameras")
    pairs = relate_all({name: own.track for name, own in detections.items()})
    _check_pairs(detections, pairs)
    poses = chain(pairs, reference, list(cameras))
    _check_tied(cameras, poses)

    problem = _problem(observations, cameras, detections, poses, radius_m, reference)
    progress("solving without every fifth second")
    training = acceptance.without_held_out(problem)
    tested = solve_joint(training, first_state(training, poses))
    found = acceptance.compare(problem, tested)
    _check_clocks(
        clocks.small_jump(
            {
                name: acceptance.corrected(seen, tested, radius_m)
                for name, seen in training.waved.items()
            }
        )
    )
    _check_scatter(tested)
    _check_held_out(found)

    progress("solving with all that was seen")
    start = first_state(problem, tested.poses)
    state = solve_joint(
        problem, replace(start, corrections=tested.corrections, clock_s=tested.clock_s)
    )
    placed = world.place(problem, state, front_cameras)
    _check_sigma(placed, reference, covered)
    _check_slope(placed)
    _check_mark(placed, radius_m)
    rig = _rig(cameras, placed, state, reference, created, acceptance.overall_rms(found))
    weak = [] if covered.enough else [covered.advice()]
    if placed.slope_sigma_rad > _GOOD_SLOPE_RAD:
        weak.append(f"for the floor's slope, {_AROUND_WORDS}")
    return Solution(rig, placed, found, tuple(weak), state.clock_s, measured_m)


def _problem(
    observations: Observations,
    cameras: Mapping[str, CameraCalibration],
    detections: Mapping[str, Detections],
    poses: Mapping[str, Array],
    radius_m: float,
    reference: str,
) -> Problem:
    agreed = confirmed(detections, poses)
    waved = {
        name: Sightings.of(
            camera,
            [d for d, good in zip(detections[name].waved, agreed[name], strict=True) if good],
        )
        for name, camera in cameras.items()
    }
    resting: dict[str, list[Sightings]] = {}
    places = {world.MARK: observations.mark, world.FRONT: observations.front, **observations.around}
    for place, seen in places.items():
        views = [at_rest(seen, camera, radius_m) for camera in cameras.values()]
        there = [view for view in views if view is not None]
        if there:
            resting[place] = there
    if world.MARK not in resting:
        raise CalibrationError(
            "no camera saw the ball rest on the mark; put it there and leave the booth for the "
            "two seconds that this step takes"
        )
    surfaces = named_surfaces(observations.planes, cameras, poses)
    if not any(surface.surface == FLOOR for surface in surfaces):
        spread = spread_m(np.array(list(resting_places(resting, poses).values())))
        if spread < _LEAST_SPREAD_M:
            raise CalibrationError(
                "no camera saw enough of the floor, and the ball did not lie on it at three "
                f"places away from one line: {_AROUND_WORDS}"
            )
    return Problem(cameras, reference, radius_m, waved, resting, surfaces)


def _rig(
    cameras: Mapping[str, CameraCalibration],
    placed: Placed,
    state: State,
    reference: str,
    created: str,
    rms_m: float,
) -> Rig:
    solved = {}
    for i, (name, camera) in enumerate(cameras.items()):
        own = np.s_[6 * i : 6 * i + 6]
        solved[name] = replace(
            camera,
            depth_correction=correction_of(state.corrections[name]),
            world_from_camera=placed.world_from_camera[name],
            covariance=placed.covariance[own, own],
        )
    return Rig(created, reference, solved, rms_m)


def _check_counts(covered: Coverage) -> None:
    for name, count in covered.counts().items():
        if count < _LEAST_DETECTIONS:
            raise CalibrationError(
                f"camera {name} saw the ball in {count} frames only ({_LEAST_DETECTIONS} are "
                f"needed): check that the camera works and is not covered, and wave the ball "
                f"where {name} looks"
            )


def _check_radius(balls: Sequence[BallDetection], radius_m: float) -> float:
    found = np.array([ball.radius_m for ball in balls])
    sure = 1.0 / np.array([ball.radius_sigma_m for ball in balls])
    order = np.argsort(found)
    total = np.cumsum(sure[order])
    measured = float(found[order][np.searchsorted(total, 0.5 * total[-1])])
    if abs(measured / radius_m - 1.0) > _RADIUS_SHARE:
        raise CalibrationError(
            f"the ball measures {1e3 * measured:.0f} mm in radius, but {1e3 * radius_m:.0f} mm was "
            f"given: measure it and give its radius, or use the right ball"
        )
    return measured


def _check_rest(observations: Observations, front_cameras: Sequence[str]) -> None:
    if not observations.mark:
        raise CalibrationError(
            "the ball was not seen on the mark: lay it there, and run station calibrate mark"
        )
    if not observations.front and not front_cameras:
        raise CalibrationError(
            "nothing says where the person faces: name the cameras in front (calibrate.front in "
            "booth.toml), or run station calibrate mark --front"
        )


def _check_pairs(
    detections: Mapping[str, Detections], pairs: Mapping[tuple[str, str], Pair]
) -> None:
    if not pairs:
        raise CalibrationError(
            "no two cameras saw the ball at one time: wave it where several of them see it"
        )
    tracks = {name: own.track for name, own in detections.items()}
    _check_clocks(clocks.large_jump(tracks, pairs))
    moved = clocks.moved_camera(tracks, pairs)
    if moved is not None:
        raise CalibrationError(
            f"camera {moved} was moved while the ball was waved: fix it, and wave the ball again"
        )
    for name in detections:
        shares = [float(pair.agree.mean()) for key, pair in pairs.items() if name in key]
        if shares and max(shares) < _AGREEING_SHARE:
            raise CalibrationError(
                f"camera {name} agrees with the others in only {100 * max(shares):.0f} % of what "
                "it saw: something else in its view is round; take it away and wave the ball again"
            )


def _check_clocks(jump: clocks.ClockJump | None) -> None:
    if jump is not None:
        raise CalibrationError(
            f"the clock of camera {jump.camera} jumped by {1e3 * jump.jump_s:.0f} ms midway (its "
            "USB connection was lost, or the station is overloaded): wave the ball again"
        )


def _check_tied(cameras: Mapping[str, CameraCalibration], poses: Mapping[str, Array]) -> None:
    apart = [name for name in cameras if name not in poses]
    if apart:
        raise CalibrationError(
            f"camera {apart[0]} saw the ball too rarely together with the others: wave it longer "
            f"where {apart[0]} and another camera see it at a time"
        )


def _check_scatter(state: State) -> None:
    for name, deviation in state.deviations.items():
        scatter = float(np.sqrt(np.median(deviation) / 2.366)) if len(deviation) else 0.0
        if scatter > _LARGEST_SCATTER:
            raise CalibrationError(
                f"camera {name} scatters {scatter:.1f} times as much as a sound sensor does: let "
                "it warm up for 20 minutes, keep the sun out of the booth, or replace it"
            )


def _check_held_out(found: Mapping[str, HeldOut]) -> None:
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
            f"camera {name} is off by {away_mm:.1f} mm ({1e3 * found[name].rms_m:.1f} mm rms) "
            "where it was tested: make sure that no camera moves meanwhile, let the sensors warm "
            "up, and wave the ball again"
        )


def _sigma_to(placed: Placed, reference: str, name: str) -> tuple[float, float]:
    """Largest standard deviations of a camera's place (m) and turn (rad) from the reference's."""
    if name == reference:
        return 0.0, 0.0
    _, covariance = world.relative(placed, reference, name)
    return (
        float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])),
        float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
    )


def _check_sigma(placed: Placed, reference: str, covered: Coverage) -> None:
    for name in placed.world_from_camera:
        shift, turn = _sigma_to(placed, reference, name)
        if shift > _LARGEST_SIGMA_M or turn > _LARGEST_SIGMA_RAD:
            more = "" if covered.enough else f"; {covered.advice()}"
            raise CalibrationError(
                f"camera {name} is known to {1e3 * shift:.1f} mm and {np.degrees(turn):.2f} "
                f"degrees only: wave the ball longer, near to {name} and far from it{more}"
            )


def _check_slope(placed: Placed) -> None:
    if placed.slope_sigma_rad > _LARGEST_SLOPE_RAD:
        raise CalibrationError(
            f"the floor's slope is known to {np.degrees(placed.slope_sigma_rad):.2f} degrees only: "
            f"{_AROUND_WORDS}"
        )


def _check_mark(placed: Placed, radius_m: float) -> None:
    off = placed.mark_height_m - radius_m
    if abs(off) > _MARK_TOLERANCE_M:
        raise CalibrationError(
            f"the ball on the mark is {1e3 * abs(off):.0f} mm too {'high' if off > 0 else 'low'} "
            "for one that rests on the floor: put it on the floor itself, and clear the floor"
        )
