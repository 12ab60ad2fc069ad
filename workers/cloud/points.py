"""Points and normals of a depth image, through the lens and the calibration."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import JUMP_RATIO, Image

_NORMAL_REACH_PX = 2


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


def normals(points: Image, depth_m: Image) -> tuple[Image, NDArray[np.bool_]]:
    """Unit normals (h, w, 3) towards the camera, and where they exist.

    From central differences over a few pixels that lie on one surface. Where only the reading above
    is missing the difference is one-sided: the projector's shadow lies along the rows, so that
    there the surface turns away, as the crown of a head does.
    """
    return _normals(points, depth_m, _NORMAL_REACH_PX, np.float32(JUMP_RATIO * _NORMAL_REACH_PX))


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
