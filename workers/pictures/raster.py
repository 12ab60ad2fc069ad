"""Triangles to pixels: a depth buffer (numba, one thread: the same input gives the same bits).

Every pixel is sampled at the middles of its four quarters, so that outlines are smooth.
"""

from __future__ import annotations

import numba
import numpy as np

FINER = 2
"""Samples a pixel along each axis."""


@numba.njit(cache=True, nogil=True)
def nearest_triangles(u, v, depth, shade, faces, height, width):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Rasterise triangles: at each sample the depth (infinite where nothing is), the triangle
    (-1) and the shade there, each (FINER height, FINER width).

    Args:
        u, v: (P,) where vertices lie in the picture; a pixel's middle is at whole numbers.
        depth, shade: (P,), linear over each triangle.
        faces: (K, 3), counter-clockwise seen from outside; those seen from behind are left out.
    """
    rows, columns = FINER * height, FINER * width
    nearest = np.full((rows, columns), np.float32(np.inf))
    triangle = np.full((rows, columns), np.int32(-1))
    shown = np.zeros((rows, columns), np.float32)
    shift = 0.5 * (FINER - 1)
    for k in range(len(faces)):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        ua, va = FINER * u[a] + shift, FINER * v[a] + shift
        ub, vb = FINER * u[b] + shift, FINER * v[b] + shift
        uc, vc = FINER * u[c] + shift, FINER * v[c] + shift
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if area >= 0.0:  # seen from behind, or from the side
            continue
        # The weights of the second and third corner, linear in column and row.
        across2, down2 = (vc - va) / area, (ua - uc) / area
        across3, down3 = (va - vb) / area, (ub - ua) / area
        top = max(0, int(np.ceil(min(va, vb, vc))))
        bottom = min(rows - 1, int(np.floor(max(va, vb, vc))))
        left = max(0, int(np.ceil(min(ua, ub, uc))))
        right = min(columns - 1, int(np.floor(max(ua, ub, uc))))
        for row in range(top, bottom + 1):
            start2, start3 = down2 * (row - va), down3 * (row - va)
            for column in range(left, right + 1):
                second = across2 * (column - ua) + start2
                third = across3 * (column - ua) + start3
                first = 1.0 - second - third
                if first < 0.0 or second < 0.0 or third < 0.0:
                    continue
                away = first * depth[a] + second * depth[b] + third * depth[c]
                if away < nearest[row, column]:
                    nearest[row, column] = away
                    triangle[row, column] = k
                    shown[row, column] = first * shade[a] + second * shade[b] + third * shade[c]
    return nearest, triangle, shown


@numba.njit(cache=True, nogil=True)
def blended(nearest, triangle, shown, colors, background):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The picture (h, w, 3) and its depth (h, w), from the output of `nearest_triangles`.

    Args:
        colors: (K, 3) of the triangles, or (1, 3) of all of them.
        background: value of a sample that no triangle covers, in each channel.
    """
    height, width = nearest.shape[0] // FINER, nearest.shape[1] // FINER
    picture = np.empty((height, width, 3), np.uint8)
    depth = np.empty((height, width), np.float32)
    every = len(colors) == 1
    for row in range(height):
        for column in range(width):
            blue, green, red, least = 0.0, 0.0, 0.0, np.float32(np.inf)
            for i in range(FINER * row, FINER * row + FINER):
                for j in range(FINER * column, FINER * column + FINER):
                    seen = triangle[i, j]
                    if seen < 0:
                        blue += background
                        green += background
                        red += background
                        continue
                    own = 0 if every else seen
                    blue += shown[i, j] * colors[own, 0]
                    green += shown[i, j] * colors[own, 1]
                    red += shown[i, j] * colors[own, 2]
                    least = min(least, nearest[i, j])
            share = 1.0 / FINER**2
            picture[row, column, 0] = np.uint8(min(255.0, share * blue + 0.5))
            picture[row, column, 1] = np.uint8(min(255.0, share * green + 0.5))
            picture[row, column, 2] = np.uint8(min(255.0, share * red + 0.5))
            depth[row, column] = least
    return picture, depth
