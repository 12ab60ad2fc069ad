"""The robust mean of a few depth frames of a body that stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from station.calibration.sensor_noise import RANDOM_SIGMA, STEP

_GATE_SIGMAS = 3.0
_STRAY_READINGS = 2


@dataclass(frozen=True, slots=True)
class AveragedDepth:
    """One camera's frames as one image, (h, w) each."""

    depth_m: NDArray[np.float32]
    """Mean of the readings near their median; 0 where too few agree."""
    count: NDArray[np.uint8]
    """How many readings the mean is of."""
    unsettled_m: NDArray[np.float32]
    """Median where two or more readings lie far from it, as on a body that moved; 0 elsewhere."""
    change_m: NDArray[np.float32]
    """Mean of the last third less that of the first; NaN where either has no reading."""


def random_sigma_m(depth_m: NDArray[np.floating]) -> NDArray[np.floating]:
    """Standard deviation of one reading at a depth."""
    return np.asarray(RANDOM_SIGMA * np.square(depth_m))


def average(stack: NDArray[np.uint16], scale_m: float) -> AveragedDepth:
    """Average (frames, h, w) readings in units of scale_m, 0 = no reading.

    A pixel needs readings in two fifths of the frames (flickering edges have fewer); readings
    beyond three standard deviations and one disparity step of the median are left out.
    """
    frames = len(stack)
    least = max(1, int(np.ceil(0.4 * frames)))
    depth = np.zeros(stack.shape[1:], np.float32)
    count = np.zeros(stack.shape[1:], np.uint8)
    change = np.full(stack.shape[1:], np.nan, np.float32)
    unsettled = np.zeros(stack.shape[1:], np.float32)
    third = max(1, frames // 3)
    _average(stack, np.float32(scale_m), least, third, depth, count, unsettled, change)
    return AveragedDepth(depth, count, unsettled, change)


@numba.njit(cache=True, nogil=True)
def _average(stack, scale, least, third, depth, count, unsettled, change):  # type: ignore[no-untyped-def]  # pragma: no cover
    frames, height, width = stack.shape
    values = np.empty(frames, np.float32)
    order = np.empty(frames, np.float32)
    for y in range(height):
        for x in range(width):
            valid = 0
            lowest, highest = np.float32(np.inf), np.float32(0.0)
            for i in range(frames):
                value = stack[i, y, x] * scale
                values[i] = value
                if value > 0.0:
                    valid += 1
                    lowest = min(lowest, value)
                    highest = max(highest, value)
            if valid < least:
                continue
            # Where even the extremes agree, so does everything with the median, whatever it is.
            median, gate = lowest, np.float32(np.inf)
            if highest - lowest > _gate(lowest):
                median = _median(values, order)
                gate = _gate(median)
            total = np.float32(0.0)
            kept = 0
            early = np.float32(0.0)
            early_count = 0
            late = np.float32(0.0)
            late_count = 0
            for i in range(frames):
                value = values[i]
                if value > 0.0 and abs(value - median) <= gate:
                    total += value
                    kept += 1
                    if i < third:
                        early += value
                        early_count += 1
                    elif i >= frames - third:
                        late += value
                        late_count += 1
            if valid - kept >= _STRAY_READINGS:
                unsettled[y, x] = median
            if kept < least:
                continue
            depth[y, x] = total / kept
            count[y, x] = kept
            if early_count > 0 and late_count > 0:
                change[y, x] = late / late_count - early / early_count


@numba.njit(cache=True, nogil=True, inline="always")
def _gate(depth):  # type: ignore[no-untyped-def]  # pragma: no cover
    return np.float32(_GATE_SIGMAS * RANDOM_SIGMA + STEP) * depth * depth


@numba.njit(cache=True, nogil=True)
def _median(values, order):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Of those above zero; order is room to sort them in."""
    valid = 0
    for value in values:
        if value > 0.0:
            j = valid
            while j > 0 and order[j - 1] > value:
                order[j] = order[j - 1]
                j -= 1
            order[j] = value
            valid += 1
    return np.float32(0.5) * (order[(valid - 1) // 2] + order[valid // 2])
