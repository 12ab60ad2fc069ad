"""Stillness of what has to stand still while it is recorded: the empty booth, and the board."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.detections import PlaneObservation
from station.calibration.detect.scene import smoothed, static_view
from station.core.depth.images import inverse_depth
from station.core.errors import CalibrationError

_OFTEN = 0.9
_MOVED_PER_M, _MOVED_SHARE = 0.01, 0.002
"""An empty booth in which more of an image changes by more than that, 1/m, is not empty."""
_SEES_SOMETHING = 0.02
"""Share of an image with steady readings below which a camera is covered."""
_BOARD_PARTS, _BOARD_MOVED_PER_M, _BOARD_MOVED_SHARE = 5, 0.004, 0.25
"""A board more of which differs by more than that between any two parts of the time, 1/m, is not
standing: 12 mm at 1.7 m, 25 at 2.5."""
_BOARD_OFFSETS_PX = np.array([-4, 0, 4])
"""Around the middle of a cell: nine readings that err independently. With one, before a sensor of
twice the noise, up to a third of a standing board seemed to move."""


def check_stillness(name: str, stack: NDArray[np.uint16], scale_m: float) -> None:
    """Compare both halves of a camera's frames (n, h, w) of the empty booth.

    Raises:
        CalibrationError: something moved, or the camera is covered.
    """
    before, after = (static_view(iter(half), scale_m) for half in np.array_split(stack, 2))
    both = (before.share > _OFTEN) & (after.share > _OFTEN)
    if both.mean() < _SEES_SOMETHING:
        raise CalibrationError(
            f"camera {name} sees nothing: take away what covers it and do it again"
        )
    surface, surface_after = (smoothed(v.inverse_depth, v.share)[0] for v in (before, after))
    change = np.abs(surface - surface_after)[both]
    if float(np.mean(change > _MOVED_PER_M)) > _MOVED_SHARE:
        raise CalibrationError(
            f"something moved in front of camera {name}; leave the booth and do it again"
        )


def check_board_stands(board: PlaneObservation, stack: NDArray[np.uint16], scale_m: float) -> None:
    """Compare the middles of the board's cells over time: it may have moved, and come back.

    Args:
        stack: (n, h, w), the frames that it was found in.

    Raises:
        CalibrationError: it moved.
    """
    column, row = np.rint(board.patches[:, :2]).astype(int).T
    rows = (row + _BOARD_OFFSETS_PX[:, None, None]).clip(0, stack.shape[1] - 1)
    columns = (column + _BOARD_OFFSETS_PX[:, None]).clip(0, stack.shape[2] - 1)
    parts = []
    for part in np.array_split(stack, _BOARD_PARTS):
        inverse = inverse_depth(scale_m * part[:, rows, columns]).reshape(-1, len(row))
        count = (inverse > 0.0).sum(axis=0)
        parts.append(np.where(count > 0, inverse.sum(axis=0) / np.maximum(count, 1), np.nan))
    change = np.fmax.reduce(parts) - np.fmin.reduce(parts)
    if float(np.mean(change > _BOARD_MOVED_PER_M)) > _BOARD_MOVED_SHARE:
        raise CalibrationError(
            f"the board moved in front of camera {board.camera}; stand it firmly and do it again"
        )
