"""Whether a camera's clock kept its pace all the way through a calibration.

A clock that is reset midway puts all later detections at wrong times: as wrong as the ball is fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.joint import Problem, State, local_equations
from station.calibration.pairwise import GATE_M, Pair, Track
from station.calibration.trajectory import along
from station.geometry import transform

Array = NDArray[np.float64]

_WINDOW_S = 4.0
_LEAST_IN_WINDOW = 10
_LONGEST_SHIFT_S = 3.0
_SHIFT_STEP_S = 0.02
_AGREEING = 0.6
_GAIN = 0.3
"""By how much more of a window's matches must agree once a clock is shifted."""
_SMALLEST_JUMP_S = 0.006
_JUMP_SIGMAS = 6.0


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A camera whose times before and after a moment do not fit together."""

    camera: str
    time_s: float
    jump_s: float


def large_jump(
    tracks: Mapping[str, Track], pairs: Mapping[tuple[str, str], Pair]
) -> ClockJump | None:
    """A jump that shows as a pair that agrees for a time, and again once a clock is shifted."""
    votes: dict[str, list[ClockJump]] = {}
    shifts = np.arange(-_LONGEST_SHIFT_S, _LONGEST_SHIFT_S + 1e-9, _SHIFT_STEP_S)
    for (a, b), pair in pairs.items():
        for start in np.arange(pair.times_s.min(), pair.times_s.max(), _WINDOW_S):
            inside = (pair.times_s >= start) & (pair.times_s < start + _WINDOW_S)
            if inside.sum() < _LEAST_IN_WINDOW or pair.agree[inside].mean() > _AGREEING:
                continue
            times = tracks[a].times_s
            window = (times >= start) & (times < start + _WINDOW_S)
            shares = [
                _agreement(tracks[a], tracks[b], pair.a_from_b, window, shift) for shift in shifts
            ]
            best = int(np.argmax(shares))
            if shares[best] > pair.agree[inside].mean() + _GAIN:
                for name, sign in ((a, -1.0), (b, 1.0)):
                    votes.setdefault(name, []).append(
                        ClockJump(name, float(start), float(sign * shifts[best]))
                    )
                break
    if not votes:
        return None
    worst = max(votes.values(), key=len)
    return worst[0]


def small_jump(problem: Problem, state: State) -> ClockJump | None:
    """A step in a camera's clock offset that the joint solution took for one offset."""
    worst, largest = None, 0.0
    for name, seen in problem.waved.items():
        starts, offset, sigma = _offsets(name, problem, state)
        if len(starts) < 4:
            continue
        for cut in range(2, len(starts) - 1):
            early, late = np.s_[:cut], np.s_[cut:]
            means = [np.average(offset[part], weights=sigma[part] ** -2) for part in (early, late)]
            error = np.sqrt(sum(1.0 / np.sum(sigma[part] ** -2) for part in (early, late)))
            jump = means[1] - means[0]
            if abs(jump) > max(_SMALLEST_JUMP_S, _JUMP_SIGMAS * error) and abs(jump) > largest:
                largest = abs(jump)
                worst = ClockJump(seen.camera, float(starts[cut]), float(-jump))
    return worst


def _offsets(name: str, problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Start, remaining clock offset and its standard deviation of each window."""
    seen, pose = problem.waved[name], state.poses[name]
    first, value, rate = state.grid.basis(seen.times_s + state.clock_s[name])
    centers = (along(state.controls, first, value) - pose[:3, 3]) @ pose[:3, :3]
    speed = along(state.controls, first, rate) @ pose[:3, :3]
    normal, pull = local_equations(seen, centers, state.corrections[name], problem.radius_m)
    known = np.einsum("ni,nij,nj->n", speed, normal[:, :3, :3], speed)
    pulled = -np.einsum("ni,ni->n", speed, pull[:, :3])
    calm = np.einsum(
        "ni,ni->n", pull[:, :3], np.linalg.solve(normal[:, :3, :3], pull[:, :3, None])[..., 0]
    )
    good = calm < max(30.0, 10.0 * float(np.median(calm)))
    window = ((seen.times_s - seen.times_s[0]) / _WINDOW_S).astype(int)
    count = np.bincount(window[good], minlength=window.max() + 1)
    total = np.bincount(window[good], known[good], minlength=window.max() + 1)
    sums = np.bincount(window[good], pulled[good], minlength=window.max() + 1)
    kept = (count >= _LEAST_IN_WINDOW) & (total > 0)
    starts = seen.times_s[0] + _WINDOW_S * np.flatnonzero(kept)
    return starts, sums[kept] / total[kept], np.asarray(2.0 * total[kept] ** -0.5)


def _agreement(
    a: Track, b: Track, a_from_b: Array, window: NDArray[np.bool_], shift: float
) -> float:
    places, known = b.at(a.times_s[window] + shift)
    if known.sum() < _LEAST_IN_WINDOW:
        return 0.0
    away = np.linalg.norm(a.points[window] - transform(a_from_b, places), axis=1)
    return float(np.mean(away[known] < GATE_M))
