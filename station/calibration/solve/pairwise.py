"""First poses relative to the reference camera, from pairs that saw the ball at one time.

Closed form over three matches, RANSAC over all of them, then the pairs are chained to the reference
along the tree of most agreement. Good to a few centimetres: the depth errors are not known yet.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import invert, rigid_fit, transform

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LONGEST_GAP_S = 0.15
"""Between two detections of a camera, for a place between them to be trusted."""
_TRIALS = 400
GATE_M = 0.045
"""Two cameras' depth errors together, before they are corrected."""
MIN_MATCHES = 30
_SAME_BALL_M = 0.1
"""Two corrected detections that are farther apart are not both of the ball."""


@dataclass(frozen=True, slots=True)
class Track:
    """One camera's detections in the order of time."""

    times_s: Array
    """(n,), increasing."""
    points: Array
    """(n, 3), camera frame."""

    def at(self, times_s: Array) -> tuple[Array, Mask]:
        """Places (k, 3) between neighbouring detections, and where there are such."""
        if len(self.times_s) < 2:
            return np.zeros((len(times_s), 3)), np.zeros(len(times_s), bool)
        after = np.clip(np.searchsorted(self.times_s, times_s), 1, len(self.times_s) - 1)
        start, end = self.times_s[after - 1], self.times_s[after]
        share = (times_s - start) / np.maximum(end - start, 1e-9)
        known = (share >= -1e-9) & (share <= 1.0 + 1e-9) & (end - start < LONGEST_GAP_S)
        places = self.points[after - 1] + share[:, None] * (
            self.points[after] - self.points[after - 1]
        )
        return places, known


def differences(track: Track, others: Iterable[Track]) -> tuple[Array, Array]:
    """Times (n,) at which others saw the ball as well, and detections (n, 3) less the mean of where
    they saw it; corrected tracks in one frame."""
    total, count = np.zeros_like(track.points), np.zeros(len(track.points))
    for other in others:
        places, known = other.at(track.times_s)
        near = known & (np.linalg.norm(places - track.points, axis=1) < _SAME_BALL_M)
        total[near] += places[near]
        count[near] += 1.0
    seen = count > 0
    return track.times_s[seen], track.points[seen] - total[seen] / count[seen, None]


@dataclass(frozen=True, slots=True)
class Pair:
    """The relation of two cameras and the matches that agree with it."""

    a_from_b: Array
    times_s: Array
    """(n,) of the matches: a's detections."""
    agree: Mask
    """(n,)."""


def match(a: Track, b: Track) -> tuple[Array, Array, Array]:
    """Times (n,) of a, and a's and b's places (n, 3) at them."""
    places, known = b.at(a.times_s)
    return a.times_s[known], a.points[known], places[known]


def estimate_pair(a: Track, b: Track) -> Pair | None:
    """Estimate the transform between two cameras by RANSAC; None with too few matches."""
    times, in_a, in_b = match(a, b)
    if len(times) < MIN_MATCHES:
        return None
    rng = np.random.default_rng(0)
    best, most = None, 2
    for _ in range(_TRIALS):
        corner = rng.choice(len(times), 3, replace=False)
        sides = in_a[corner[[0, 1, 2]]] - in_a[corner[[1, 2, 0]]]
        if np.linalg.norm(np.cross(sides[0], sides[1])) < 0.02:
            continue
        a_from_b = rigid_fit(in_a[corner], in_b[corner])
        count = int(np.sum(_distance(a_from_b, in_a, in_b) < GATE_M))
        if count > most:
            best, most = a_from_b, count
    if best is None:
        return None
    for _ in range(5):
        agree = _distance(best, in_a, in_b) < GATE_M
        if agree.sum() < 3:
            return None
        best = rigid_fit(in_a[agree], in_b[agree])
    return Pair(best, times, _distance(best, in_a, in_b) < GATE_M)


def estimate_pairs(tracks: Mapping[str, Track]) -> dict[tuple[str, str], Pair]:
    """Estimates for all pairs of cameras with at least ``MIN_MATCHES`` consistent matches."""
    found = {}
    for a, b in combinations(tracks, 2):
        pair = estimate_pair(tracks[a], tracks[b])
        if pair is not None and pair.agree.sum() >= MIN_MATCHES:
            found[a, b] = pair
    return found


def chain_poses(
    pairs: Mapping[tuple[str, str], Pair], reference: str, cameras: Sequence[str]
) -> dict[str, Array]:
    """reference_from_camera of all that are tied to the reference, strongest ties first."""
    poses = {reference: np.eye(4)}
    while True:
        ties = [
            (int(pair.agree.sum()), a, b, pair)
            for (a, b), pair in pairs.items()
            if (a in poses) != (b in poses)
        ]
        if not ties:
            return {name: poses[name] for name in cameras if name in poses}
        _, a, b, pair = max(ties, key=lambda tie: tie[0])
        if a in poses:
            poses[b] = poses[a] @ pair.a_from_b
        else:
            poses[a] = poses[b] @ invert(pair.a_from_b)


def _distance(a_from_b: Array, in_a: Array, in_b: Array) -> Array:
    return np.asarray(np.linalg.norm(in_a - transform(a_from_b, in_b), axis=1))
