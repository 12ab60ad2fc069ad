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
    return _normals(points, depth_m, _NORMAL_REACH_PX, np.float32(_JUMP_RATIO * _NORMAL_REACH_PX))


@numba.njit(cache=True, nogil=True)
def _normals(points, depth_m, reach, jump):  # type: ignore[no-untyped-def]  # pragma: no cover
    height, width = depth_m.shape
    result, valid = np.zeros_like(points), np.zeros((height, width), np.bool_)
    for v in range(reach, height - reach):
        for u in range(reach, width - reach):
            gate = jump * depth_m[v, u]
            ends = depth_m[v - reach, u] == 0.0
            if not (
                _near(depth_m[v, u + reach], depth_m[v, u], gate)
                and _near(depth_m[v, u - reach], depth_m[v, u], gate)
                and _near(depth_m[v + reach, u], depth_m[v, u], gate)
                and (ends or _near(depth_m[v - reach, u], depth_m[v, u], gate))
            ):
                continue
            right, left = points[v, u + reach], points[v, u - reach]
            below, above = points[v + reach, u], points[v if ends else v - reach, u]
            a, b, c = below[0] - above[0], below[1] - above[1], below[2] - above[2]
            d, e, f = right[0] - left[0], right[1] - left[1], right[2] - left[2]
            x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
            length = np.sqrt(x * x + y * y + z * z)
            if length == 0.0:
                continue
            here, out = points[v, u], result[v, u]
            if x * here[0] + y * here[1] + z * here[2] > 0.0:
                length = -length
            out[0], out[1], out[2] = x / length, y / length, z / length
            valid[v, u] = True
    return result, valid


@numba.njit(cache=True, nogil=True, inline="always")
def _near(neighbour, center, gate):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether two readings lie on one surface."""
    return neighbour > 0.0 and center > 0.0 and abs(neighbour - center) < gate
