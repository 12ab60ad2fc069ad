"""Free space: pixels that show the booth bound the body's silhouette.

For hair, dark cloth and flanks that give no readings this is the only evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.geometry import invert, transform
from station.core.lens import project
from workers.cloud.observed import CameraView

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_BEHIND_M = 0.08
"""Least distance from the body to the booth behind it."""
_MARGIN_PX = 1.5
"""Flicker of the outline, which does not count."""
_DEEPEST_PX = 40.0
"""Distance from the outline beyond which a vertex is not moved: the limb is elsewhere."""
_SEEN_THROUGH_PX = 6.0
"""Depth in the background from which a vertex is not there: outlines of coarse fits lie nearer."""
_MIN_SLOPE = 1e-6


@dataclass(frozen=True, slots=True)
class _View:
    camera: CameraView
    inside_px: Image
    """(h, w): distance to the nearest pixel that is not background; 0 elsewhere."""
    slope: tuple[Image, Image]
    """Derivatives of `inside_px` along u and v."""


@dataclass(frozen=True, slots=True)
class Intrusions:
    """Vertices at pixels where a camera saw the booth behind them."""

    vertex: NDArray[np.intp]
    direction: Array
    """(n, 3): unit vectors out of the body's silhouette."""
    depth_m: Array
    """(n,): distance by which each has to move in the opposite direction."""


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """Background of all cameras."""

    views: tuple[_View, ...]

    @classmethod
    def build(cls, views: Sequence[CameraView]) -> FreeSpace:
        with ThreadPoolExecutor(max_workers=2) as pool:
            found = pool.map(_view, views)
            return cls(tuple(found))

    def intrusions(self, poses: Sequence[Array], vertices: Array) -> Intrusions:
        """Intruding vertices of a body, once for each camera.

        Args:
            poses: corrected world_from_camera (4, 4) of each camera.
            vertices: (P, 3).
        """
        found = [
            _intrusions(view, pose, vertices) for view, pose in zip(self.views, poses, strict=True)
        ]
        if not found:
            return Intrusions(np.empty(0, np.intp), np.empty((0, 3)), np.empty(0))
        return Intrusions(
            np.concatenate([one.vertex for one in found]),
            np.concatenate([one.direction for one in found]),
            np.concatenate([one.depth_m for one in found]),
        )

    def seen_through(self, poses: Sequence[Array], vertices: Array) -> NDArray[np.bool_]:
        """Mask of the vertices (P, 3) where a camera saw the booth behind them, however deep in the
        background."""
        found = np.zeros(len(vertices), bool)
        for view, pose in zip(self.views, poses, strict=True):
            vertex, _, deep, _ = _before_background(view, pose, vertices)
            found[vertex[deep > _SEEN_THROUGH_PX]] = True
        return found


def _view(view: CameraView) -> _View:
    inside = cv2.distanceTransform(view.background.astype(np.uint8), cv2.DIST_L2, 3)
    slope_u = cv2.Sobel(inside, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    slope_v = cv2.Sobel(inside, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return _View(
        view,
        inside.astype(np.float32, copy=False),
        (slope_u.astype(np.float32, copy=False), slope_v.astype(np.float32, copy=False)),
    )


def _before_background(
    view: _View, pose: Array, vertices: Array
) -> tuple[NDArray[np.intp], NDArray[np.int64], Image, Array]:
    """Vertices (n,) well before the booth that a pixel shows: their pixels (n, 2), the pixels'
    distances (n,) from all that is not background, and the vertices' depths (n,)."""
    camera = view.camera.calibration
    local = transform(invert(pose), vertices)
    pixels = np.rint(np.nan_to_num(project(camera, local), nan=-1.0)).astype(np.int64)
    height, width = view.inside_px.shape
    inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    vertex = np.flatnonzero(inside)
    u, v = pixels[vertex].T
    behind = view.camera.depth_m[v, u] - local[vertex, 2] > _BEHIND_M
    vertex = vertex[behind]
    return vertex, pixels[vertex], view.inside_px[v, u][behind], local[vertex, 2]


def _intrusions(view: _View, pose: Array, vertices: Array) -> Intrusions:
    vertex, pixels, deep, depth_m = _before_background(view, pose, vertices)
    # What is beyond the image is unknown. Of an arm of which the border shows nothing, the nearest
    # pixel that is not background can be a decimetre along the border.
    beyond = np.minimum(pixels + 1, np.array(view.inside_px.shape[::-1]) - pixels).min(axis=1)
    wrong = (deep > _MARGIN_PX) & (deep < _DEEPEST_PX) & (deep <= beyond)
    vertex, (u, v), deep, depth_m = vertex[wrong], pixels[wrong].T, deep[wrong], depth_m[wrong]
    slope = np.stack([view.slope[0][v, u], view.slope[1][v, u]], axis=1).astype(np.float64)
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), _MIN_SLOPE)
    axes = pose[:3, :2]
    return Intrusions(
        vertex,
        slope @ axes.T,
        (deep - _MARGIN_PX) * depth_m / view.camera.calibration.K[0, 0],
    )
