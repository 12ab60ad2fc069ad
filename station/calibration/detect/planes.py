"""Flat surfaces in one camera's averaged depth image: the floor, a board held up.

In inverse depth a plane is linear in the pixel: 1/z = m . (x, y, 1) for the plane m . X = 1, so the
mean over a cell of pixels is exact, and three pixels determine a plane.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.detections import FLOOR, PlaneObservation
from station.core.depth.images import Image, inverse_depth, jumps
from station.core.kinect_v1 import FROZEN_SHARE, RANDOM_SIGMA, ROUNDING, SQUARE_ERROR
from station.core.lens import rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELL_PX = 12
_STRIDE_PX = 5
_TRIALS = 300
_TILT_COSINE = 0.6
"""A floor or a wall is at most 53 degrees off what an upright camera would see."""
_HEIGHT_M = (0.15, 3.5)
_INCIDENCE_COSINE = 0.26
"""75 degrees: a camera at hip height sees the floor at a slant, if at all."""
_UNEVEN_FLOOR_M, _UNEVEN_BOARD_M = 5e-4, 2e-4
"""Unevenness of a floor and of a board, rms (DIN 18202 lets a finished floor be off
by 2 mm over 0.1 m), ..."""
_BUMP_M2 = 2.0 * np.pi * 0.1**2
"""... in bumps of this size: what one camera sees of a bump errs all alike."""
_MIN_PATCHES = 40
_MIN_SHARE = 0.3
_FOREGROUND = 0.015
_LARGEST_SHARE_BEYOND = 0.05
_FARTHEST_M = 3.2
_WHOLE_PX = 3
_MIN_WHOLE = 2
_MIN_WHOLE_SHARE = 0.6
"""Least share of the frames without gaps: else readings between gaps are too near as well."""


def observe_floor(
    stack: NDArray[np.uint16], scale_m: float, camera: CameraCalibration
) -> PlaneObservation | None:
    """The floor in frames (n, h, w) of the empty booth; None where too little of it is seen.

    The camera stands more or less upright.
    """
    depth_m, count = _whole_mean(stack, scale_m)
    return _observe(depth_m, count, camera, FLOOR, axis=1, only=depth_m > 0)


def observe_wall(
    stack: NDArray[np.uint16],
    scale_m: float,
    camera: CameraCalibration,
    surface: str,
    background_m: Image,
) -> PlaneObservation | None:
    """A board that was brought into the booth, in frames (n, h, w); None where it is not seen."""
    depth_m, count = _whole_mean(stack, scale_m)
    only = inverse_depth(depth_m) > inverse_depth(background_m) + _FOREGROUND
    return _observe(depth_m, count, camera, surface, axis=2, only=only)


def mean_share(frames: Any) -> Any:
    """Variance of the mean of frames of a still scene, relative to that of one frame."""
    return FROZEN_SHARE + (1.0 - FROZEN_SHARE) / frames


def _whole_mean(stack: NDArray[np.uint16], scale_m: float) -> tuple[Image, Image]:
    """Each pixel's mean over the frames in which all around it have readings, and their number.

    Beside a missing reading stands one of its neighbours' nearest: at a slant, where many are
    missing, that would lift a floor by millimetres. Where most frames have gaps the pixel is left
    out: what fills a gap looks like a reading, and half a millimetre over a narrow strip leans the
    whole booth by 0.2 degrees.
    """
    total = np.zeros(stack.shape[1:], np.float32)
    count = np.zeros(stack.shape[1:], np.float32)
    window = np.ones((_WHOLE_PX, _WHOLE_PX), np.uint8)
    for frame in stack:
        whole = cv2.erode((frame > 0).astype(np.uint8), window)
        total += frame * whole
        count += whole
    usable = count >= np.maximum(_MIN_WHOLE, _MIN_WHOLE_SHARE * len(stack))
    return (
        np.where(usable, scale_m * total / np.maximum(count, 1), 0.0).astype(np.float32),
        np.where(usable, count, 1.0).astype(np.float32),
    )


def _observe(
    depth_m: Image, count: Image, camera: CameraCalibration, surface: str, *, axis: int, only: Mask
) -> PlaneObservation | None:
    usable = only & ~jumps(depth_m) & (depth_m < _FARTHEST_M)
    inverse = inverse_depth(depth_m).astype(np.float64)
    ray = rays(camera).astype(np.float64)
    grid = np.zeros_like(usable)
    grid[::_STRIDE_PX, ::_STRIDE_PX] = True
    chosen = usable & grid
    gate = 4.0 * RANDOM_SIGMA
    plane = _largest(ray[chosen], inverse[chosen], gate, axis)
    if plane is None:
        return None
    cosine = np.abs(ray @ plane) / (np.linalg.norm(ray, axis=-1) * np.linalg.norm(plane))
    on_plane = usable & (np.abs(inverse - ray @ plane) < gate) & (cosine > _INCIDENCE_COSINE)
    patches = _patches(inverse, on_plane, cosine, count, camera, surface)
    if len(patches) < _MIN_PATCHES:
        return None
    return PlaneObservation(camera.name, surface, int(on_plane.sum()), patches)


def _largest(ray: Array, inverse: Array, gate: float, axis: int) -> Array | None:
    """The plane m (3,) that most pixels lie on, of those that face along an axis of the camera."""
    if len(ray) < 100:
        return None
    rng = np.random.default_rng(0)
    best: Array | None = None
    most = 99
    for _ in range(_TRIALS):
        corner = rng.choice(len(ray), 3, replace=False)
        try:
            plane = np.asarray(np.linalg.solve(ray[corner], inverse[corner]), np.float64)
        except np.linalg.LinAlgError:
            continue
        length = float(np.linalg.norm(plane))
        if not (length > 0 and plane[axis] > _TILT_COSINE * length):
            continue
        if not _HEIGHT_M[0] < 1.0 / length < _HEIGHT_M[1]:
            continue
        away = inverse - ray @ plane
        count = int(np.sum(np.abs(away) < gate))
        # A surface is opaque: a plane that cuts across two walls has readings beyond it.
        if count > most and np.sum(away < -gate) < _LARGEST_SHARE_BEYOND * count:
            best, most = plane, count
    if best is None:
        return None
    for _ in range(4):
        on_plane = np.abs(ray @ best - inverse) < gate
        fitted = np.linalg.lstsq(ray[on_plane], inverse[on_plane], rcond=None)[0]
        best = np.asarray(fitted, np.float64)
    return best


def _patches(
    inverse: Array,
    on_plane: Mask,
    cosine: Array,
    count: Image,
    camera: CameraCalibration,
    surface: str,
) -> Array:
    """Cell means (k, 4); every pixel is the mean of a count of frames."""
    height, width = (side // _CELL_PX for side in inverse.shape)
    v, u = np.nonzero(on_plane[: height * _CELL_PX, : width * _CELL_PX])
    cell = (v // _CELL_PX) * width + u // _CELL_PX
    size = np.bincount(cell, minlength=height * width)
    kept = np.flatnonzero(size >= _MIN_SHARE * _CELL_PX**2)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, values, minlength=len(size))[kept] / size[kept])

    w = mean(inverse[v, u])
    slant = mean(cosine[v, u])
    single = (SQUARE_ERROR / cosine[v, u] + ROUNDING) * mean_share(count[v, u])
    noise = mean(single) / size[kept]
    cells_m2 = size[kept] / (camera.K[0, 0] * camera.K[1, 1] * w**2 * slant)
    alike = np.maximum(_BUMP_M2 / cells_m2, 1.0)
    # What stands out of a surface by h changes the depth along a ray by h / cosine.
    uneven_m = _UNEVEN_FLOOR_M if surface == FLOOR else _UNEVEN_BOARD_M
    variance = noise + alike * (uneven_m * w**2 / slant) ** 2
    return np.stack([mean(u.astype(float)), mean(v.astype(float)), w, variance], axis=1)
