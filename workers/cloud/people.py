"""Counting people in a connected piece: two who touch are one piece with two heads."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELL_M = 0.04
"""Cell size of the height map."""
_CLOSING = np.ones((5, 5), np.uint8)
"""Joins the front and the back of one head, whose crown no camera sees, but not two heads."""
_LOWEST_LEVEL = 0.55
"""Lowest level that is searched for separate heads, as a share of the height."""
_LEVEL_STEP_M = 0.04
_HEAD_M = 0.12
"""Height of a head above the level that joins it to another."""
_APART_M = 0.30
"""Least distance between two people's heads."""
_LAYER_M, _LAYER_POINTS = 0.10, 4
"""Height of the layers below a head, and points that a filled one has."""
_LEGS_FROM_M = 0.15
"""Height above the floor at which the layers begin."""
_FILLED = 0.7
"""Share of filled layers that a body has; a raised hand has none below it."""


def count_people(points: Array) -> int:
    """Number of people in a connected cloud (n, 3), z up, floor at 0.

    People are peaks of the height map that are apart and have a body below them.
    """
    low = points[:, :2].min(axis=0) - 3 * _CELL_M
    cells = ((points[:, :2] - low) / _CELL_M).astype(np.int64)
    top = np.zeros(cells.max(axis=0) + 4)
    np.maximum.at(top, tuple(cells.T), points[:, 2])
    height = float(top.max())
    most = 1
    for level in np.arange(_LOWEST_LEVEL * height, height - _HEAD_M, _LEVEL_STEP_M):
        joined = cv2.dilate((top >= level).astype(np.uint8), _CLOSING)
        # The ground is a piece, too.
        pieces, labels = cv2.connectedComponents(joined, connectivity=4)
        if pieces <= 2:
            continue
        centers = [
            np.argwhere((labels == label) & (top >= level)).mean(axis=0) * _CELL_M
            for label in range(1, pieces)
            if _is_person(labels == label, top, level, cells, points[:, 2])
        ]
        most = max(most, _apart(centers))
    return most


def _is_person(
    piece: Mask, top: Array, level: float, cells: NDArray[np.int64], heights: Array
) -> bool:
    if top[piece].max() < level + _HEAD_M:
        return False
    below = heights[piece[tuple(cells.T)]]
    edges = np.arange(_LEGS_FROM_M, level, _LAYER_M)
    layers, _ = np.histogram(below, edges)
    return bool(np.mean(layers >= _LAYER_POINTS) > _FILLED)


def _apart(centers: list[Array]) -> int:
    """Number of centers (2,) that are farther apart than two people's heads."""
    counted: list[Array] = []
    for center in centers:
        if all(np.linalg.norm(center - other) > _APART_M for other in counted):
            counted.append(center)
    return len(counted)
