"""Whole swings of a hanging ball: the mean over them is where it would come to rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from station.calibration.detect.detections import BallDetection

LOOK_S = 4.0
"""Time for which cameras look at a hanging ball: more than a swing of a string of 2.5 m, 3.2 s."""
_PERIODS_S = np.geomspace(0.8, 3.2, 30)
"""Periods of strings of 0.16 to 2.5 m: 2 pi sqrt(length / g)."""
GAP_S = 0.3
"""A camera that loses the ball for longer may lose it at one end of each swing."""
_UNEVEN_M = 1e-3
"""Largest distance of the mean from the middle of the swing: farther off, the camera lost the ball
at one end of it."""


def since_last_gap(seen: Sequence[BallDetection]) -> list[BallDetection]:
    """The last detections of one camera that follow one another."""
    gaps = np.flatnonzero(np.diff([ball.time_s for ball in seen]) > GAP_S)
    return list(seen[gaps[-1] + 1 :] if len(gaps) else seen)


def whole_swings(seen: Sequence[BallDetection]) -> list[BallDetection]:
    """The last detections of one camera that last a whole number of swings.

    The mean of detections over another time is off by up to a fifth of the swing's amplitude. The
    period is that of the sinusoid that fits their centres best; a ball that hardly swings may have
    any. None where their mean is not the middle of that sinusoid.
    """
    times_s = np.array([ball.time_s for ball in seen])
    lasts_s = float(np.ptp(times_s)) if len(seen) else 0.0
    periods_s = _PERIODS_S[lasts_s >= _PERIODS_S]
    if not len(periods_s):
        return list(seen)
    centers_m = np.array([ball.center_m for ball in seen])
    left, middles_m = [], []
    for period_s in periods_s:
        phase = 2.0 * np.pi * times_s / period_s
        design = np.column_stack([np.ones(len(seen)), np.cos(phase), np.sin(phase)])
        terms = np.linalg.lstsq(design, centers_m, rcond=None)[0]
        left.append(np.sum(np.square(centers_m - design @ terms)))
        middles_m.append(terms[0])
    best = int(np.argmin(left))
    period_s = float(periods_s[best])
    last = times_s > times_s.max() - period_s * int(lasts_s / period_s)
    if np.linalg.norm(centers_m[last].mean(axis=0) - middles_m[best]) > _UNEVEN_M:
        return []
    return [ball for ball, kept in zip(seen, last, strict=True) if kept]
