"""The live cloud: one frameset as points in the world, for watching only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from station.core.lens import rays
from station.core.rig import Rig

_STRIDE_PX = 6


def merged_points(
    rig: Rig, depths: Mapping[str, NDArray[np.uint16]], scale_m: float
) -> NDArray[np.float32]:
    """Points (n, 3) of every sixth pixel of each camera, world frame, metres."""
    clouds = []
    for name, depth in depths.items():
        camera = rig.cameras[name]
        z = depth[::_STRIDE_PX, ::_STRIDE_PX] * np.float32(scale_m)
        v, u = np.nonzero(z)
        distance = z[v, u]
        points = rays(camera)[v * _STRIDE_PX, u * _STRIDE_PX] * distance[:, None]
        pose = camera.world_from_camera
        clouds.append((points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
    return np.concatenate(clouds) if clouds else np.empty((0, 3), np.float32)
