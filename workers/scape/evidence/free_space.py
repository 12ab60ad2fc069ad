"""Free space: a pixel that shows the booth bounds the silhouette of the body.

For hair, dark cloth and flanks that give no reading it is the only evidence that there is.
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
"""Least distance of the booth behind the body at that pixel."""
_MARGIN_PX = 1.5
"""The outline itself flickers by so much."""
_DEEPEST_PX = 40.0
"""Farther inside the background something else is wrong: a limb must be found, not pulled."""


@dataclass(frozen=True, slots=True)
class _View:
    camera: CameraView
    inside_px: Image
    """(h, w): distance to the nearest pixel that is not background; 0 elsewhere."""
    slope: tuple[Image, Image]
    """Its derivatives along u and v."""


@dataclass(frozen=True, slots=True)
class Intrusions:
    """Vertices that stand where a camera saw through."""

    vertex: NDArray[np.intp]
    direction: Array
    """(n, 3): unit, out of the body's silhouette."""
    depth_m: Array
    """(n,): how far each would have to go back against it."""


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """The free space of all cameras."""

    views: tuple[_View, ...]

    @classmethod
    def build(cls, views: Sequence[CameraView]) -> FreeSpace:
        with ThreadPoolExecutor(max_workers=2) as pool:
            found = pool.map(_view, views)
            return cls(tuple(found))

    def intrusions(self, poses: Sequence[Array], vertices: Array) -> Intrusions:
        """The vertices (P, 3) among which a camera saw the booth behind, once a camera; world from
        camera (4, 4) as the cameras' corrections have it.
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


def _view(view: CameraView) -> _View:
    inside = cv2.distanceTransform(view.background.astype(np.uint8), cv2.DIST_L2, 3)
    slope_u = cv2.Sobel(inside, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    slope_v = cv2.Sobel(inside, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    return _View(
        view,
        inside.astype(np.float32, copy=False),
        (slope_u.astype(np.float32, copy=False), slope_v.astype(np.float32, copy=False)),
    )


def _intrusions(view: _View, pose: Array, vertices: Array) -> Intrusions:
    camera = view.camera.calibration
    local = transform(invert(pose), vertices)
    pixels = np.rint(np.nan_to_num(project(camera, local), nan=-1.0)).astype(np.int64)
    height, width = view.inside_px.shape
    inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    vertex = np.flatnonzero(inside)
    u, v = pixels[vertex].T
    deep = view.inside_px[v, u]
    behind = view.camera.depth_m[v, u] - local[vertex, 2] > _BEHIND_M
    wrong = behind & (deep > _MARGIN_PX) & (deep < _DEEPEST_PX)
    vertex, u, v, deep = vertex[wrong], u[wrong], v[wrong], deep[wrong]
    slope = np.stack([view.slope[0][v, u], view.slope[1][v, u]], axis=1).astype(np.float64)
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)
    axes = pose[:3, :2]
    return Intrusions(
        vertex,
        slope @ axes.T,
        (deep - _MARGIN_PX) * local[vertex, 2] / camera.K[0, 0],
    )
