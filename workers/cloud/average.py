"""Robust mean of a few depth frames of a body that stands still."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.kinect_v1 import RANDOM_SIGMA, STEP

_GATE_SIGMAS = 3.0
"""Readings farther from the median than this, plus one disparity step, are left out."""
_STRAY_READINGS = 2
"""Readings that must be left out before a pixel counts as unsettled."""
_MIN_SHARE = 0.4
"""Share of the frames in which a pixel needs a reading; flickering edges have fewer."""
_MISSING = np.uint16(65535)
"""Sorts missing readings last."""


@dataclass(frozen=True, slots=True)
class AveragedDepth:
    """One camera's frames as one image, (h, w) each."""

    depth_m: NDArray[np.float32]
    """Mean of the readings near their median; 0 where too few agree."""
    count: NDArray[np.uint16]
    """Number of readings in the mean."""
    unsettled_m: NDArray[np.float32]
    """Median where two or more readings are far from it, as on a body that moved; 0 elsewhere."""
    change_m: NDArray[np.float32]
    """Mean of the last third of the frames minus that of the first; NaN without reading."""


def random_sigma_m(depth_m: NDArray[np.floating]) -> NDArray[np.floating]:
    """Standard deviation of one reading at a depth."""
    return np.asarray(RANDOM_SIGMA * np.square(depth_m))


def average(stack: NDArray[np.uint16], scale_m: float) -> AveragedDepth:
    """Average (frames, h, w) readings in units of scale_m, 0 = no reading.

    A pixel needs readings in two fifths of the frames (flickering edges have fewer); readings
    beyond three standard deviations and one disparity step of the median are left out.
    """
    frames = len(stack)
    least = max(1, int(np.ceil(_MIN_SHARE * frames)))
    depth = np.zeros(stack.shape[1:], np.float32)
    count = np.zeros(stack.shape[1:], np.uint16)
    change = np.full(stack.shape[1:], np.nan, np.float32)
    unsettled = np.zeros(stack.shape[1:], np.float32)
    third = max(1, frames // 3)
    _average(stack, np.float32(scale_m), least, third, depth, count, unsettled, change)
    return AveragedDepth(depth, count, unsettled, change)


@numba.njit(cache=True, nogil=True)
def _average(stack, scale, least, third, depth, count, unsettled, change):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Average row by row, so that the same operation on all pixels of a row is vectorised."""
    frames, height, width = stack.shape
    ordered = np.empty((frames, width), np.uint16)
    read = np.empty(width, np.uint16)
    # Separate arrays: the compiler does not vectorise rows of one, which might overlap.
    median, gate = np.empty(width, np.float32), np.empty(width, np.float32)
    total, early, late = np.empty_like(median), np.empty_like(median), np.empty_like(median)
    kept, kept_early, kept_late = np.empty_like(read), np.empty_like(read), np.empty_like(read)
    for y in range(height):
        _sort(stack, y, ordered, read)
        for x in range(width):
            lower, upper = ordered[(read[x] - 1) // 2, x], ordered[read[x] // 2, x]
            median[x] = np.float32(0.5) * (np.float32(lower) * scale + np.float32(upper) * scale)
            gate[x] = np.float32(_GATE_SIGMAS * RANDOM_SIGMA + STEP) * median[x] * median[x]
        for sums, counts in ((total, kept), (early, kept_early), (late, kept_late)):
            sums[:] = 0.0
            counts[:] = 0
        for i in range(frames):
            _add(stack[i, y], scale, median, gate, total, kept)
            if i < third:
                _add(stack[i, y], scale, median, gate, early, kept_early)
            elif i >= frames - third:
                _add(stack[i, y], scale, median, gate, late, kept_late)
        for x in range(width):
            if read[x] < least:
                continue
            if read[x] - kept[x] >= _STRAY_READINGS:
                unsettled[y, x] = median[x]
            if kept[x] < least:
                continue
            depth[y, x] = total[x] / np.int64(kept[x])
            count[y, x] = kept[x]
            if kept_early[x] > 0 and kept_late[x] > 0:
                before = early[x] / np.int64(kept_early[x])
                change[y, x] = late[x] / np.int64(kept_late[x]) - before


@numba.njit(cache=True, nogil=True)
def _sort(stack, y, ordered, read):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sort the readings of each pixel of a row in ascending order, missing last, and count them.

    Odd-even transposition sort, which compares whole rows and is therefore vectorised.
    """
    frames, _, width = stack.shape
    read[:] = 0
    for i in range(frames):
        row, out = stack[i, y], ordered[i]
        for x in range(width):
            read[x] += row[x] > 0
            out[x] = row[x] if row[x] > 0 else _MISSING
    for sweep in range(frames):
        for i in range(sweep % 2, frames - 1, 2):
            one, other = ordered[i], ordered[i + 1]
            for x in range(width):
                one[x], other[x] = min(one[x], other[x]), max(one[x], other[x])


@numba.njit(cache=True, nogil=True)
def _add(row, scale, median, gate, total, kept):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the readings of a row that lie within the gates around their medians."""
    for x in range(len(row)):
        value = np.float32(row[x]) * scale
        agrees = (value > 0.0) & (abs(value - median[x]) <= gate[x])
        total[x] += value if agrees else np.float32(0.0)
        kept[x] += agrees
