"""Lens parameters that a depth camera may have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ZERO = 1e-6
"""Largest size of what is 0 in K but for rounding."""
_FOCAL_RATIO = 3.0
"""Pixels that were merged along one side of the image are twice as long as wide."""
_MAX_DISTORTION = 1e3


def check_intrinsics(K: Array, distortion: Array, width: int, height: int) -> None:
    """Refuse finite K (3, 3) and distortion (5,) that no camera with images of this size has.

    No reader of K looks at its other terms.

    Raises:
        ValueError: what they must be.
    """
    (fx, _, cx), (_, fy, cy), _ = K
    others = K - ((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))
    near, far = min(fx, fy), max(fx, fy)
    if near <= 1.0:
        raise ValueError("K must have positive focal lengths, beyond 1 pixel")
    if far > _FOCAL_RATIO * near:
        raise ValueError(f"K must have fx and fy within a factor of {_FOCAL_RATIO:g}")
    if not (-width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise ValueError("K must have its centre less than an image's size away from the image")
    if np.abs(others).max() >= _ZERO:
        raise ValueError("K must have the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if np.abs(distortion).max() > _MAX_DISTORTION:
        raise ValueError(f"distortion must lie within {_MAX_DISTORTION:g} of 0")
