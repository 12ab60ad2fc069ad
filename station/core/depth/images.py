"""Depth images: inverse depth and discontinuities.

OpenCV is loaded where it is needed: a process that only reads the calibration does without its
60 MB.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
JUMP_RATIO = 0.02
"""Neighbouring readings of one surface differ by less than this share of their depth a pixel."""
_JUMP_RADIUS_PX = 2


def inverse_depth(depth_m: Image) -> Image:
    """1/z of depths (h, w) in metres; 0 (no reading) stays 0."""
    return np.divide(np.float32(1.0), depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)


def jumps(depth_m: Image) -> NDArray[np.bool_]:
    """Mask (h, w) of the pixels near a depth discontinuity, where readings mix two surfaces."""
    import cv2

    side = 2 * _JUMP_RADIUS_PX + 1
    window = np.ones((side, side), np.uint8)
    seen = depth_m > 0
    far = cv2.dilate(depth_m, window)
    near = cv2.erode(np.where(seen, depth_m, np.float32(99.0)), window)
    return np.asarray(seen & (far - near > JUMP_RATIO * _JUMP_RADIUS_PX * depth_m))
