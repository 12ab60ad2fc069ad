"""The live cloud: one frameset as points in the world, to be watched and to see that somebody is
there.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.booth.frameset import Frameset
from station.core.bundle import LEAST_READINGS
from station.core.config import Volume
from station.core.errors import BoothError
from station.core.files import Version, version_of
from station.core.lens import rays
from station.core.rig import Rig
from station.messaging.intake import LiveFrame

_STRIDE_PX = 6
_LOOK_PERIOD_S = 2.0
"""Period of looking for a new calibration."""
_FLOOR_REACH_M = 0.3
"""Height above the floor below which single readings may be the floor's, or shoes left behind."""


def frameset_points(rig: Rig, found: Frameset[LiveFrame]) -> NDArray[np.float32]:
    """Points (n, 3) of every sixth pixel of each camera that the calibration describes, world
    frame, metres.
    """
    clouds = [np.empty((0, 3), np.float32)]
    for name, frame in found.frames.items():
        camera = rig.cameras.get(name)
        if camera is None or frame.depth.shape != (camera.height, camera.width):
            continue
        z = frame.depth[::_STRIDE_PX, ::_STRIDE_PX] * np.float32(frame.header.depth_scale_m)
        seen = z > 0
        points = rays(camera)[::_STRIDE_PX, ::_STRIDE_PX][seen] * z[seen, None]
        pose = camera.world_from_camera
        clouds.append((points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
    return np.concatenate(clouds)


def is_empty(volume: Volume, points: NDArray[np.float32]) -> bool:
    """Whether nobody stands in the volume, by its `frameset_points` (n, 3).

    A reading out of 36 is looked at, so a booth counts as empty at the same density of readings as
    in the reconstruction, which would refuse the scan when the person is gone.
    """
    low, high = np.array(volume.min_m), np.array(volume.max_m)
    low[2] = max(low[2], _FLOOR_REACH_M)
    inside = ((points > low) & (points < high)).all(axis=1)
    return bool(np.count_nonzero(inside) * _STRIDE_PX**2 < LEAST_READINGS)


class LiveCloud:
    """Converts a frameset to a cloud now and then, with the calibration in use if there is one."""

    def __init__(self, calibration: Path, rate_hz: float) -> None:
        self._calibration, self._period_s = calibration, 1.0 / rate_hz
        self._last_s = self._looked_s = -1e9
        self._version: Version | None = None
        self.rig: Rig | None = None

    def points(self, found: Frameset[LiveFrame], now_s: float) -> NDArray[np.float32] | None:
        """The cloud (n, 3) of a frameset, or None if it is not time for one."""
        if now_s - self._last_s < self._period_s:
            return None
        self._last_s = now_s
        if now_s - self._looked_s > _LOOK_PERIOD_S:
            self._looked_s = now_s
            self._look()
        rig = self.rig
        if rig is None:
            return None
        return frameset_points(rig, found)

    def _look(self) -> None:
        """Load the calibration if its file is another one than before."""
        try:
            version = version_of(self._calibration)
            if version != self._version:
                self.rig = Rig.load(self._calibration)
                self._version = version
        except (BoothError, OSError):
            return
