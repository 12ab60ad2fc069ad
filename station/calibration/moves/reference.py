"""A camera's stored view of the empty booth, prepared for comparisons.

Samples on a grid: smooth surfaces and outlines, the change of each by a move of the camera, and by
what is no move: warmth, silhouettes that lose other pixels than before, surfaces that bulge.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import SMOOTHING_PX, StaticView, smoothed
from station.core.depth.images import Image
from station.core.geometry import skew
from station.core.lens import rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

COMMON, LOCAL = 4, 4
"""Numbers of common and of local disturbances."""
_STRIDE_PX = 8
"""Samples this far apart, after smoothing, are nearly independent."""
BLOCK = 10
"""Samples along a side of a block, over which local disturbances are shared: 80 px, the shortest
waves of a sensor's bias."""
_SLOPE_PX = 15.0
"""Slopes of smooth surfaces are those of planes fitted over this width: noise in them would pass
for structure."""
_EDGE_PER_M_PX = 0.008
"""A steeper slope, 1/m per pixel, is an outline: a floor seen at a grazing angle has 0.003."""
_GRADUAL, _SHARPER = 4.0, 2.0
"""An outline is steeper than the picture smoothed so many times wider by at least this factor;
a floor that fades out at a grazing angle is not, and it does not move with the picture."""
_NOTHING = 1.2
"""Behind an outline is nothing, rather than another surface, up to this ratio of the same two."""
_DEEPEST = 8.0
"""Largest ratio of the gap between an object and the wall to the step from one to the other."""
_OFTEN = 0.4
"""A surface is used where this share of the frames has a reading."""
_EDGE_REACH_PX = 7
_FARTHEST_OUTLINE_M = 4.0
"""Farther surfaces end where the sensor's range ends, which is not an outline."""


@dataclass(frozen=True, slots=True)
class DriftReference:
    """A camera's stored background, prepared for comparisons."""

    camera: CameraCalibration
    frames: int
    rows: NDArray[np.intp]
    """(r, c) pixel rows of the samples."""
    columns: NDArray[np.intp]
    image: Array
    """(r, c) smoothed inverse depth."""
    outline: Mask
    """(r, c): where depth jumps; no reading counts as 0 there."""
    usable: Mask
    """(r, c)"""
    noise: Array
    """(r, c) of one frame."""
    jacobian: Array
    """(r, c, 6): d image / d xi."""
    points: Array
    """(r, c, 3) of the surface that moves there, camera frame."""
    visible: Array
    """(r, c): share of it in the smoothed pixel."""
    steepness: Array
    """(r, c): the steepest slope of the image around, 1/m per pixel."""
    common: Array
    """(r, c, COMMON): change of the image by a shift of all inverse depths (1/m), by their relative
    gain, and by silhouettes that lose one pixel more: against nothing, and against a surface."""
    local: Array
    """(r, c, LOCAL): change of the image by a shift of a block's inverse depths (1/m), by a shift
    of its outlines along the rows and the columns, and by their growth (pixels)."""
    block: NDArray[np.intp]
    """(r, c): number of the block."""

    @classmethod
    def prepare(cls, camera: CameraCalibration, view: StaticView) -> DriftReference:
        """Find outlines, slopes and sensitivities of a stored view."""
        surface, with_gaps = smoothed(view.inverse_depth, view.share)
        steep = _slope(with_gaps)
        reach = np.ones((2 * _EDGE_REACH_PX + 1,) * 2, np.uint8)
        outline = cv2.dilate(_edges(steep, with_gaps).astype(np.uint8), reach).astype(bool)
        calm = (view.share > _OFTEN) & ~outline
        image = np.where(outline, with_gaps, surface)
        slope = np.where(outline[..., None], steep, plane_slopes(surface, calm))
        nearest = np.where(outline, cv2.dilate(surface, reach), surface)
        usable = calm | (outline & (nearest > 1.0 / _FARTHEST_OUTLINE_M))
        half = _STRIDE_PX // 2
        at = rows, columns = tuple(
            np.mgrid[half : camera.height : _STRIDE_PX, half : camera.width : _STRIDE_PX]
        )
        inverse = np.maximum(nearest[at].astype(np.float64), 0.05)
        points = rays(camera)[at] / inverse[..., None]
        visible = np.minimum(image[at] / inverse, 1.0)
        steepness = np.hypot(slope[..., 0], slope[..., 1])
        height, width = rows.shape
        block = np.arange(height)[:, None] // BLOCK * width + np.arange(width) // BLOCK
        across = np.ones((4 * _EDGE_REACH_PX + 1,) * 2, np.uint8)
        step = cv2.dilate(with_gaps, across) - cv2.erode(with_gaps, across)
        gap = np.clip(nearest / np.maximum(step, 1e-3), 1.0, _DEEPEST)
        common, local = _disturbances(image[at], visible, outline[at], steep[at], gap[at])
        return cls(
            camera=camera,
            frames=view.frames,
            rows=rows,
            columns=columns,
            image=image[at].astype(np.float64),
            outline=outline[at],
            usable=usable[at],
            noise=np.where(outline, view.outline_noise, view.noise)[at].astype(np.float64),
            jacobian=_jacobian(camera, points, visible, slope[at].astype(np.float64)),
            points=points,
            visible=visible,
            steepness=np.asarray(cv2.dilate(steepness, reach)[at], np.float64),
            common=common,
            local=local,
            block=block.astype(np.intp),
        )


def _edges(steep: Image, with_gaps: Image) -> Mask:
    sharpness = np.hypot(steep[..., 0], steep[..., 1])
    wider = cv2.GaussianBlur(with_gaps, (0, 0), _GRADUAL * SMOOTHING_PX)
    gradual = _slope(np.asarray(wider, np.float32))
    return np.asarray(
        (sharpness > _EDGE_PER_M_PX)
        & (sharpness > _SHARPER * np.hypot(gradual[..., 0], gradual[..., 1]))
    )


def _slope(image: Image) -> Image:
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    right = cv2.filter2D(image, -1, kernel)
    down = cv2.filter2D(image, -1, kernel.T.copy())
    return np.stack([right, down], axis=-1)


def plane_slopes(image: Image, known: Mask) -> Array:
    """Slopes (h, w, 2) per pixel of planes fitted around each pixel to the known ones.

    A plane is linear in the image of inverse depth. Differences of a blurred image would come out
    too small beside gaps and the image's border: a floor would then seem to change when the camera
    moves along it.
    """
    height, width = image.shape
    weight = known.astype(np.float64)
    x = np.linspace(-0.5, 0.5, width) * width * np.ones((height, 1))
    y = np.linspace(-0.5, 0.5, height)[:, None] * height * np.ones(width)

    def blurred(values: Array) -> Array:
        return np.asarray(cv2.GaussianBlur(weight * values, (0, 0), _SLOPE_PX))

    total = np.maximum(blurred(np.ones_like(weight)), 1e-6)
    w = image.astype(np.float64)
    mean_x, mean_y, mean_w = (blurred(values) / total for values in (x, y, w))
    xx = blurred(x * x) / total - mean_x**2
    yy = blurred(y * y) / total - mean_y**2
    xy = blurred(x * y) / total - mean_x * mean_y
    xw = blurred(x * w) / total - mean_x * mean_w
    yw = blurred(y * w) / total - mean_y * mean_w
    determinant = np.maximum(xx * yy - xy**2, 1.0)
    return np.stack([yy * xw - xy * yw, xx * yw - xy * xw], axis=-1) / determinant[..., None]


def _disturbances(
    image: NDArray[np.floating], visible: Array, outline: Mask, steep: Image, gap: Image
) -> tuple[Array, Array]:
    """Columns (..., COMMON) and (..., LOCAL) for what changes an image other than a move.

    Args:
        gap: depth of the gap that an outline leaves where it loses a pixel, as a multiple of the
            step between its two sides.
    """
    right, down = np.moveaxis(np.where(outline[..., None], steep, 0.0).astype(np.float64), -1, 0)
    growth = -np.hypot(right, down) * gap
    surface = np.where(outline, 0.0, 1.0)
    alone = np.where(gap < _NOTHING, growth, 0.0)
    shifted = np.where(outline, visible, 1.0)
    common = np.stack([shifted, image.astype(np.float64), alone, growth - alone], -1)
    return common, np.stack([surface, right, down, growth], -1)


def _jacobian(camera: CameraCalibration, points: Array, visible: Array, slope: Array) -> Array:
    """d(smoothed inverse depth) / d(xi), (..., 6).

    A point of the scene moves by p x w - t in the frame of a camera that moves by xi = (w, t): the
    picture shifts, and the depth in it changes.
    """
    inverse = 1.0 / points[..., 2:]
    ahead = points * inverse
    less = np.broadcast_to(-np.eye(3), (*points.shape, 3))
    motion = np.concatenate([skew(points), less], axis=-1)
    K = camera.K
    right = K[0, 0] * inverse * (motion[..., 0, :] - ahead[..., :1] * motion[..., 2, :])
    down = K[1, 1] * inverse * (motion[..., 1, :] - ahead[..., 1:2] * motion[..., 2, :])
    nearer = -visible[..., None] * inverse**2 * motion[..., 2, :]
    return np.asarray(nearer - slope[..., :1] * right - slope[..., 1:] * down)
