"""Detection of clocks and cameras that jumped during a calibration.

A clock that is reset midway puts all later detections at wrong times: as wrong as the ball is fast.
A camera that is bumped puts them at wrong places.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from station.calibration.solve.pairwise import (
    GATE_M,
    Pair,
    Track,
    differences,
    estimate_pair,
    match,
)
from station.core.geometry import transform

Array = NDArray[np.float64]

_WINDOW_S = 4.0
_MIN_IN_WINDOW_S = 0.8
_LONGEST_SHIFT_S = 3.0
_SHORTEST_SHIFT_S = 0.15
"""In this time the ball travels farther than depth errors reach: shorter jumps are found only
once these are corrected, by ``small_jump``."""
_SHIFT_STEP_S = 0.03
_ONE_JUMP_S = 0.15
"""Windows after one jump ask for the same shift to within this."""
_AGREEING = 0.6
_GAIN = 0.3
"""Least gain in the share of agreeing matches once a clock is shifted."""
_CUT_STEP_S = 2.0
_MIN_ON_A_SIDE_S = 2.5
_COUNTED_S = 0.1
"""Detections count once in so long: how long a camera errs does not depend on its rate."""
_SPEED_SPAN_S = 0.05
_NOISE_M = 0.003
"""Between two corrected detections of one ball."""
_SMALLEST_JUMP_S = 0.010
_JUMP_SIGMAS = 6.0
_MOVED_DROP = 0.4
_SMALL_MOVE_M, _MOVE_SIGMAS = 0.001, 3.0
"""Least step of a camera's mean difference from the others that is a move, and in standard
deviations; in sound booths of any kind it is up to 1.7 of these."""
_MOVE_CUT_S, _MIN_MOVE_S, _MOVE_BLOCK_S, _MOVE_OUTLIER = 2.5, 5, 1.0, 4.0
"""Moments that are tried, seconds that are needed on both sides, time in which errors are shared,
and differences so many times the typical one that do not count."""


@dataclass(frozen=True, slots=True)
class ClockJump:
    """A camera whose times before and after a moment do not fit together."""

    camera: str
    jump_s: float


def large_jump(
    tracks: Mapping[str, Track], pairs: Mapping[tuple[str, str], Pair]
) -> ClockJump | None:
    """A jump that shows as pairs that agree for a time, and again once a clock is shifted."""
    votes: dict[str, list[float]] = {}
    for (a, b), pair in pairs.items():
        shifts = _window_shifts(tracks[a], tracks[b], pair)
        for shift, _ in shifts:
            alike = [known for other, known in shifts if abs(shift - other) < _ONE_JUMP_S]
            if len(alike) >= 2 and any(alike):
                votes.setdefault(a, []).append(-shift)
                votes.setdefault(b, []).append(shift)
                break
    if not votes:
        return None
    worst = max(votes, key=lambda name: len(votes[name]))
    return ClockJump(worst, float(np.median(votes[worst])))


def small_jump(tracks: Mapping[str, Track]) -> ClockJump | None:
    """A step in one camera's lateness against all others; tracks in one frame, corrected."""
    late = {(a, b): _lateness(tracks[a], tracks[b]) for a, b in combinations(tracks, 2)}
    every = np.concatenate([times for times, _, _ in late.values()])
    if not len(every):
        return None
    worst, largest = None, 0.0
    for cut_s in np.arange(every.min(), every.max(), _CUT_STEP_S):
        for name in tracks:
            steps, errors = [], []
            for (a, b), measured in late.items():
                step = _step(measured, cut_s) if name in (a, b) else None
                if step is not None:
                    steps.append(step[0] if name == b else -step[0])
                    errors.append(step[1])
            if len(steps) < 2:
                continue
            jump, error = float(np.median(steps)), float(np.median(errors))
            if abs(jump) > max(_SMALLEST_JUMP_S, _JUMP_SIGMAS * error, largest):
                worst, largest = ClockJump(name, jump), abs(jump)
    return worst


def moved_camera(tracks: Mapping[str, Track], pairs: Mapping[tuple[str, str], Pair]) -> str | None:
    """A camera that agrees with the others before or after a moment, but not both.

    On the other side of that moment it must agree with them through another pose; a camera that
    detected a head instead of the ball does not.
    """
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    every = np.concatenate([pair.times_s for pair in pairs.values()])
    worst, largest = None, _MOVED_DROP
    for cut_s in np.arange(every.min(), every.max(), _CUT_STEP_S):
        for name in names:
            drops: dict[tuple[str, str], float] = {}
            for key, pair in pairs.items():
                early = pair.times_s < cut_s
                sides = (_seen_s(pair.times_s[side]) for side in (early, ~early))
                if name in key and min(sides) >= _MIN_ON_A_SIDE_S:
                    drops[key] = float(pair.agree[early].mean() - pair.agree[~early].mean())
            drop = float(np.median(np.abs(list(drops.values())))) if len(drops) >= 2 else 0.0
            if drop > largest and _stands_elsewhere(tracks, drops, cut_s):
                worst, largest = name, drop
    return worst


def slightly_moved_camera(tracks: Mapping[str, Track]) -> str | None:
    """A camera that was bumped by some millimetres; tracks in one frame, corrected.

    Detections of a second share the errors of one region of the booth.
    """
    worst, largest = None, _MOVE_SIGMAS
    for name, track in tracks.items():
        times, away = differences(track, [tracks[other] for other in tracks if other != name])
        if not len(times):
            continue
        off = np.linalg.norm(away - np.median(away, axis=0), axis=1)
        calm = off < _MOVE_OUTLIER * np.median(off)
        seconds, away = np.floor(times[calm] / _MOVE_BLOCK_S), away[calm]
        for cut_s in np.arange(times[0], times[-1], _MOVE_CUT_S):
            early = seconds < cut_s / _MOVE_BLOCK_S
            if min(len(np.unique(seconds[side])) for side in (early, ~early)) < _MIN_MOVE_S:
                continue
            step_m = float(np.linalg.norm(away[early].mean(axis=0) - away[~early].mean(axis=0)))
            sigmas = [_mean_sigma(away[side], seconds[side]) for side in (early, ~early)]
            sigma_m = float(np.hypot(sigmas[0], sigmas[1]))
            if step_m > max(_SMALL_MOVE_M, largest * sigma_m):
                worst, largest = name, step_m / sigma_m
    return worst


def _mean_sigma(away: Array, seconds: Array) -> float:
    """Standard deviation of the mean (3,) of differences, of which those of a second err alike."""
    means = np.array([away[seconds == second].mean(axis=0) for second in np.unique(seconds)])
    return float(np.sqrt(means.var(axis=0).sum() / len(means)))


def _stands_elsewhere(
    tracks: Mapping[str, Track], drops: Mapping[tuple[str, str], float], cut_s: float
) -> bool:
    """True if pairs agree by themselves on the side of the cut on which they agree less."""
    shares = []
    for (a, b), drop in drops.items():
        late = tracks[a].times_s >= cut_s
        side = late if drop > 0.0 else ~late
        pair = estimate_pair(Track(tracks[a].times_s[side], tracks[a].points[side]), tracks[b])
        shares.append(0.0 if pair is None else float(pair.agree.mean()))
    return float(np.median(shares)) > _AGREEING


def _seen_s(times_s: Array) -> float:
    """For how long something was seen, gaps left out."""
    return _COUNTED_S * len(np.unique(np.floor(times_s / _COUNTED_S)))


def _window_shifts(a: Track, b: Track, pair: Pair) -> list[tuple[float, bool]]:
    """Lateness of b's clock in each window in which the pair does not agree otherwise, and
    whether they see the ball together there: where they hardly do, slow balls fit many shifts."""
    later = np.arange(_SHORTEST_SHIFT_S, _LONGEST_SHIFT_S + 1e-9, _SHIFT_STEP_S)
    shifts = np.concatenate([-later[::-1], later])
    found = []
    for start in np.arange(pair.times_s.min(), pair.times_s.max(), _WINDOW_S):
        inside = (pair.times_s >= start) & (pair.times_s < start + _WINDOW_S)
        window = (a.times_s >= start) & (a.times_s < start + _WINDOW_S)
        known = _seen_s(pair.times_s[inside]) >= _MIN_IN_WINDOW_S
        before = float(pair.agree[inside].mean()) if known else 0.0
        if _seen_s(a.times_s[window]) < _MIN_IN_WINDOW_S or before > _AGREEING:
            continue
        shares = [_agreement(a, b, pair.a_from_b, window, float(shift)) for shift in shifts]
        best = int(np.argmax(shares))
        if shares[best] > before + _GAIN:
            found.append((float(shifts[best]), known))
    return found


def _agreement(
    a: Track, b: Track, a_from_b: Array, window: NDArray[np.bool_], shift: float
) -> float:
    places, known = b.at(a.times_s[window] + shift)
    if _seen_s(a.times_s[window][known]) < _MIN_IN_WINDOW_S:
        return 0.0
    away = np.linalg.norm(a.points[window] - transform(a_from_b, places), axis=1)
    return float(np.mean(away[known] < GATE_M))


def _lateness(a: Track, b: Track) -> tuple[Array, Array, Array]:
    """Times (n,), v . r (n,) and v . v (n,): b's clock is late by sum(v . r) / sum(v . v).

    What b saw at its time t was where the ball had been a lateness before: r = a - b = v lateness.
    """
    times, in_a, in_b = match(a, b)
    ends = [b.at(times + sign * _SPEED_SPAN_S) for sign in (1.0, -1.0)]
    speed = (ends[0][0] - ends[1][0]) / (2.0 * _SPEED_SPAN_S)
    away = in_a - in_b
    good = ends[0][1] & ends[1][1] & (np.linalg.norm(away, axis=1) < GATE_M)
    return (
        times[good],
        np.einsum("ni,ni->n", speed[good], away[good]),
        np.einsum("ni,ni->n", speed[good], speed[good]),
    )


def _step(measured: tuple[Array, Array, Array], cut_s: float) -> tuple[float, float] | None:
    """Change of the lateness at the cut, and its standard deviation."""
    times, pulled, known = measured
    early = times < cut_s
    if min(_seen_s(times[side]) for side in (early, ~early)) < _MIN_ON_A_SIDE_S:
        return None
    lateness = [pulled[side].sum() / known[side].sum() for side in (early, ~early)]
    variance = sum(_NOISE_M**2 / known[side].sum() for side in (early, ~early))
    return float(lateness[1] - lateness[0]), float(np.sqrt(variance))
