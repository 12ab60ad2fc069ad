"""Noise that is left in an averaged depth image, beyond that of independent readings.

Noise that is the same in every frame, as that of the pattern that a sensor projects, does not
average out. It shows in the image itself: fourth differences of the inverse depth, between pixels
far enough apart that their errors are independent, leave hardly anything of a body's shape.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import Image
from station.core.kinect_v1 import RANDOM_SIGMA

Mask = NDArray[np.bool_]

_SPACING_PX = 5
"""Errors correlate over the sensor's matching window, to a tenth at this distance."""
_STRIDE_PX = 3
"""Every so many rows and columns are looked at: neighbours err alike."""
_WEIGHTS = (1.0, -4.0, 6.0, -4.0, 1.0)
_NORMAL_MEDIAN = 0.6745
"""Median size over the standard deviation of a normal distribution."""
_USUAL2, _USUAL2_A_READING = 1.78, 0.018
"""Square of the size of the differences, relative to independent noise of the assumed size, that
slants, rounding and the shape of a body explain. Rounding and shape do not average out: their share
grows with the readings in the mean. 1.96 for ten."""
_ENOUGH = 700
"""Fewest differences that a median is taken of; with fewer the noise is taken for independent."""


def noise_ratio(depth_m: Image, usable: Mask, readings: NDArray[np.integer]) -> float:
    """Standard deviation of an averaged image's noise, per that of independent readings.

    Args:
        depth_m: (h, w), averaged, not filtered.
        usable: (h, w), pixels on the person.
        readings: (h, w), numbers of readings in the mean.

    Returns:
        At least 1. Readings of which two fifths of the variance stay, averaged over ten frames,
        give sqrt(0.4 * 10 + 0.6) = 2.1.
    """
    inverse = np.where(usable, 1.0 / np.where(usable, depth_m, 1.0), np.nan).astype(np.float32)
    variance = RANDOM_SIGMA**2 / np.maximum(readings, 1).astype(np.float32)
    rows, columns = np.s_[::_STRIDE_PX], np.s_[:, ::_STRIDE_PX]
    along_rows = _relative_sizes(inverse[rows], variance[rows])
    along_columns = _relative_sizes(inverse[columns].T, variance[columns].T)
    sizes = np.concatenate([along_rows, along_columns])
    if len(sizes) < _ENOUGH:
        return 1.0
    found = float(np.median(sizes)) / _NORMAL_MEDIAN
    usual2 = _USUAL2 + _USUAL2_A_READING * float(np.median(readings[usable]))
    return float(np.sqrt(max(1.0, 1.0 + found**2 - usual2)))


def _relative_sizes(inverse: Image, variance: Image) -> NDArray[np.float32]:
    """Sizes (n,) of fourth differences along lines (k, length), per their standard deviation."""
    length = inverse.shape[1] - (len(_WEIGHTS) - 1) * _SPACING_PX
    if length <= 0:
        return np.empty(0, np.float32)
    starts = range(0, len(_WEIGHTS) * _SPACING_PX, _SPACING_PX)
    difference = np.zeros((len(inverse), length), np.float32)
    expected = np.zeros_like(difference)
    for start, weight in zip(starts, _WEIGHTS, strict=True):
        difference += np.float32(weight) * inverse[:, start : start + length]
        expected += np.float32(weight**2) * variance[:, start : start + length]
    found = np.isfinite(difference)
    return np.asarray(np.abs(difference[found]) / np.sqrt(expected[found]), np.float32)
