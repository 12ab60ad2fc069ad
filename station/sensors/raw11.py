"""Kinect v1 raw 11-bit disparity as depth: metres = 0.1236 tan(raw / 2842.5 + 1.1863).

An approximation in wide use among libfreenect's users; each unit's deviation from it is smooth in
depth and taken out by the calibration's depth correction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NO_READING = 2047
DEPTH_SCALE_M = 1e-4
"""Metres per unit of the depth frames: fine enough that rounding is lost in the noise."""
_FARTHEST_M = 6.0


def depth_m_of_raw(raw: NDArray[np.integer]) -> NDArray[np.float64]:
    """Metres of raw values; 0 for no reading and for what lies beyond any use."""
    depth = 0.1236 * np.tan(np.asarray(raw, np.float64) / 2842.5 + 1.1863)
    usable = (np.asarray(raw) < NO_READING) & (depth > 0.0) & (depth < _FARTHEST_M)
    return np.where(usable, depth, 0.0)


TABLE: NDArray[np.uint16] = np.rint(depth_m_of_raw(np.arange(2048)) / DEPTH_SCALE_M).astype(
    np.uint16
)
"""Depth frame value of each raw value, (2048,)."""
