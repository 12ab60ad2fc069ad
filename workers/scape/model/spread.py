"""Evenly spread samples of points."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def farthest_first(
    points: Array, count: int, *, start: int = 0, reach: Array | float = 1.0
) -> NDArray[np.int64]:
    """Indices (count,) of points (n, 3), each the farthest from those before it.

    Args:
        start: index of the first one.
        reach: (n,), factors of the distances; points with small ones are taken later.
    """
    reaches = np.broadcast_to(np.asarray(reach, np.float64), len(points))
    return np.asarray(_farthest_first(points, count, start, np.ascontiguousarray(reaches)))


@numba.njit(cache=True)
def _farthest_first(points, count, start, reaches):  # type: ignore[no-untyped-def]  # pragma: no cover
    chosen = np.empty(count, np.int64)
    distance = np.full(len(points), np.inf)
    current = start
    for index in range(count):
        chosen[index] = current
        here = points[current]
        most = -1.0
        for p in range(len(points)):
            x, y, z = points[p, 0] - here[0], points[p, 1] - here[1], points[p, 2] - here[2]
            distance[p] = min(distance[p], np.sqrt(x * x + y * y + z * z))
            if distance[p] * reaches[p] > most:
                most, current = distance[p] * reaches[p], p
    return chosen
