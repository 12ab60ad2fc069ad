"""Counting people in a connected piece: two who touch are one piece with two heads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELL_M = 0.04
_CLOSING = np.ones((5, 5), bool)
"""Joins the halves of one head, front and back, whose crown nobody saw; not two heads."""
_LOWEST_LEVEL = 0.55
_LEVEL_STEP_M = 0.04
_HEAD_M = 0.12
"""A head rises so far above what joins it to another."""
_APART_M = 0.30
_LAYER_M = 0.10
_LEGS_FROM_M = 0.15
_FILLED = 0.7
_LAYER_POINTS = 4


def count_people(points: Array) -> int:
    """People in a connected cloud (n, 3), z up, floor at 0: peaks seen from above that stand apart
    and have a body below them, which a raised hand has not."""
    low = points[:, :2].min(axis=0) - 3 * _CELL_M
    cells = ((points[:, :2] - low) / _CELL_M).astype(np.int64)
    top = np.zeros(cells.max(axis=0) + 4)
    np.maximum.at(top, tuple(cells.T), points[:, 2])
    height = float(top.max())
    most = 1
    for level in np.arange(_LOWEST_LEVEL * height, height - _HEAD_M, _LEVEL_STEP_M):
        labels, count = ndimage.label(ndimage.binary_dilation(top >= level, _CLOSING))
        if count < 2:
            continue
        centers = [
            np.argwhere((labels == label) & (top >= level)).mean(axis=0) * _CELL_M
            for label in range(1, count + 1)
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
    """Number of places (2,) that are not beside one that was counted already."""
    counted: list[Array] = []
    for center in centers:
        if all(np.linalg.norm(center - other) > _APART_M for other in counted):
            counted.append(center)
    return len(counted)
