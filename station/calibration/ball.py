"""Finding a ball of known radius in one depth image: its centre, and how sure that is.

Coarse: every pixel's normal points away from the centre of the ball that it would lie on, so
pixels of the ball vote for one place and all others scatter (a Hough transform with known radius).
Fine: maximum likelihood over all pixels that see the ball at less than a limit of incidence, in
inverse depth along each pixel's own ray. Which pixels take part depends on where the ball is and
not on what they read, and the flickering silhouette is left out, so the centre is free of the
biases that fits of orthogonal distance have.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.calibration.detections import BallDetection
from station.calibration.rig import CameraCalibration
from station.calibration.sensor_noise import RANDOM_SIGMA, ROUNDING, SQUARE_ERROR
from station.depth.points import project, rays

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_RANGE_M = (0.5, 3.5)
_STEP_PX = 3
"""Every third pixel of each row and column votes."""
_BLUR_PX = 9
_SLOPE_PX = 6
_CELL_M = 0.03
_NEAR_M = 0.045
"""Votes this near to one another may be for one ball."""
_CANDIDATES = 8
_LEAST_VOTES = 8
_LEAST_VOTE_SHARE = 0.2
_AROUND_WEIGHT = 0.3
"""A plane fills 9 cells of 3^3 and 49 of 7^3, so anything above 9/49 cancels it."""
_FOREGROUND = 0.02
"""Inverse depth by which something stands before the background, 1/m: 58 mm at 1.7 m."""
_INCIDENCE_COSINE = np.cos(np.radians(62.0))
_START_GATE_M = 0.03
_GATE_SIGMAS = 3.5
_STRAY_ROUNDS = 4
_STRAY_BLUR_PX = 7
_STRAY_NOISE = 0.7
"""Share of a pixel's noise that is left in the mean over the blur."""
_STRAY_SIGMAS = 3.0
_STRAY_CLIP = 12.0
_STRAY_COSINE = 0.4
_LEAST_PIXELS = 150
_LEAST_VISIBLE = 0.45
_LARGEST_SPREAD = 2.0
_OPEN_RING_SHARE = 0.5
_RADIUS_TOLERANCE = 0.4
_RADIUS_SLACK = 0.02
_ALIKE = 4.0
_CELLS = 7
"""Patches across the ball."""


def find_ball(
    depth_m: Image,
    camera: CameraCalibration,
    radius_m: float,
    time_s: float,
    background_m: Image | None = None,
) -> BallDetection | None:
    """The ball in a depth image (h, w), 0 = no reading; None where there is none.

    ``background_m`` is the empty booth's (averaged) depth: with it less is searched, and less is
    mistaken for a ball.
    """
    inverse = _inverse(depth_m)
    foreground = inverse > 0.0
    if background_m is not None:
        # 1/z > 1/b + f, where there is a background b at all.
        nearest = background_m / (1.0 + _FOREGROUND * background_m)
        foreground &= (depth_m < nearest) | (background_m == 0.0)
    best: _Fit | None = None
    for start in _candidates(inverse, foreground, camera, radius_m):
        fit = _fit(inverse, camera, start, radius_m)
        if fit is not None and (best is None or fit.unlike(radius_m) < best.unlike(radius_m)):
            best = fit
            if fit.unlike(radius_m) < _ALIKE:
                break
    if best is None:
        return None
    return BallDetection(
        camera=camera.name,
        time_s=time_s,
        center_m=best.center_m,
        covariance_m2=best.covariance_m2,
        points=best.pixels,
        radius_m=best.radius_m,
        radius_sigma_m=best.radius_sigma_m,
        patches=best.patches,
    )


def _inverse(depth_m: Image) -> Image:
    usable = (depth_m > _RANGE_M[0]) & (depth_m < _RANGE_M[1])
    inverse = np.zeros(depth_m.shape, np.float32)
    np.divide(np.float32(1.0), depth_m, out=inverse, where=usable, casting="same_kind")
    return inverse


def _candidates(
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
    smooth = np.where((close >= _LEAST_VOTES) & (alone > 0.0), alone * depths**2, 0.0)
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
        if near.sum() > _LEAST_VOTE_SHARE * whole:
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


@dataclass(frozen=True, slots=True)
class _Fit:
    center_m: Array
    covariance_m2: Array
    pixels: int
    visible: float
    radius_m: float
    radius_sigma_m: float
    patches: Array
    spread: float

    def unlike(self, radius_m: float) -> float:
        """How little this is like the ball that is looked for: heads and fists are round, too."""
        tolerance_m = np.hypot(_RADIUS_SLACK * radius_m, self.radius_sigma_m)
        away = (self.radius_m - radius_m) / tolerance_m
        return float(away**2 + (max(self.spread - 1.0, 0.0) / 0.2) ** 2)


def _fit(inverse: Image, camera: CameraCalibration, start: Array, radius_m: float) -> _Fit | None:
    """The most likely ball near a place, if the pixels say that one is there."""
    center, radius = start.copy(), radius_m
    gate = _START_GATE_M / max(start[2], 0.3) ** 2
    window = _window(camera, center, 1.3 * radius_m)
    if window is None:
        return None
    ray = np.ascontiguousarray(rays(camera)[window])
    part = np.ascontiguousarray(inverse[window])
    # The radius is free until the place is found: a ball of another size shall be told.
    for round_ in range(8):
        normal, pull, used, seen = _normal_equations(part, ray, center, radius, gate, False)
        if used < _LEAST_PIXELS:
            return None
        step = np.linalg.solve(normal, pull)
        center, radius = center + step[:3], radius + step[3]
        if not (
            np.linalg.norm(center - start) < radius_m
            and abs(radius / radius_m - 1.0) < _RADIUS_TOLERANCE
        ):
            return None
        if round_ >= 2:
            gate = max(0.6 * gate, _GATE_SIGMAS * 1.3 * RANDOM_SIGMA)
    for _ in range(_STRAY_ROUNDS):
        clean = np.where(_strays(part, ray, center, radius), np.float32(0.0), part)
        for _ in range(2):
            normal, pull, used, seen = _normal_equations(clean, ray, center, radius, gate, False)
            if used < _LEAST_PIXELS:
                return None
            step = np.linalg.solve(normal, pull)
            center, radius = center + step[:3], radius + step[3]
    free_radius = radius
    radius_sigma = float(np.sqrt(np.linalg.inv(normal)[3, 3]))
    fixed = radius_m if abs(free_radius - radius_m) < 0.1 * radius_m else free_radius
    for _ in range(4):
        normal, pull, used, seen = _normal_equations(clean, ray, center, fixed, gate, True)
        if used < _LEAST_PIXELS:
            return None
        center = center + np.linalg.solve(normal[:3, :3], pull[:3])
    if not _is_ball(part, ray, center, fixed, used, seen):
        return None
    patches, spread = _patches(clean, ray, center, fixed, gate, window, camera)
    if spread > _LARGEST_SPREAD:
        return None
    return _Fit(
        center_m=center,
        covariance_m2=np.linalg.inv(normal[:3, :3]),
        pixels=int(used),
        visible=used / seen,
        radius_m=float(free_radius),
        radius_sigma_m=radius_sigma,
        patches=patches,
        spread=spread,
    )


def _window(camera: CameraCalibration, center: Array, reach_m: float) -> tuple[slice, slice] | None:
    if center[2] < _RANGE_M[0]:
        return None
    u, v = project(camera, center[None])[0]
    reach = reach_m * max(camera.K[0, 0], camera.K[1, 1]) / center[2] + 4
    top, bottom = max(int(v - reach), 0), min(int(v + reach) + 2, camera.height)
    left, right = max(int(u - reach), 0), min(int(u + reach) + 2, camera.width)
    if bottom - top < 8 or right - left < 8:
        return None
    return slice(top, bottom), slice(left, right)


@numba.njit(cache=True, nogil=True)
def _predict(x, y, cx, cy, cz, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Inverse depth of a ball along the ray (x, y, 1), cosine of incidence, and the derivative of
    the inverse depth by centre and radius; cosine 0 where the ray misses.

    |z d - c|^2 = R^2 has the near root 1/z = (B + s) / C with A = d.d, B = d.c, C = c.c - R^2 and
    s^2 = B^2 - A C.
    """
    A = x * x + y * y + 1.0
    B = x * cx + y * cy + cz
    C = cx * cx + cy * cy + cz * cz - radius * radius
    square = B * B - A * C
    if square <= 0.0 or C <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s = np.sqrt(square)
    w = (B + s) / C
    k = B / s
    j = A / s
    gx = (x + k * x - j * cx) / C - 2.0 * w * cx / C
    gy = (y + k * y - j * cy) / C - 2.0 * w * cy / C
    gz = (1.0 + k - j * cz) / C - 2.0 * w * cz / C
    gr = (j * radius) / C + 2.0 * w * radius / C
    return w, s / (np.sqrt(A) * radius), gx, gy, gz, gr


@numba.njit(cache=True, nogil=True)
def _normal_equations(inverse, ray, center, radius, gate, fixed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """J'WJ (4, 4) and J'Wr (4,) of centre and radius, pixels used, pixels that should see it."""
    normal = np.zeros((4, 4))
    pull = np.zeros(4)
    used = 0
    seen = 0
    g = np.empty(4)
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            w, cosine, gx, gy, gz, gr = _predict(
                ray[v, u, 0], ray[v, u, 1], center[0], center[1], center[2], radius
            )
            if cosine < _INCIDENCE_COSINE:
                continue
            seen += 1
            if inverse[v, u] == 0.0:
                continue
            away = inverse[v, u] - w
            ratio = away / gate
            if ratio * ratio >= 1.0:
                continue
            used += 1
            g[0], g[1], g[2], g[3] = gx, gy, gz, gr
            weight = 1.0 / (SQUARE_ERROR / cosine + ROUNDING)
            for i in range(4):
                pull[i] += weight * g[i] * away
                for j in range(4):
                    normal[i, j] += weight * g[i] * g[j]
    if fixed:
        normal[3, 3] += 1e30
    return normal, pull, used, seen


def _strays(part: Image, ray: Image, center: Array, radius: float) -> Mask:
    """Pixels near areas that do not lie on the ball: what touches or covers it.

    A finger stands out of the ball by no more than a few pixels' noise; the mean over its width
    tells it apart. Areas off to either side are left out alike, so that noise cannot pull.
    """
    expected, cosine = _ball_image(ray, center, radius)
    seen = (cosine > _STRAY_COSINE) & (part > 0.0)
    away = np.where(seen, part - expected, 0.0).astype(np.float32)
    away = np.clip(away, -_STRAY_CLIP * RANDOM_SIGMA, _STRAY_CLIP * RANDOM_SIGMA)
    size = (_STRAY_BLUR_PX, _STRAY_BLUR_PX)
    share = cv2.blur(seen.astype(np.float32), size)
    mean = cv2.blur(away, size) / np.maximum(share, 0.2)
    limit = _STRAY_SIGMAS * _STRAY_NOISE * RANDOM_SIGMA / np.sqrt(np.maximum(cosine, 0.2))
    off = seen & (np.abs(mean) > limit)
    return np.asarray(cv2.dilate(off.astype(np.uint8), np.ones(size, np.uint8)) > 0)


@numba.njit(cache=True, nogil=True)
def _ball_image(ray, center, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
    expected = np.zeros(ray.shape[:2])
    cosine = np.zeros(ray.shape[:2])
    for v in range(ray.shape[0]):
        for u in range(ray.shape[1]):
            w, c, _, _, _, _ = _predict(
                ray[v, u, 0], ray[v, u, 1], center[0], center[1], center[2], radius
            )
            expected[v, u], cosine[v, u] = w, c
    return expected, cosine


def _is_ball(part: Image, ray: Image, center: Array, radius: float, used: int, seen: int) -> bool:
    """Enough of it is seen, and around it one sees past it."""
    if used < _LEAST_VISIBLE * seen:
        return False
    away = (
        np.linalg.norm(np.cross(ray, center / np.linalg.norm(center)), axis=-1)
        / np.linalg.norm(ray, axis=-1)
        * np.linalg.norm(center)
    )
    ring = (away > 1.06 * radius) & (away < 1.25 * radius)
    past = part[ring] < 1.0 / (center[2] + 0.3 * radius)
    return bool(ring.any() and past.mean() > _OPEN_RING_SHARE)


def _bilinear(ray: Image, u: Array, v: Array) -> tuple[Array, Array]:
    """Rays (x, y) at places between pixels."""
    left = np.minimum(u.astype(np.int64), ray.shape[1] - 2)
    top = np.minimum(v.astype(np.int64), ray.shape[0] - 2)
    right, down = (u - left)[:, None], (v - top)[:, None]
    found = (1 - down) * ((1 - right) * ray[top, left] + right * ray[top, left + 1]) + down * (
        (1 - right) * ray[top + 1, left] + right * ray[top + 1, left + 1]
    )
    return found[:, 0], found[:, 1]


def _patches(
    part: Image,
    ray: Image,
    center: Array,
    radius: float,
    gate: float,
    window: tuple[slice, slice],
    camera: CameraCalibration,
) -> tuple[Array, float]:
    """Means (k, 4) over a grid on the ball, and how far they scatter in units of the noise.

    A patch's mean inverse depth is the ball's at the patch's middle plus the mean of what the
    pixels deviate from the ball, so that curvature within the patch does not matter.
    """
    expected, cosine = _ball_image(ray, center, radius)
    away = part - expected
    good = (cosine >= _INCIDENCE_COSINE) & (part > 0.0) & (np.abs(away) < gate)
    v, u = np.nonzero(good)
    u0, v0 = project(camera, center[None])[0] - (window[1].start, window[0].start)
    cell_px = 2.0 * 0.9 * radius * camera.K[0, 0] / center[2] / _CELLS
    column = np.clip((u - u0) / cell_px + _CELLS / 2, 0, _CELLS - 1e-6).astype(np.int64)
    row = np.clip((v - v0) / cell_px + _CELLS / 2, 0, _CELLS - 1e-6).astype(np.int64)
    cell = row * _CELLS + column
    size = np.bincount(cell, minlength=_CELLS**2)
    kept = np.flatnonzero(size >= 8)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, values, minlength=_CELLS**2)[kept] / size[kept])

    middle_u, middle_v = mean(u.astype(float)), mean(v.astype(float))
    residual = mean(away[good])
    x, y = _bilinear(ray, middle_u, middle_v)
    at_middle = np.array(
        [
            _predict(xi, yi, center[0], center[1], center[2], radius)[0]
            for xi, yi in zip(x, y, strict=True)
        ]
    )
    variance = mean(SQUARE_ERROR / cosine[good] + ROUNDING) / size[kept]
    patches = np.stack(
        [
            middle_u + window[1].start,
            middle_v + window[0].start,
            at_middle + residual,
            variance,
        ],
        axis=1,
    )
    spread = float(np.sqrt(np.mean(residual**2 / variance))) if len(kept) else np.inf
    return patches, spread
