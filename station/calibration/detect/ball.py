"""Finding a ball of known radius in one depth image: its centre and covariance.

Coarse: pixels vote for its place (``ball_votes``). Fine: maximum likelihood over all pixels that
see the ball at less than a limit of incidence, in inverse depth along each pixel's own ray. Which
pixels take part depends on where the ball is and not on what they read, and the flickering
silhouette is left out, so the centre is free of the biases that fits of orthogonal distance have.
Hands that hold the ball are left out (``ball_hands``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.ball_hands import beside_gaps, hand_pixels, surroundings
from station.calibration.detect.ball_image import (
    INCIDENCE_COSINE,
    ball_image,
    normal_equations,
    ray_inverse_depth,
)
from station.calibration.detect.ball_votes import candidates
from station.calibration.detect.detections import BallDetection
from station.core.kinect_v1 import RANDOM_SIGMA, ROUNDING, SQUARE_ERROR
from station.core.lens import project, rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_RANGE_M = (0.5, 3.5)
_FOREGROUND = 0.02
"""Inverse depth by which something stands before the background, 1/m: 58 mm at 1.7 m."""
_START_GATE_M = 0.03
_GATE_SIGMAS = 3.5
_STRAY_ROUNDS = 4
_MIN_PIXELS = 150
_MIN_VISIBLE = 0.45
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
    *,
    held: bool = True,
) -> BallDetection | None:
    """The ball in a depth image (h, w), 0 = no reading; None where there is none.

    ``background_m`` is the empty booth's (averaged) depth: with it less is searched, and less is
    mistaken for a ball. ``held``: fingers may lie on the ball.
    """
    inverse = _inverse(depth_m)
    foreground = inverse > 0.0
    if background_m is not None:
        # 1/z > 1/b + f, where there is a background b at all.
        nearest = background_m / (1.0 + _FOREGROUND * background_m)
        foreground &= (depth_m < nearest) | (background_m == 0.0)
    best: _Fit | None = None
    for start in candidates(inverse, foreground, camera, radius_m):
        fit = _fit(inverse, camera, start, radius_m, held)
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


@dataclass(frozen=True, slots=True)
class _Fit:
    center_m: Array
    covariance_m2: Array
    pixels: int
    radius_m: float
    radius_sigma_m: float
    patches: Array
    spread: float

    def unlike(self, radius_m: float) -> float:
        """Dissimilarity from the ball that is searched for: heads and fists are round, too."""
        tolerance_m = np.hypot(_RADIUS_SLACK * radius_m, self.radius_sigma_m)
        away = (self.radius_m - radius_m) / tolerance_m
        return float(away**2 + (max(self.spread - 1.0, 0.0) / 0.2) ** 2)


def _fit(
    inverse: Image, camera: CameraCalibration, start: Array, radius_m: float, held: bool
) -> _Fit | None:
    """The most likely ball near a place, if the pixels say that one is there."""
    center, radius = start.copy(), radius_m
    gate = _START_GATE_M / max(start[2], 0.3) ** 2
    window = _window(camera, center, 1.3 * radius_m)
    if window is None:
        return None
    ray = np.ascontiguousarray(rays(camera)[window])
    part = np.ascontiguousarray(inverse[window])
    # The radius is free until the centre is found, so that a ball of another size is detected.
    for round_ in range(8):
        normal, pull, used, seen = normal_equations(part, ray, center, radius, gate, False)
        if used < _MIN_PIXELS:
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
        off = hand_pixels(part, camera, ray, center, radius, radius_m, gate)
        if held:
            off |= beside_gaps(part, camera, ray, center, radius_m)
        clean = np.where(off, np.float32(0.0), part)
        for _ in range(2):
            normal, pull, used, seen = normal_equations(clean, ray, center, radius, gate, False)
            if used < _MIN_PIXELS:
                return None
            step = np.linalg.solve(normal, pull)
            center, radius = center + step[:3], radius + step[3]
    free_radius = radius
    radius_sigma = float(np.sqrt(np.linalg.inv(normal)[3, 3]))
    fixed = radius_m if abs(free_radius - radius_m) < 0.1 * radius_m else free_radius
    for _ in range(4):
        normal, pull, used, seen = normal_equations(clean, ray, center, fixed, gate, True)
        if used < _MIN_PIXELS:
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


def _is_ball(part: Image, ray: Image, center: Array, radius: float, used: int, seen: int) -> bool:
    """True if enough of it is visible and the surroundings are farther away than its rim."""
    if used < _MIN_VISIBLE * seen:
        return False
    ring, beyond = surroundings(part, ray, center, radius)
    return bool(ring.any() and beyond[ring].mean() > _OPEN_RING_SHARE)


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
    expected, cosine = ball_image(ray, center, radius)
    away = part - expected
    good = (cosine >= INCIDENCE_COSINE) & (part > 0.0) & (np.abs(away) < gate)
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
            ray_inverse_depth(xi, yi, center[0], center[1], center[2], radius)[0]
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
