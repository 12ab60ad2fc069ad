"""Rims of the hands: oriented points on their silhouettes.

Readings near a silhouette have no normals, so the cloud of a finger is thin and ends a centimetre
before its tip. But they show where the silhouette is, and there the skin turns away from the
camera: its normal is perpendicular to the ray and to the outline (the contour generator of Cipolla
& Blake 1992). With position and normal, these points are used like those of the cloud.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

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
"""Width of the gap without readings at an edge, behind which the background must be seen."""
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
        for vertices in bodies:
            rims.append(_rim(view, vertices))
            cameras.append(camera_names.index(view.name))
    points, normals, sigma_m = (np.concatenate(pieces) for pieces in zip(*rims, strict=True))
    camera = np.repeat(np.array(cameras, np.int16), [len(points) for points, _, _ in rims])
    return PointCloud(points, normals, sigma_m, camera, camera_names)


def _rim(view: CameraView, vertices: Array) -> tuple[Array, Array, Array]:
    """Points (n, 3), normals (n, 3) and standard deviations (n,) in one view."""
    local = transform(invert(view.calibration.world_from_camera), vertices)
    corner, depth = _window(view, local)
    if not depth.size:
        return np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
    nearest, farthest = local[:, 2].min() - _AROUND_M, local[:, 2].max() + _AROUND_M
    # Nearer objects hide the rim: they count as inside, and their own rims are left out.
    inside = ((depth > 0) & (depth < farthest)).astype(np.uint8)
    edge = (inside > cv2.erode(inside, _square(1))) & (depth > nearest)
    edge &= cv2.dilate(depth, _square(_GAP_PX)) - depth > _BEHIND_M
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), _SMOOTH_PX)
    slope_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    slope_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    y, x = np.nonzero(edge)
    outwards = -np.stack([slope_u[y, x], slope_v[y, x]], axis=1).astype(np.float64)
    steep = np.linalg.norm(outwards, axis=1)
    kept = steep > _MIN_SLOPE
    y, x, outwards = y[kept], x[kept], outwards[kept] / steep[kept, None]
    return _lifted(view.calibration, (x, y) + corner[:, None], outwards, depth[y, x])


def _square(reach_px: int) -> NDArray[np.uint8]:
    return np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)


def _window(view: CameraView, local: Array) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
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


def _lifted(
    calibration: CameraCalibration,
    pixels: NDArray[np.intp],
    outwards: Array,
    depth_m: NDArray[np.float32],
) -> tuple[Array, Array, Array]:
    """Oriented points of the world from edge pixels (2, n) and normals (n, 2) of the outline."""
    focal = np.diag(calibration.K)[:2]
    ray = rays(calibration)[pixels[1], pixels[0]].astype(np.float64)
    # The edge is at the outer border of the pixel.
    ray[:, :2] += 0.5 * outwards / focal
    across = outwards * focal
    normals = np.column_stack([across, -np.einsum("ni,ni->n", across, ray[:, :2])])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    pose, z = calibration.world_from_camera, depth_m.astype(np.float64)
    return (
        (ray * z[:, None]) @ pose[:3, :3].T + pose[:3, 3],
        normals @ pose[:3, :3].T,
        _LATERAL_PX * z / focal[0],
    )
