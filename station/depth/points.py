"""Points and normals of a depth image, through the lens and the calibration."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from station.calibration.rig import CameraCalibration

Image = NDArray[np.float32]
_NORMAL_REACH_PX = 2
_JUMP_RATIO = 0.02


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


def camera_points(camera: CameraCalibration, depth_m: Image) -> Image:
    """(h, w, 3) points in the camera frame; zeros where there is no reading."""
    return rays(camera) * depth_m[..., None]


@numba.njit(cache=True, nogil=True)
def within(rays_, depth_m, world_from_camera, low, high):  # type: ignore[no-untyped-def]  # pragma: no cover
    """(h, w): readings whose points lie in a box of the world.

    Args:
        rays_: (h, w, 3), as `rays` gives them.
        depth_m: (h, w), 0 = no reading.
        world_from_camera: (4, 4).
        low, high: (3,): the box' corners, metres.
    """
    height, width = depth_m.shape
    out = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            depth = depth_m[y, x]
            if not depth > 0.0:
                continue
            inside = True
            for i in range(3):
                place = world_from_camera[i, 3]
                for k in range(3):
                    place += world_from_camera[i, k] * rays_[y, x, k] * depth
                inside = inside and low[i] < place < high[i]
            out[y, x] = inside
    return out


def jumps(depth_m: Image, radius_px: int = 2) -> NDArray[np.bool_]:
    """Pixels within a radius of a depth discontinuity, where readings mix two surfaces."""
    window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    seen = depth_m > 0
    far = cv2.dilate(depth_m, window)
    near = cv2.erode(np.where(seen, depth_m, np.float32(99.0)), window)
    return np.asarray(seen & (far - near > _JUMP_RATIO * radius_px * depth_m))


def normals(points: Image, depth_m: Image) -> tuple[Image, NDArray[np.bool_]]:
    """Unit normals (h, w, 3) towards the camera, and where they exist.

    From central differences over a few pixels that lie on one surface. Where only the reading above
    is missing the difference is one-sided: the projector's shadow lies along the rows, so that
    there the surface turns away, as the crown of a head does.
    """
    r = _NORMAL_REACH_PX
    result = np.zeros_like(points)
    middle = np.s_[r:-r, r:-r]
    right, left = np.s_[r:-r, 2 * r :], np.s_[r:-r, : -2 * r]
    below, above = np.s_[2 * r :, r:-r], np.s_[: -2 * r, r:-r]
    ends = depth_m[above] == 0
    high = np.where(ends[..., None], points[middle], points[above])
    inner = cross(points[below] - high, points[right] - points[left])
    length = np.sqrt(np.einsum("hwi,hwi->hw", inner, inner))
    center = depth_m[middle]
    whole = (center > 0) & (length > 0)
    for side, none in ((right, False), (left, False), (below, False), (above, ends)):
        neighbour = depth_m[side]
        near = (neighbour > 0) & (np.abs(neighbour - center) < _JUMP_RATIO * r * center)
        whole &= near | none
    result[middle] = np.where(whole[..., None], inner / np.maximum(length, 1e-12)[..., None], 0)
    valid = np.zeros(depth_m.shape, bool)
    valid[middle] = whole
    facing = np.einsum("hwi,hwi->hw", result, points) > 0
    result[facing] *= -1.0
    return result, valid


def cross(a: Image, b: Image) -> Image:
    """Cross product along the last axis; numpy's own is several times slower."""
    out = np.empty_like(a)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out
