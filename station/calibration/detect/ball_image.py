"""The depth image of a ball, pixel by pixel, and its derivatives by centre and radius.

A ray (x, y, 1) meets the ball |z d - c|^2 = R^2 first at

    1/z = w = (B + s) / C,   A = d.d,  B = d.c,  C = c.c - R^2,  s^2 = B^2 - A C.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.kinect_v1 import ROUNDING, SQUARE_ERROR

Array = NDArray[np.float64]

INCIDENCE_COSINE = np.cos(np.radians(62.0))
"""Pixels seen at more than 62 degrees of incidence take no part: silhouettes flicker."""
_GRAZING = 1e-4
"""Rays that miss are given the discriminant s^2 = _GRAZING (B R)^2 of a ray that grazes the ball:
a fit that starts off the ball still has a gradient towards it."""


@numba.njit(cache=True, nogil=True)
def _meet(x, y, cx, cy, cz, radius, least_share):  # type: ignore[no-untyped-def]  # pragma: no cover
    """w, s, sqrt(A) and the derivatives of w by cx, cy, cz, R, x, y; s = 0 where the ray misses.

    ``least_share`` bounds s^2 below by that share of (B R)^2.
    """
    A = x * x + y * y + 1.0
    B = x * cx + y * cy + cz
    C = cx * cx + cy * cy + cz * cz - radius * radius
    square = max(B * B - A * C, least_share * B * B * (radius * radius))
    if square <= 0.0 or C <= 0.0:
        return 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s = np.sqrt(square)
    w = (B + s) / C
    k = B / s
    j = A / s
    gx = (x + k * x - j * cx) / C - 2.0 * w * cx / C
    gy = (y + k * y - j * cy) / C - 2.0 * w * cy / C
    gz = (1.0 + k - j * cz) / C - 2.0 * w * cz / C
    gr = (j * radius) / C + 2.0 * w * radius / C
    hx = (cx + k * cx - x * C / s) / C
    hy = (cy + k * cy - y * C / s) / C
    return w, s, np.sqrt(A), gx, gy, gz, gr, hx, hy


@numba.njit(cache=True, nogil=True)
def ray_inverse_depth(x, y, cx, cy, cz, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Inverse depth of a ball along the ray (x, y, 1), cosine of incidence, and the derivative of
    the inverse depth by centre and radius; cosine 0 where the ray misses."""
    w, s, length, gx, gy, gz, gr, _, _ = _meet(x, y, cx, cy, cz, radius, 0.0)
    return w, s / (length * radius), gx, gy, gz, gr


@numba.njit(cache=True, nogil=True)
def _inverse_depths(center, ray, radius, w, gradient):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(ray.shape[0]):
        for k in range(ray.shape[1]):
            found = _meet(
                ray[i, k, 0], ray[i, k, 1], center[i, 0], center[i, 1], center[i, 2], radius,
                _GRAZING,
            )  # fmt: skip
            w[i, k] = found[0]
            for j in range(6):
                gradient[i, k, j] = found[3 + j]


def ball_inverse_depth(center: Array, ray: Array, radius_m: float) -> tuple[Array, Array]:
    """Inverse depths (n, k) of balls with centres (n, 3) along rays (n, k, 2).

    Also the derivatives (n, k, 6) by centre, radius and ray. Rays that miss count as grazing.
    """
    w, gradient = np.empty(ray.shape[:2]), np.empty((*ray.shape[:2], 6))
    _inverse_depths(np.ascontiguousarray(center), np.ascontiguousarray(ray), radius_m, w, gradient)
    return w, gradient


@numba.njit(cache=True, nogil=True)
def normal_equations(inverse, ray, center, radius, gate, fixed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Normal matrix J'WJ (4, 4) and gradient J'Wr (4,) of centre and radius over a depth image.

    Pixels that differ from the ball by more than ``gate`` (1/m) take no part. ``fixed`` holds the
    radius. Also the number of pixels used, and of those that should see the ball.
    """
    normal = np.zeros((4, 4))
    gradient = np.zeros(4)
    used = 0
    seen = 0
    g = np.empty(4)
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            w, cosine, gx, gy, gz, gr = ray_inverse_depth(
                ray[v, u, 0], ray[v, u, 1], center[0], center[1], center[2], radius
            )
            if cosine < INCIDENCE_COSINE:
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
                gradient[i] += weight * g[i] * away
                for j in range(4):
                    normal[i, j] += weight * g[i] * g[j]
    if fixed:
        normal[3, 3] += 1e30
    return normal, gradient, used, seen


@numba.njit(cache=True, nogil=True)
def ball_image(ray, center, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Inverse depth and cosine of incidence (h, w) of a ball along rays (h, w, 3)."""
    expected = np.zeros(ray.shape[:2])
    cosine = np.zeros(ray.shape[:2])
    for v in range(ray.shape[0]):
        for u in range(ray.shape[1]):
            w, c, _, _, _, _ = ray_inverse_depth(
                ray[v, u, 0], ray[v, u, 1], center[0], center[1], center[2], radius
            )
            expected[v, u], cosine[v, u] = w, c
    return expected, cosine
