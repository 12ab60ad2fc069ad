"""Samples that lie far from each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def farthest_first(
    points: Array, count: int, *, start: int = 0, reach: Array | float = 1.0
) -> NDArray[np.int64]:
    """Indices (count,) of points (n, 3), each the farthest from those before it.

    Args:
        start: the first one.
        reach: (n,) factors of the distances; small ones make points wait.
    """
    chosen = np.empty(count, np.int64)
    distance = np.full(len(points), np.inf)
    current = start
    for index in range(count):
        chosen[index] = current
        np.minimum(distance, np.linalg.norm(points - points[current], axis=1), out=distance)
        current = int(np.argmax(distance * reach))
    return chosen
