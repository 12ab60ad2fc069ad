"""Height of a booth's floor against the calibrated one: a mat lies on it, or cameras sank."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from station.core.config import Volume
from station.core.depth.images import Image
from station.core.geometry import transform
from station.core.lens import rays
from station.core.rig import CameraCalibration
from workers.cloud.observed import LOWERED_FLOOR, RAISED_FLOOR, Finding, PointCloud

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NEAR_FLOOR_M, _LEVEL_COSINE, _FLOOR_CELL_M, _RAISED_FLOOR_M2 = 0.04, 0.9, 0.02, 0.05
"""Height and normals of a mat, and its least area in cells of this size: toes cover up to 0.016 m2
in 14 sound scans and 0.022 in the demo's, what noise lifts of an 8 mm mat above the clearance 0.2.
"""
_RAISED_NOISE_M = 0.006
"""Height above the middle of a mat's points up to which there are others."""
_FLOOR_STRIDE, _FLOOR_BAND_M, _FLOOR_READINGS = 4, 0.06, 1000
"""Every so many rows and columns are looked at for the floor, readings so near to z = 0 are it, and
how many of them say where it is."""
_LOWERED_FLOOR_M = -0.006
"""Median height of the floor's readings below which it is not the calibrated one: 0.5 to 3.1 mm
in 36 sound scans."""


def floor_heights(calibration: CameraCalibration, depth_m: Image, volume: Volume) -> Array:
    """Heights of some of the readings near the floor."""
    some = np.s_[::_FLOOR_STRIDE, ::_FLOOR_STRIDE]
    low, high = np.array(volume.min_m), np.array(volume.max_m)
    low[2], high[2] = -_FLOOR_BAND_M, _FLOOR_BAND_M
    directions, depths = rays(calibration)[some], depth_m[some]
    points = (directions * depths[..., None])[depths > 0.0]
    places = transform(calibration.world_from_camera, points)
    return np.asarray(places[((places > low) & (places < high)).all(axis=1), 2])


def lowered_floor(heights_m: Sequence[Array]) -> list[Finding]:
    """The finding that the floor lies lower than the calibrated one, where it does."""
    readings_m = np.concatenate(heights_m)
    if len(readings_m) < _FLOOR_READINGS:
        return []
    level_m = float(np.median(readings_m))
    if level_m > _LOWERED_FLOOR_M:
        return []
    message = (
        f"the floor lies {-1e3 * level_m:.0f} mm lower than at the calibration; run: station check"
    )
    return [Finding(LOWERED_FLOOR, None, level_m, message)]


def raised_floor(cloud: PointCloud) -> tuple[Mask, list[Finding]]:
    """Points (n,) of what people stand on, and the finding that it lies higher than the calibrated
    floor, where it does."""
    height_m = cloud.points[:, 2]
    low = (height_m < _NEAR_FLOOR_M) & (cloud.normals[:, 2] > _LEVEL_COSINE)
    cells = np.unique(np.floor(cloud.points[low, :2] / _FLOOR_CELL_M), axis=0)
    if len(cells) * _FLOOR_CELL_M**2 < _RAISED_FLOOR_M2:
        return low, []
    message = (
        "the floor lies higher than at the calibration: take mats away, or calibrate with them"
    )
    level_m = float(np.median(height_m[low]))
    return height_m < level_m + _RAISED_NOISE_M, [Finding(RAISED_FLOOR, None, level_m, message)]
