"""Moves of cameras as a scan's check estimates them, were depths the same as at the calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import mean_view
from station.calibration.moves.estimate import estimate_move
from station.calibration.moves.motion import CameraMove
from station.calibration.moves.reference import DriftReference
from station.core.kinect_v1 import DEPTH_SCALE_M


def move_in(reference: DriftReference, frames: Sequence[NDArray[np.uint16]]) -> CameraMove:
    """The camera's move from frames (h, w) of one moment."""
    return estimate_move(reference, *mean_view(frames, DEPTH_SCALE_M), len(frames))
