"""Flat surfaces in one camera's averaged depth image: the floor, a board held up.

In inverse depth a plane is linear in the pixel: 1/z = m . (x, y, 1) for the plane m . X = 1, so the
mean over a cell of pixels is exact, and three pixels give a plane without more ado.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from station.calibration.detections import FLOOR, PlaneObservation
from station.calibration.rig import CameraCalibration
from station.calibration.sensor_noise import RANDOM_SIGMA, ROUNDING, SQUARE_ERROR
from station.depth.points import jumps, rays

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_CELL_PX = 12
_STRIDE_PX = 5
_TRIALS = 300
_TILT_COSINE = 0.6
"""A floor or a wall is at most 53 degrees off what an upright camera would see."""
_HEIGHT_M = (0.15, 3.5)
_INCIDENCE_COSINE = 0.26
"""75 degrees: a camera at hip height sees the floor at a slant, if at all."""
_UNEVEN_M = 5e-4
"""How flat floors and boards are over a cell."""
_LEAST_PATCHES = 40
_LEAST_SHARE = 0.3
_FOREGROUND = 0.015


def observe_floor(depth_m: Image, frames: int, camera: CameraCalibration) -> PlaneObservation | None:
    """The floor in an averaged image (h, w) of the empty booth; None where too little is seen.

    The camera stands more or less upright.
    """
    return _observe(depth_m, frames, camera, FLOOR, axis=1, only=depth_m > 0)


def observe_wall(
    depth_m: Image, frames: int, camera: CameraCalibration, surface: str, background_m: Image
) -> PlaneObservation | None:
    """A board that was brought into the booth, in an averaged image; None where it is not seen."""
    inverse = _inverse(depth_m)
    only = inverse > _inverse(background_m) + _FOREGROUND
    return _observe(depth_m, frames, camera, surface, axis=2, only=only)


def _inverse(depth_m: Image) -> Array:
    return np.where(depth_m > 0, 1.0 / np.where(depth_m > 0, depth_m, 1.0), 0.0)


def _observe(
    depth_m: Image, frames: int, camera: CameraCalibration, surface: str, *, axis: int, only: Mask
) -> PlaneObservation | None:
    usable = only & ~jumps(depth_m)
    inverse = _inverse(depth_m)
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
    patches = _patches(inverse, on_plane, cosine, frames)
    if len(patches) < _LEAST_PATCHES:
        return None
    return PlaneObservation(camera.name, surface, int(on_plane.sum()), patches)


def _largest(ray: Array, inverse: Array, gate: float, axis: int) -> Array | None:
    """The plane m (3,) that most pixels lie on, of those that face along an axis of the camera."""
    if len(ray) < 100:
        return None
    rng = np.random.default_rng(0)
    best, most = None, 99
    for _ in range(_TRIALS):
        corner = rng.choice(len(ray), 3, replace=False)
        try:
            plane = np.linalg.solve(ray[corner], inverse[corner])
        except np.linalg.LinAlgError:
            continue
        length = float(np.linalg.norm(plane))
        if not (length > 0 and plane[axis] > _TILT_COSINE * length):
            continue
        if not _HEIGHT_M[0] < 1.0 / length < _HEIGHT_M[1]:
            continue
        count = int(np.sum(np.abs(ray @ plane - inverse) < gate))
        if count > most:
            best, most = plane, count
    if best is None:
        return None
    for _ in range(4):
        on_plane = np.abs(ray @ best - inverse) < gate
        best = np.linalg.lstsq(ray[on_plane], inverse[on_plane], rcond=None)[0]
    return best


def _patches(inverse: Array, on_plane: Mask, cosine: Array, frames: int) -> Array:
    """Cell means (k, 4); every pixel is the mean of some frames."""
    height, width = (side // _CELL_PX for side in inverse.shape)
    v, u = np.nonzero(on_plane[: height * _CELL_PX, : width * _CELL_PX])
    cell = (v // _CELL_PX) * width + u // _CELL_PX
    size = np.bincount(cell, minlength=height * width)
    kept = np.flatnonzero(size >= _LEAST_SHARE * _CELL_PX**2)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, values, minlength=len(size))[kept] / size[kept])

    w = mean(inverse[v, u])
    noise = mean(SQUARE_ERROR / cosine[v, u] + ROUNDING) / (size[kept] * max(frames, 1))
    variance = noise + (_UNEVEN_M * w**2) ** 2
    return np.stack([mean(u.astype(float)), mean(v.astype(float)), w, variance], axis=1)
