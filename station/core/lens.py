"""Pixels to rays and points to pixels through a camera's lens (OpenCV's distortion model)."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import Image
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]

_NEAREST_M = 0.05
"""Points closer to the camera's plane count as behind it."""


def rays(camera: CameraCalibration) -> Image:
    """Rays (x, y, 1) of all pixels, (h, w, 3), with the lens distortion removed."""
    return _rays(
        camera.width, camera.height, tuple(camera.K.ravel()), tuple(camera.distortion.ravel())
    )


@lru_cache(maxsize=16)
def _rays(width: int, height: int, K: tuple[float, ...], distortion: tuple[float, ...]) -> Image:
    pixels = np.stack(
        np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)),
        axis=-1,
    )
    result = np.ones((height, width, 3), np.float32)
    result[..., :2] = _undistorted(pixels, np.array(K).reshape(3, 3), np.array(distortion))
    result.flags.writeable = False
    return result


def pixel_rays(camera: CameraCalibration, pixels: Array) -> Array:
    """Directions x, y of the rays (x, y, 1) through pixels (..., 2), any sub-pixel position."""
    return _undistorted(pixels, camera.K, camera.distortion)


def _undistorted(pixels: Array, K: Array, distortion: Array) -> Array:
    if not distortion.any():
        return np.asarray((pixels - (K[0, 2], K[1, 2])) / (K[0, 0], K[1, 1]))
    undone = cv2.undistortPoints(pixels.reshape(-1, 1, 2), K, distortion)
    return np.asarray(undone, np.float64).reshape(pixels.shape)


def project(camera: CameraCalibration, points: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) in the camera frame; NaN for points behind the camera."""
    ahead = points[..., 2:] > _NEAREST_M
    safe = np.where(ahead, points, (0.0, 0.0, 1.0))
    K = camera.K
    if camera.distortion.any():
        nothing = np.zeros(3)
        pixels = cv2.projectPoints(safe.reshape(-1, 3), nothing, nothing, K, camera.distortion)[0]
        pixels = pixels.reshape(*points.shape[:-1], 2)
    else:
        pixels = safe[..., :2] / safe[..., 2:] * (K[0, 0], K[1, 1]) + (K[0, 2], K[1, 2])
    return np.where(ahead, pixels, np.nan)
