"""A depth image for the operator: distance in colours, the person's outline, and everything outside
the volume in grey. Pure."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.config import Volume
from station.core.rig import CameraCalibration

STRIDE_PX = 2
_NEAR_M, _FAR_M = 1.0, 3.4
_FLOOR_M = 0.05
"""Lower than this a person cannot be told from the floor's noise, which is shown as outside."""
_LEVELS = 256
_NO_FOURTH = cv2.COLOR_BGRA2BGR
_SMALLEST_PERSON_PX = 400
_JPEG_QUALITY = 78
_OUTLINE = (255, 255, 255)
_BACKDROP = (46, 36, 30)
"""No reading (blue, green, red)."""


class PictureMaker:
    """One camera's pictures; the rays of its pixels are computed once."""

    def __init__(self, camera: CameraCalibration | None, volume: Volume) -> None:
        """``camera``: None before the booth is calibrated: then everything is coloured."""
        self._volume = volume
        self._camera = camera
        self._rays: NDArray[np.float32] | None = None
        self._offset = np.zeros(3, np.float32)

    def draw(
        self, depth: NDArray[np.uint16], scale_m: float
    ) -> tuple[NDArray[np.uint8], bool | None]:
        """A picture (h / 2, w / 2, 3) in OpenCV's order, and whether somebody is in the volume;
        None before the booth is calibrated."""
        z = depth[::STRIDE_PX, ::STRIDE_PX].astype(np.float32) * np.float32(scale_m)
        known = z > 0
        levels = np.clip((z - _NEAR_M) * (_LEVELS / (_FAR_M - _NEAR_M)), 0, _LEVELS - 1)
        colours = levels.astype(np.uint16)
        person = known if self._camera is None else self._inside(z, known)
        colours[~person] += _LEVELS
        colours[~known] = 2 * _LEVELS
        picture = cv2.cvtColor(_palette()[colours].view(np.uint8).reshape(*z.shape, 4), _NO_FOURTH)
        outline = None if self._camera is None else _outline_of(person)
        if outline is not None:
            picture[outline] = _OUTLINE
        somebody = None if self._camera is None else outline is not None
        return np.asarray(picture, np.uint8), somebody

    def jpeg(self, depth: NDArray[np.uint16], scale_m: float) -> tuple[bytes, bool | None]:
        """The same as JPEG."""
        picture, somebody = self.draw(depth, scale_m)
        _, packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        return packed.tobytes(), somebody

    def _inside(self, z: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of the pixels that see into the volume, above the floor."""
        rays = self._world_rays(z.shape)
        low, high = np.array([self._volume.min_m, self._volume.max_m], np.float32)
        low[2] = max(low[2], _FLOOR_M)
        inside = known.copy()
        for axis in range(3):
            value = rays[axis] * z + self._offset[axis]
            inside &= (value > low[axis]) & (value < high[axis])
        return inside

    def _world_rays(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """(3, h, w): world point = ray * depth + the camera's place."""
        camera = self._camera
        assert camera is not None
        if self._rays is None or self._rays.shape[1:] != shape:
            v, u = np.mgrid[: shape[0], : shape[1]] * STRIDE_PX
            K, pose = camera.K, camera.world_from_camera
            ahead = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(shape)])
            self._rays = np.einsum("ij,jhw->ihw", pose[:3, :3], ahead).astype(np.float32)
            self._offset = pose[:3, 3].astype(np.float32)
        return self._rays


@lru_cache(maxsize=1)
def _palette() -> NDArray[np.uint32]:
    """Colours from near to far, then as many greys, then the backdrop; four bytes each, as one
    number is looked up faster than three."""
    share = np.linspace(0.0, 1.0, _LEVELS)
    levels = (255 - 225 * share).astype(np.uint8)
    table = np.zeros((2 * _LEVELS + 1, 4), np.uint8)
    table[:_LEVELS, :3] = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0]
    table[_LEVELS:-1, :3] = (70 - 25 * share)[:, None]
    table[-1, :3] = _BACKDROP
    return table.view(np.uint32)[:, 0]


def _outline_of(person: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """The edge of the largest thing in the volume; None if it is too small for a person."""
    solid = cv2.morphologyEx(person.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid, connectivity=4)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    if stats[largest, cv2.CC_STAT_AREA] < _SMALLEST_PERSON_PX:
        return None
    mask = (labels == largest).astype(np.uint8)
    return cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).astype(bool)
