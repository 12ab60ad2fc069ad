"""The test of a calibration on detections that it was not solved from, in millimetres.

Every fifth of the seconds in which two cameras see the ball is held out. What a camera saw then is
compared with where the other cameras saw the ball, through the poses and corrections of the rest of
the time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.ball_shape import SHAPE, shape_turn
from station.calibration.adjust.equations import corrected_centers
from station.calibration.adjust.problem import Problem, Sightings, State, seen_shape
from station.calibration.solve.pairwise import Track, differences
from station.core.geometry import transform
from station.core.kinect_v1 import INDEPENDENT_HZ
from station.core.rig import PredictedError

Array = NDArray[np.float64]

_BLOCK_S = 1.0
_EVERY = 5
LARGEST_RMS_M = 0.006
"""Largest rms of single detections, whose own noise is 1-2 mm."""
LARGEST_MEAN_M = 0.0025
"""Largest mean of a camera's held-out detections, in which the noise averages out."""
_MIN_DETECTIONS, _WANTED = 6, 12
"""Fewer comparisons prove nothing; some may be outliers."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Differences of one camera's held-out detections from where the others saw the ball."""

    detections: int
    rms_m: float
    mean_m: Array
    """(3,) reference frame."""

    @property
    def tested(self) -> bool:
        return self.detections >= _MIN_DETECTIONS

    @property
    def acceptable(self) -> bool:
        """True if rms and mean are within limits; three sigmas are added to that of the mean."""
        allowed = LARGEST_MEAN_M + 3.0 * self.rms_m / np.sqrt(max(self.detections, 1))
        return self.rms_m < LARGEST_RMS_M and float(np.linalg.norm(self.mean_m)) < allowed


def held_out_seconds(waved: Mapping[str, Sightings]) -> Array:
    """Numbers (k,) of the seconds, from the first detection, that are kept for the test.

    Where hands cover the ball most of the time, some cameras see it together with another one in
    a few seconds only: as many of these are added as a camera's test takes.
    """
    tracks = {name: Track(seen.times_s, seen.centers) for name, seen in waved.items()}
    length = 1 + max(int(_seconds(waved, seen.times_s).max(initial=0)) for seen in waved.values())
    together = {}
    for name, own in tracks.items():
        known = np.zeros(len(own.times_s), bool)
        for other, track in tracks.items():
            known |= (other != name) & track.at(own.times_s)[1]
        together[name] = np.bincount(_seconds(waved, own.times_s[known]), minlength=length)
    shared = np.flatnonzero(sum(together.values()))
    kept = set(shared[_EVERY - 1 :: _EVERY].tolist())
    for counts in together.values():
        left = counts.copy()
        left[list(kept)] = 0
        while (missing := _WANTED - (counts.sum() - left.sum())) > 0 and left.any():
            enough = np.flatnonzero(left >= missing)
            second = enough[np.argmin(left[enough])] if len(enough) else np.argmax(left)
            kept.add(int(second))
            left[second] = 0
    return np.array(sorted(kept), np.int64)


def without_held_out(problem: Problem, seconds: Array) -> Problem:
    """The problem that the solution to be tested is solved from."""
    waved = {
        name: seen.take(~np.isin(_seconds(problem.waved, seen.times_s), seconds))
        for name, seen in problem.waved.items()
    }
    return replace(problem, waved=waved)


def compare_held_out(problem: Problem, seconds: Array, state: State) -> dict[str, HeldOut]:
    """Each camera's held-out detections against the other cameras', by a state solved without."""
    tracks = {name: corrected(seen, problem, state) for name, seen in problem.waved.items()}
    found = {}
    for name, track in tracks.items():
        chosen = np.isin(_seconds(problem.waved, problem.waved[name].times_s), seconds)
        tested = Track(track.times_s[chosen], track.points[chosen])
        _, away = differences(tested, [tracks[other] for other in tracks if other != name])
        calm = away[np.linalg.norm(away, axis=1) < 5.0 * _typical(away)] if len(away) else away
        if len(calm) < _MIN_DETECTIONS:
            found[name] = HeldOut(len(calm), 0.0, np.zeros(3))
        else:
            rms = float(np.sqrt(np.mean(np.sum(calm**2, axis=1))))
            found[name] = HeldOut(len(calm), rms, calm.mean(axis=0))
    return found


def overall_rms(found: Mapping[str, HeldOut]) -> float:
    """Rms over all cameras' held-out detections."""
    count = sum(one.detections for one in found.values())
    return float(
        np.sqrt(sum(one.detections * one.rms_m**2 for one in found.values()) / max(count, 1))
    )


def widen_by_test(predicted: PredictedError, found: Mapping[str, HeldOut]) -> PredictedError:
    """Predicted errors widened by what the held-out test shows beyond its own noise.

    A camera's mean offset against the others has the variance rms^2 / n of its own; what exceeds
    it, along one axis and shared by two cameras, is an error that the covariance does not know.
    """
    excess = [
        (float(one.mean_m @ one.mean_m) - one.rms_m**2 / _independent(one)) / 6.0
        for one in found.values()
    ]
    return predicted.widened(float(np.sqrt(max(0.0, sum(excess) / len(excess)))))


def _independent(one: HeldOut) -> float:
    """Number of held-out detections that err independently: those of a second share the errors of
    one region."""
    return max(1.0, one.detections / (INDEPENDENT_HZ * _BLOCK_S))


def _seconds(waved: Mapping[str, Sightings], times_s: Array) -> NDArray[np.int64]:
    """The second (n,) that each time falls into, counted from the first detection."""
    start_s = min(float(seen.times_s[0]) for seen in waved.values() if len(seen.times_s))
    return np.asarray((times_s - start_s) / _BLOCK_S, np.int64)


def corrected(seen: Sightings, problem: Problem, state: State) -> Track:
    """Detections in the reference frame after depth correction and clock offset."""
    name = seen.camera
    centers = corrected_centers(
        seen, problem.cameras[name], problem.model, state.sensors[name], state.radius_m,
        seen_shape(problem, state, name, seen.times_s),
    )  # fmt: skip
    return Track(seen.times_s + state.clock_s[name], transform(state.poses[name], centers))


def resting_offsets(problem: Problem, state: State) -> dict[str, dict[str, Array]]:
    """Offset (3,), reference frame, of where each camera sees the resting ball from where the
    others see it, by camera and place."""
    found: dict[str, dict[str, Array]] = {}
    for place, sightings in problem.resting.items():
        shape = state.place_shapes.get(place, np.zeros(SHAPE))
        at = {}
        for seen in sightings:
            name, pose = seen.camera, state.poses[seen.camera]
            shapes = np.repeat((shape_turn(pose[:3, :3].T) @ shape)[None], len(seen.times_s), 0)
            centers = corrected_centers(
                seen, problem.cameras[name], problem.model, state.sensors[name], state.radius_m,
                shapes,
            )  # fmt: skip
            at[name] = transform(pose, centers).mean(axis=0)
        for name in at if len(at) > 1 else ():
            others = [center for other, center in at.items() if other != name]
            found.setdefault(name, {})[place] = at[name] - np.mean(others, axis=0)
    return found


def _typical(away: Array) -> float:
    return float(np.median(np.linalg.norm(away, axis=1)))
