"""The live cloud: one frameset as points in the world, for watching only."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.booth.frameset import Frameset
from station.core.errors import BoothError
from station.core.lens import rays
from station.core.rig import Rig
from station.messaging.intake import LiveFrame

_STRIDE_PX = 6
_LOOK_PERIOD_S = 2.0
"""Period of looking for a new calibration."""


def merged_points(
    rig: Rig, depths: Mapping[str, NDArray[np.uint16]], scale_m: float
) -> NDArray[np.float32]:
    """Points (n, 3) of every sixth pixel of each camera, world frame, metres."""
    clouds = []
    for name, depth in depths.items():
        camera = rig.cameras[name]
        z = depth[::_STRIDE_PX, ::_STRIDE_PX] * np.float32(scale_m)
        seen = z > 0
        points = rays(camera)[::_STRIDE_PX, ::_STRIDE_PX][seen] * z[seen, None]
        pose = camera.world_from_camera
        clouds.append((points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
    return np.concatenate(clouds) if clouds else np.empty((0, 3), np.float32)


class LiveCloud:
    """Converts a frameset to a cloud now and then, with the calibration in use if there is one."""

    def __init__(self, calibration: Path, rate_hz: float) -> None:
        self._calibration, self._period_s = calibration, 1.0 / rate_hz
        self._last_s = self._looked_s = -1e9
        self._file = (0, 0)
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
        frames = {name: frame for name, frame in found.frames.items() if name in rig.cameras}
        fitting = {
            name: frame.depth
            for name, frame in frames.items()
            if frame.depth.shape == (rig.cameras[name].height, rig.cameras[name].width)
        }
        scale_m = next(iter(found.frames.values())).header.depth_scale_m
        return merged_points(rig, fitting, scale_m)

    def _look(self) -> None:
        """Load the calibration if its file is another one than before."""
        try:
            status = self._calibration.stat()
            file = status.st_ino, status.st_mtime_ns
            if file != self._file:
                self.rig = Rig.load(self._calibration)
                self._file = file
        except (BoothError, OSError):
            return
