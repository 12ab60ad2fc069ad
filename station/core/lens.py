"""Pixels to rays and points to pixels, through a camera's lens."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.depth_image import Image
from station.core.rig import CameraCalibration


def rays(camera: CameraCalibration) -> Image:
    """(h, w, 3) rays (x, y, 1) of the pixels, the lens' distortion undone."""
    return _rays(
        camera.width, camera.height, tuple(camera.K.ravel()), tuple(camera.distortion.ravel())
    )


@lru_cache(maxsize=16)
def _rays(width: int, height: int, K: tuple[float, ...], distortion: tuple[float, ...]) -> Image:
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    matrix = np.array(K).reshape(3, 3)
    result = np.ones((height, width, 3), np.float32)
    if any(distortion):
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
        result[..., :2] = cv2.undistortPoints(pixels, matrix, np.array(distortion)).reshape(
            height, width, 2
        )
    else:
        result[..., 0] = (u - matrix[0, 2]) / matrix[0, 0]
        result[..., 1] = (v - matrix[1, 2]) / matrix[1, 1]
    result.flags.writeable = False
    return result


def project(camera: CameraCalibration, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (n, 2) of points (n, 3) in the camera frame; NaN behind the camera."""
    z = points[:, 2]
    ahead = z > 0.05
    safe = np.where(ahead[:, None], points, (0.0, 0.0, 1.0))
    if camera.distortion.any():
        pixels = cv2.projectPoints(safe, np.zeros(3), np.zeros(3), camera.K, camera.distortion)[
            0
        ].reshape(-1, 2)
    else:
        K = camera.K
        pixels = safe[:, :2] / safe[:, 2:] * (K[0, 0], K[1, 1]) + (K[0, 2], K[1, 2])
    return np.where(ahead[:, None], pixels, np.nan)
