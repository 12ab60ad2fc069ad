"""Rims of the hands: oriented points on their silhouettes.

Readings near a silhouette have no normals, so the cloud of a finger is thin and ends a centimetre
before its tip. But they show where the silhouette is, and there the skin turns away from the
camera: its normal is perpendicular to the ray and to the outline (the contour generator of Cipolla
& Blake 1992). With position and normal, these points are used like those of the cloud.

A camera may see silhouettes narrower than they are, by one pixel or two, and fingers are five
pixels wide. What lies behind a hand begins where the silhouette truly ends: how much wider the gap
between both is than usual says how many pixels this camera loses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import Image
from station.core.geometry import invert, transform
from station.core.lens import project, rays
from station.core.rig import CameraCalibration
from workers.cloud.observed import CameraView, PointCloud

Array = NDArray[np.float64]

_AROUND_PX = 14
_AROUND_M = 0.03
"""Distance from the present body within which readings can belong to it: in the image, in depth."""
_BEHIND_M = 0.04
"""Least distance from a rim to what lies behind it."""
_GAP_PX = 2
"""Reach of an edge, beyond what the camera loses, within which the background must be seen."""
_LINE_PX = np.arange(0.5, 6.01, 0.25)
"""Distances from an edge pixel at which the line outwards is looked at for the background."""
_USUAL_GAP_PX = 1.5
"""Median distance from an edge pixel to the background of cameras that lose nothing: 1.2 to 2.0
around hands, and 2.3 and 3.4 to 3.8 where one and two pixels are lost."""
_LOST_PX = (0.6, 3.0)
"""Least and most that counts as lost."""
_MIN_GAPS = 30
"""Gaps that are needed to tell."""
_SMOOTH_PX = 1.0
"""Standard deviation of the filter that smooths the silhouette."""
_MIN_SLOPE = 0.12
"""Least slope of the smoothed silhouette per pixel: a straight edge has three times as much, a slit
between fingers none."""
_LATERAL_PX = 0.8
"""Standard deviation of an edge in the image (Nguyen, Izadi & Lovell 2012)."""


def rims_of(
    views: Sequence[CameraView], camera_names: tuple[str, ...], bodies: Sequence[Array]
) -> PointCloud:
    """Rims of some bodies in all views.

    Args:
        camera_names: names that the cloud's camera indices refer to.
        bodies: vertices (m, 3) of each body, known to within a few centimetres.

    Returns:
        Points on the rims, with normals that point outwards, perpendicular to the rays, and the
        standard deviations along these normals.
    """
    nothing = np.empty((0, 3))
    rims, cameras = [(nothing, nothing, np.empty(0))], [0]
    for view in views:
        outline = _Outline.joined([_Outline.of(view, vertices) for vertices in bodies])
        rims.append(outline.lifted(view.calibration))
        cameras.append(camera_names.index(view.name))
    points, normals, sigma_m = (np.concatenate(pieces) for pieces in zip(*rims, strict=True))
    camera = np.repeat(np.array(cameras, np.int16), [len(points) for points, _, _ in rims])
    return PointCloud(points, normals, sigma_m, camera, camera_names)


@dataclass(frozen=True, slots=True)
class _Outline:
    """n pixels at the edge of bodies in one view."""

    pixels: NDArray[np.intp]
    """(2, n)."""
    outwards: Array
    """(n, 2): unit normals of the outline in the image."""
    depth_m: Image
    """(n,)."""
    gap_px: Array
    """(n,): distance outwards to the first reading of what lies behind; NaN where none is near."""
    reach_px: NDArray[np.intp]
    """(n,): least reach of a square around the pixel that has such a reading."""

    @classmethod
    def of(cls, view: CameraView, vertices: Array) -> _Outline:
        """The outline of a body (m, 3) in a view."""
        local = transform(invert(view.calibration.world_from_camera), vertices)
        corner, depth = _window(view, local)
        if not depth.size:
            none = np.empty(0, np.intp)
            return cls(none[None].repeat(2, 0), np.empty((0, 2)), depth.ravel(), np.empty(0), none)
        nearest, farthest = local[:, 2].min() - _AROUND_M, local[:, 2].max() + _AROUND_M
        # Nearer objects hide the rim: they count as inside, and their own rims are left out.
        inside = ((depth > 0) & (depth < farthest)).astype(np.uint8)
        edge = (inside > cv2.erode(inside, _square(1))) & (depth > nearest)
        smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), _SMOOTH_PX)
        slope_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
        slope_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
        y, x = np.nonzero(edge)
        outwards = -np.stack([slope_u[y, x], slope_v[y, x]], axis=1).astype(np.float64)
        steep = np.linalg.norm(outwards, axis=1)
        kept = steep > _MIN_SLOPE
        y, x, outwards = y[kept], x[kept], outwards[kept] / steep[kept, None]
        pixels = np.stack([x, y])
        gap_px, reach_px = _gap_px(depth, pixels, outwards), _reach_px(depth, pixels)
        return cls(pixels + corner[:, None], outwards, depth[y, x], gap_px, reach_px)

    @classmethod
    def joined(cls, outlines: Sequence[_Outline]) -> _Outline:
        """All pixels of several outlines."""
        return cls(
            np.concatenate([one.pixels for one in outlines], axis=1),
            np.concatenate([one.outwards for one in outlines]),
            np.concatenate([one.depth_m for one in outlines]),
            np.concatenate([one.gap_px for one in outlines]),
            np.concatenate([one.reach_px for one in outlines]),
        )

    @property
    def lost_px(self) -> float:
        """Width of the strip that this camera loses of silhouettes."""
        gaps = self.gap_px[np.isfinite(self.gap_px)]
        if len(gaps) < _MIN_GAPS:
            return 0.0
        least, most = _LOST_PX
        lost_px = float(np.median(gaps)) - _USUAL_GAP_PX
        return min(lost_px, most) if lost_px >= least else 0.0

    def lifted(self, calibration: CameraCalibration) -> tuple[Array, Array, Array]:
        """Oriented points of the world (n, 3), normals (n, 3) and standard deviations (n,)."""
        lost_px = self.lost_px
        used = self.reach_px <= _GAP_PX + round(lost_px)
        pixels, outwards = self.pixels[:, used], self.outwards[used]
        z = self.depth_m[used].astype(np.float64)
        focal = np.diag(calibration.K)[:2]
        ray = rays(calibration)[pixels[1], pixels[0]].astype(np.float64)
        # The edge is at the outer border of the last pixel, seen or lost.
        ray[:, :2] += (0.5 + lost_px) * outwards / focal
        across = outwards * focal
        normals = np.column_stack([across, -np.einsum("ni,ni->n", across, ray[:, :2])])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        pose = calibration.world_from_camera
        return (
            (ray * z[:, None]) @ pose[:3, :3].T + pose[:3, 3],
            normals @ pose[:3, :3].T,
            _LATERAL_PX * z / focal[0],
        )


def _gap_px(depth: Image, pixels: NDArray[np.intp], outwards: Array) -> Array:
    """Distances (n,) from pixels (2, n) along directions (n, 2) to the first reading behind."""
    height, width = depth.shape
    x, y = np.rint(pixels[:, None] + outwards.T[:, None] * _LINE_PX[:, None]).astype(np.intp)
    within = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    readings = depth[y.clip(0, height - 1), x.clip(0, width - 1)]
    behind = within & (readings - depth[pixels[1], pixels[0]] > _BEHIND_M)
    return np.where(behind.any(axis=0), _LINE_PX[behind.argmax(axis=0)], np.nan)


def _reach_px(depth: Image, pixels: NDArray[np.intp]) -> NDArray[np.intp]:
    """(n,): least reach of a square around pixels (2, n) that has a reading behind."""
    most = _GAP_PX + round(_LOST_PX[1])
    reach_px, (x, y) = np.full(pixels.shape[1], most + 1), pixels
    for reach in range(most, 0, -1):
        behind = cv2.dilate(depth, _square(reach)) - depth > _BEHIND_M
        reach_px[behind[y, x]] = reach
    return reach_px


def _square(reach_px: int) -> NDArray[np.uint8]:
    return np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)


def _window(view: CameraView, local: Array) -> tuple[NDArray[np.intp], Image]:
    """Corner (u, v) and depths of the image around vertices (m, 3) in the camera's frame.

    Empty where a vertex is behind the camera.
    """
    pixels = project(view.calibration, local)
    if np.isnan(pixels).any():
        return np.zeros(2, np.intp), view.depth_m[:0]
    height, width = view.depth_m.shape
    around = np.stack([pixels.min(axis=0) - _AROUND_PX, pixels.max(axis=0) + _AROUND_PX])
    (left, top), (right, bottom) = np.clip(around, 0, (width, height)).astype(np.intp)
    return np.array([left, top]), view.depth_m[top:bottom, left:right]
