"""Candidate positions of a ball of known radius in a depth image: pixels vote for its centre.

Every pixel's normal points away from the centre of the ball that it would lie on, so pixels of the
ball vote for one place and all others scatter (a Hough transform with known radius).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.core.lens import rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STEP_PX = 3
"""Every third pixel of each row and column votes."""
_BLUR_PX = 9
_SLOPE_PX = 6
_CELL_M = 0.03
_NEAR_M = 0.045
"""Votes this near to one another may be for one ball."""
_CANDIDATES = 8
_MIN_VOTES = 8
_MIN_VOTE_SHARE = 0.2
_AROUND_WEIGHT = 0.3
"""A plane fills 9 cells of 3^3 and 49 of 7^3, so anything above 9/49 cancels it."""


def candidates(
    inverse: Image, foreground: Mask, camera: CameraCalibration, radius_m: float
) -> list[Array]:
    """Places (3,) in the camera frame that many pixels vote for, best first."""
    rows, columns = np.flatnonzero(foreground.any(axis=1)), np.flatnonzero(foreground.any(axis=0))
    if len(rows) < 4 or len(columns) < 4:
        return []
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    votes = _votes(inverse[part], foreground[part], rays(camera)[part], radius_m)
    if len(votes) < 20:
        return []
    low = votes.min(axis=0) - _CELL_M
    cells = ((votes - low) / _CELL_M).astype(np.int64)
    shape = cells.max(axis=0) + 2
    counts = np.bincount(np.ravel_multi_index(tuple(cells.T), tuple(shape)), minlength=shape.prod())
    grid = counts.reshape(shape).astype(np.float32)
    close, around = (
        size**3 * ndimage.uniform_filter(grid, size, mode="constant") for size in (3, 7)
    )
    # A wall's votes lie on a plane and an arm's on a line: there are votes around each, too.
    # What is near covers more pixels: votes count as a share of what a ball there would give.
    depths = np.maximum(low[2] + (np.arange(shape[2]) + 0.5) * _CELL_M, 0.3).astype(np.float32)
    alone = close - _AROUND_WEIGHT * around
    smooth = np.where((close >= _MIN_VOTES) & (alone > 0.0), alone * depths**2, 0.0)
    K = camera.K
    found: list[Array] = []
    for _ in range(_CANDIDATES):
        peak = np.array(np.unravel_index(np.argmax(smooth), smooth.shape))
        if smooth[tuple(peak)] <= 0.0:
            break
        center = low + (peak + 0.5) * _CELL_M
        for reach in (2.0 * _NEAR_M, _NEAR_M, _NEAR_M):
            near = np.sum((votes - center) ** 2, axis=1) < reach**2
            if near.any():
                center = votes[near].mean(axis=0)
        whole = np.pi * (radius_m / max(center[2], 0.3)) ** 2 * K[0, 0] * K[1, 1] / _STEP_PX**2
        if near.sum() > _MIN_VOTE_SHARE * whole:
            found.append(center)
        smooth[tuple(slice(max(i - 2, 0), i + 3) for i in peak)] = 0.0
    return found


def _votes(inverse: Image, foreground: Mask, ray: Image, radius_m: float) -> Array:
    """Ball centres (n, 3) that single pixels speak for."""
    mask = foreground.astype(np.float32)
    share = cv2.blur(mask, (_BLUR_PX, _BLUR_PX), borderType=cv2.BORDER_CONSTANT)
    blurred = cv2.blur(inverse * mask, (_BLUR_PX, _BLUR_PX), borderType=cv2.BORDER_CONSTANT)
    smooth = np.where(share > 0.5, blurred / np.maximum(share, 1e-6), 0.0)
    r = _SLOPE_PX
    if min(smooth.shape) <= 2 * r:
        return np.empty((0, 3))
    inner = np.s_[r:-r:_STEP_PX, r:-r:_STEP_PX]
    middle, rays_ = smooth[inner], ray[inner]
    right, left = smooth[r:-r, 2 * r :], smooth[r:-r, : -2 * r]
    below, above = smooth[2 * r :, r:-r], smooth[: -2 * r, r:-r]
    right, left, below, above = (
        side[::_STEP_PX, ::_STEP_PX] for side in (right, left, below, above)
    )
    x_step = ray[r:-r, 2 * r :, 0] - ray[r:-r, : -2 * r, 0]
    y_step = ray[2 * r :, r:-r, 1] - ray[: -2 * r, r:-r, 1]
    wx = (right - left) / x_step[::_STEP_PX, ::_STEP_PX]
    wy = (below - above) / y_step[::_STEP_PX, ::_STEP_PX]
    # A surface w = m . (x, y, 1) is the plane m . X = 1, whose normal m points away from the eye.
    m = np.stack([wx, wy, middle - wx * rays_[..., 0] - wy * rays_[..., 1]], axis=-1)
    length = np.sqrt(np.einsum("hwi,hwi->hw", m, m))
    spread = np.maximum.reduce([right, left, below, above]) - np.minimum.reduce(
        [right, left, below, above]
    )
    good = (
        foreground[inner]
        & (np.minimum.reduce([right, left, below, above, middle]) > 0)
        & (spread < 2.0 * radius_m * middle**2)
        & (length > 0)
    )
    depth = 1.0 / middle[good]
    points = rays_[good] * depth[:, None] + radius_m * m[good] / length[good][:, None]
    return np.asarray(points, np.float64)
