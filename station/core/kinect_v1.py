"""Parameters of the Kinect v1: image, clock, raw readings, errors.

Raw 11-bit disparities become depth by 0.1236 tan(raw / 2842.5 + 1.1863) metres for every unit, an
approximation in wide use among libfreenect's users; each unit's deviation from it is smooth in
depth and removed by the calibration's depth correction.

Errors are given in inverse depth, where they are the same at every range: the random error of depth
is 1.425e-3 z^2 m (Khoshelham & Elberink 2012), so 1.425e-3 1/m of inverse depth, growing as a
surface is seen at a slant; readings are 1/8 px of disparity apart; errors are correlated over the
matching window. (The simulation has numbers of its own: it must not share these assumptions.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 640, 480
"""The depth image, pixels."""
FOCAL_PX = 585.0
"""Nominal; the calibration holds each unit's own."""
BASELINE_M = 0.075
"""From the infrared camera to the projector."""
FRAME_RATE_HZ = 30.0
TICK_HZ, TICK_BITS = 60_000_000, 32
"""The device clock; it wraps every 71.6 s."""

NO_READING = 2047
"""The raw value of a pixel that sees no pattern."""
DEPTH_SCALE_M = 1e-4
"""Metres per unit of the depth frames: fine enough that rounding is lost in the noise."""
_FARTHEST_M = 6.0

RANDOM_SIGMA = 1.425e-3
"""Standard deviation of one pixel that sees a surface squarely, 1/m."""
STEP = 1.0 / (8.0 * FOCAL_PX * BASELINE_M)
"""Between neighbouring readings, 1/m."""
CORRELATED_PX = 32.0
"""Pixels that share one random error: a Gaussian window of 1.6 px has 4 pi 1.6^2."""
SQUARE_ERROR = CORRELATED_PX * RANDOM_SIGMA**2
"""Variance of the mean of n pixels is (SQUARE_ERROR / cosine + ROUNDING) / n."""
FROZEN_SHARE = 0.5
"""Share of a pixel's error variance that is the same in every frame of a still scene: the speckle
pattern of a unit does not change, only its exposure flickers."""
ROUNDING = STEP**2 / 12.0
"""Rounding errors of neighbouring pixels are independent: the random error spans half a step."""
INDEPENDENT_HZ = 20.0
"""Frames a second of what is waved at 0.4 m/s whose errors are nearly independent: at 1.7 m it
moves by 7 px in a twentieth of a second, over which the correlation of errors falls to a hundredth;
neighbours among 30 a second share an eighth. Using more frames would overstate their
information."""


def nominal_intrinsics() -> NDArray[np.float64]:
    """K of the depth image (3x3, pixels) as the manufacturer states it."""
    return np.array(
        [[FOCAL_PX, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL_PX, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]]
    )


def depth_m_of_raw(raw: NDArray[np.integer]) -> NDArray[np.float64]:
    """Metres of raw values; 0 for no reading and beyond the useful range."""
    depth = 0.1236 * np.tan(np.asarray(raw, np.float64) / 2842.5 + 1.1863)
    usable = (np.asarray(raw) < NO_READING) & (depth > 0.0) & (depth < _FARTHEST_M)
    return np.where(usable, depth, 0.0)


def registration_law(inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse depth by the law of libfreenect's registration, of one by the tangent law.

    1/z = (1 - m / b) / z0 with m = ((raw - 800) / 4 - 0.375) p: linear in the raw value, as
    triangulation has it. Constants as most units state them: z0 = 1.2 m, p = 1.042 mm, b = 75 mm.
    """
    raw = 2842.5 * (np.arctan(1.0 / (0.1236 * inverse)) - 1.1863)
    return np.asarray((1.0 - 1.042e-3 * ((raw - 800.0) / 4.0 - 0.375) / BASELINE_M) / 1.2)


TABLE: NDArray[np.uint16] = np.rint(depth_m_of_raw(np.arange(2048)) / DEPTH_SCALE_M).astype(
    np.uint16
)
"""Depth frame value of each raw value, (2048,)."""
_RAW_BITS = 0x7FF
_ROWS_AT_ONCE = 24
"""Their indices stay in the processor's cache, and in memory that is not given back."""


def depth_of_raw(raw: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """A depth frame (height, width) of raw 11-bit disparities; higher bits are ignored."""
    depth = np.empty(raw.shape, np.uint16)
    for row in range(0, len(raw), _ROWS_AT_ONCE):
        rows = np.s_[row : row + _ROWS_AT_ONCE]
        # No value is out of bounds; to check each would take half as long again.
        TABLE.take(raw[rows] & _RAW_BITS, out=depth[rows], mode="clip")
    return depth
