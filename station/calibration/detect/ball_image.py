"""What a depth image of a ball is, pixel by pixel, and how it changes with centre and radius."""

from __future__ import annotations

import numba
import numpy as np

from station.core.kinect_v1 import ROUNDING, SQUARE_ERROR

INCIDENCE_COSINE = np.cos(np.radians(62.0))
"""Of the least slant at which pixels take part: 62 degrees."""


@numba.njit(cache=True, nogil=True)
def predict(x, y, cx, cy, cz, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
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
def normal_equations(inverse, ray, center, radius, gate, fixed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """J'WJ (4, 4) and J'Wr (4,) of centre and radius, pixels used, pixels that should see it."""
    normal = np.zeros((4, 4))
    pull = np.zeros(4)
    used = 0
    seen = 0
    g = np.empty(4)
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            w, cosine, gx, gy, gz, gr = predict(
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
                pull[i] += weight * g[i] * away
                for j in range(4):
                    normal[i, j] += weight * g[i] * g[j]
    if fixed:
        normal[3, 3] += 1e30
    return normal, pull, used, seen


@numba.njit(cache=True, nogil=True)
def ball_image(ray, center, radius):  # type: ignore[no-untyped-def]  # pragma: no cover
    expected = np.zeros(ray.shape[:2])
    cosine = np.zeros(ray.shape[:2])
    for v in range(ray.shape[0]):
        for u in range(ray.shape[1]):
            w, c, _, _, _, _ = predict(
                ray[v, u, 0], ray[v, u, 1], center[0], center[1], center[2], radius
            )
            expected[v, u], cosine[v, u] = w, c
    return expected, cosine
