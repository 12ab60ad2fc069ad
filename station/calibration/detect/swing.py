"""Whole swings of a hanging ball: the mean over them is where it would come to rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from station.calibration.detect.detections import BallDetection

LOOK_S = 4.0
"""Time for which cameras look at a hanging ball: more than a swing of a string of 2.5 m, 3.2 s."""
_PERIODS_S = np.geomspace(0.8, 3.2, 30)
"""Periods of strings of 0.16 to 2.5 m: 2 pi sqrt(length / g)."""


def whole_swings(seen: Sequence[BallDetection]) -> list[BallDetection]:
    """The last detections of one camera that last a whole number of swings.

    The mean of detections over another time is off by up to a fifth of the swing's amplitude. The
    period is that of the sinusoid that fits their centres best; a ball that hardly swings may have
    any.
    """
    times_s = np.array([ball.time_s for ball in seen])
    lasts_s = float(np.ptp(times_s)) if len(seen) else 0.0
    periods_s = _PERIODS_S[lasts_s >= _PERIODS_S]
    if not len(periods_s):
        return list(seen)
    centers_m = np.array([ball.center_m for ball in seen])
    left = []
    for period_s in periods_s:
        phase = 2.0 * np.pi * times_s / period_s
        design = np.column_stack([np.ones(len(seen)), np.cos(phase), np.sin(phase)])
        swing = design @ np.linalg.lstsq(design, centers_m, rcond=None)[0]
        left.append(np.sum(np.square(centers_m - swing)))
    period_s = float(periods_s[np.argmin(left)])
    since_s = times_s.max() - period_s * int(lasts_s / period_s)
    return [ball for ball in seen if ball.time_s > since_s]
