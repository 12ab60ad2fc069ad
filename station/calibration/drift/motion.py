"""A camera's displacement since its calibration, from the floor and fixed structure in view.

The image of inverse depth is aligned with the stored one over the camera's six degrees of freedom:
the range flow constraint (Horn & Harris 1991, "Rigid body motion from range image sequences")
where surfaces are smooth, the shift of the outline where depth jumps. People and things that come
and go are left out. A flat wall says nothing of a shift along itself: the covariance tells which
directions this booth cannot show, and only the others are judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import (
    SMOOTHING_PX,
    StaticView,
    raw_inverse_depth,
    smoothed,
)
from station.core.depth_image import Image
from station.core.geometry import invert, se3_exp, skew, transform
from station.core.lens import project, rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]

MOVED_M = 0.005
MOVED_RAD = float(np.radians(0.3))
"""A camera that moved by either has to be named."""
LEVER_M = MOVED_M / MOVED_RAD
"""Turns rotations into metres, so that both limits are one length."""
_CERTAINTY = 5.2
"""Standard deviations beyond which a direction alarms: 4.2 would be once in 5,000 scans of four
cameras that each see two directions badly, and a direction that is seen badly errs by up to one
standard deviation on the average, for a person hides other places in every scan."""
_GUARD_M = 0.001
"""Smaller displacements never alarm: warmth and the sensor's own steps cause them."""
_POWER = 2.0
"""A move is surely noticed so many standard deviations beyond what alarms."""
_STRIDE_PX = 8
"""Samples this far apart, after smoothing, are nearly independent ..."""
_CORRELATION = 2.5
"""... their variances sum to this much more, of a blur of 3.4 px (the sensor's window, ours)."""
_FLOOR_PER_M = 2e-5
"""Error that averaging does not remove (quantisation), 1/m; 0.3 mm at 3.7 m."""
_WIDE_PX = 10.0
"""Slopes of smooth surfaces are taken over this width: noise in them would pass for structure."""
_EDGE_PER_M_PX = 0.008
"""A steeper slope, 1/m per pixel, is an outline: a floor seen at a grazing angle has 0.003."""
_GRADUAL, _SHARPER = 4.0, 2.0
"""An outline is steeper than the picture smoothed so many times wider by at least this factor;
a floor that fades out at a grazing angle is not, and it does not move with the picture."""
_OFTEN = 0.4
"""A surface is used where this share of the frames has a reading."""
_EDGE_REACH_PX = 7
_FARTHEST_OUTLINE_M = 4.0
"""Farther surfaces end where the sensor's range ends, which is not an outline."""
_CHANGED_PER_M, _CHANGED_PX = 0.03, 6.0
"""A larger difference, or a shift beyond so many pixels, is not a moved camera but a person."""
_SHADOW_CELLS = 2
"""The outline of a person, and of the shadow that the projector casts behind, in strides."""
_MIN_SHARE = 0.15
_COARSE_SIGMA_M, _FINE_SIGMA_M = 0.02, 0.2
"""Prior standard deviations, for directions that the scene does not determine; the first keeps the
move smaller than what outlines can follow."""
_ITERATIONS = 10
_HUBER, _TUKEY = 1.345, 4.685


@dataclass(frozen=True, slots=True)
class CameraMove:
    """A camera's displacement from its calibration, estimated from the background."""

    camera: str
    xi: Array
    """(6,) rotation vector and translation: it stands at world_from_camera @ se3_exp(xi) now."""
    covariance: Array
    """(6, 6) of xi; directions that the scene does not show have a large variance."""
    share: float
    """Share of the stored background that is still seen, within what a small move explains."""

    @property
    def lost(self) -> bool:
        """Too little of the stored background is met for any estimate."""
        return self.share < _MIN_SHARE

    @property
    def moved(self) -> bool:
        """It has to be calibrated again before the next scan."""
        return not self.lost and self.alarm() > 1.0

    def alarm(self) -> float:
        """The move as a share of what alarms, in the direction in which it is the largest."""
        size, sigmas, _ = self._along()
        return float(np.max(np.abs(size) / _limits(sigmas)))

    def unseen(self) -> list[Array]:
        """Unit directions (6,) along which a move of MOVED_M or MOVED_RAD may stay unnoticed.

        Rotation vector times LEVER_M and translation, camera frame.
        """
        _, sigmas, directions = self._along()
        hidden = _limits(sigmas) + _POWER * sigmas > MOVED_M
        return list(directions.T[hidden])

    def words(self) -> str:
        """The result for the operator, in one sentence."""
        if self.lost:
            return (
                f"camera {self.camera} no longer sees what it saw when it was calibrated "
                f"({100 * self.share:.0f} % of it): it was turned away, or something stands in its "
                "way"
            )
        if not self.moved:
            return f"camera {self.camera} stands where it was calibrated"
        size, sigmas, directions = self._along()
        sure = np.where(np.abs(size) > _limits(sigmas), size, 0.0)
        turn, shift = np.split(directions @ sure / _SCALE, 2)
        degrees, millimetres = np.degrees(np.linalg.norm(turn)), 1e3 * np.linalg.norm(shift)
        return (
            f"camera {self.camera} has moved since it was calibrated, by about "
            f"{millimetres:.0f} mm and {degrees:.1f} degrees"
        )

    def unseen_words(self) -> list[str]:
        """The directions of ``unseen``, by what they mostly are."""
        return [_MOTIONS[int(np.argmax(np.abs(direction)))] for direction in self.unseen()]

    def _along(self) -> tuple[Array, Array, Array]:
        """Sizes, standard deviations (6,) and directions (6, 6) of independent components."""
        variances, directions = np.linalg.eigh(self.covariance * np.outer(_SCALE, _SCALE))
        return directions.T @ (self.xi * _SCALE), np.sqrt(np.maximum(variances, 0.0)), directions


def _limits(sigmas: Array) -> Array:
    return np.hypot(_CERTAINTY * sigmas, _GUARD_M)


_MOTIONS = (
    "pitch", "yaw", "roll",
    "sideways shift", "vertical shift", "shift forward or back",
)  # fmt: skip
_SCALE = np.array([LEVER_M] * 3 + [1.0] * 3)


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
    outline: NDArray[np.bool_]
    """(r, c): where depth jumps; no reading counts as 0 there."""
    usable: NDArray[np.bool_]
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

    @classmethod
    def prepare(cls, camera: CameraCalibration, view: StaticView) -> DriftReference:
        """Find outlines, slopes and sensitivities of a stored view."""
        surface, with_gaps = smoothed(view.inverse_depth, view.share)
        steep = _slope(with_gaps)
        sharpness = np.hypot(steep[..., 0], steep[..., 1])
        wider = cv2.GaussianBlur(with_gaps, (0, 0), _GRADUAL * SMOOTHING_PX)
        gradual = _slope(np.asarray(wider, np.float32))
        edge = (sharpness > _EDGE_PER_M_PX) & (
            sharpness > _SHARPER * np.hypot(gradual[..., 0], gradual[..., 1])
        )
        reach = np.ones((2 * _EDGE_REACH_PX + 1,) * 2, np.uint8)
        outline = cv2.dilate(edge.astype(np.uint8), reach).astype(bool)
        calm = (view.share > _OFTEN) & ~outline
        image = np.where(outline, with_gaps, surface)
        wide = _filled_blur(surface, calm)
        slope = np.where(outline[..., None], steep, _slope(wide))
        nearest = np.where(outline, cv2.dilate(surface, reach), surface)
        usable = calm | (outline & (nearest > 1.0 / _FARTHEST_OUTLINE_M))
        steepness = np.hypot(slope[..., 0], slope[..., 1])
        half = _STRIDE_PX // 2
        rows, columns = np.mgrid[
            half : camera.height : _STRIDE_PX, half : camera.width : _STRIDE_PX
        ]
        noise = np.where(outline, view.outline_noise, view.noise)[rows, columns]
        inverse = np.maximum(nearest[rows, columns].astype(np.float64), 0.05)
        points = rays(camera)[rows, columns] / inverse[..., None]
        visible = np.minimum(image[rows, columns] / inverse, 1.0)
        sampled = slope[rows, columns].astype(np.float64)
        return cls(
            camera=camera,
            frames=view.frames,
            rows=rows,
            columns=columns,
            image=image[rows, columns].astype(np.float64),
            outline=outline[rows, columns],
            usable=usable[rows, columns],
            noise=noise.astype(np.float64),
            jacobian=_jacobian(camera, points, visible, sampled),
            points=points,
            visible=visible,
            steepness=np.asarray(cv2.dilate(steepness, reach)[rows, columns], np.float64),
        )


def _slope(image: Image) -> Image:
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    right = cv2.filter2D(image, -1, kernel)
    down = cv2.filter2D(image, -1, kernel.T.copy())
    return np.stack([right, down], axis=-1)


def _filled_blur(image: Image, known: NDArray[np.bool_]) -> Image:
    """Gaussian over the known pixels alone."""
    weight = known.astype(np.float32)
    total = cv2.GaussianBlur(image * weight, (0, 0), _WIDE_PX)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(weight, (0, 0), _WIDE_PX), 1e-3))


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


def estimate_move(
    reference: DriftReference, frames: Sequence[NDArray[np.uint16]], scale_m: float
) -> CameraMove:
    """Align frames (h, w) in units of scale_m, taken at one moment, with the stored background.

    Robust Gauss-Newton over xi, first over surfaces, then with outlines, which see
    only a few pixels far. The covariance is that of the sensor's own noise, as measured when the
    background was stored.
    """
    inverse = [raw_inverse_depth(frame, scale_m) for frame in frames]
    share = np.mean(np.stack(inverse) > 0, axis=0, dtype=np.float32)
    now = smoothed(np.asarray(np.mean(inverse, axis=0)), np.asarray(share))
    variance = reference.noise**2 * (1.0 / len(frames) + 1.0 / reference.frames) + _FLOOR_PER_M**2
    xi = np.zeros(6)
    for samples, sigma_m in (
        (reference.usable & ~reference.outline, _COARSE_SIGMA_M),
        (reference.usable, _FINE_SIGMA_M),
    ):
        same = samples & ~_changed(reference, now, xi)
        met = float(same.sum() / max(1, samples.sum()))
        if met < _MIN_SHARE:
            return CameraMove(reference.camera.name, np.zeros(6), np.eye(6), met)
        xi, covariance = _align(reference, now, variance, same, xi, sigma_m)
    return CameraMove(reference.camera.name, xi, covariance, met)


def _align(
    reference: DriftReference,
    now: tuple[Image, Image],
    variance: Array,
    same: NDArray[np.bool_],
    xi: Array,
    prior_sigma_m: float,
) -> tuple[Array, Array]:
    jacobian = reference.jacobian[same] / np.sqrt(variance[same])[:, None]
    prior = np.diag(np.square(_SCALE / prior_sigma_m))
    for iteration in range(_ITERATIONS):
        off, inside = _off(reference, now, xi)
        off, known = off[same] / np.sqrt(variance[same]), inside[same]
        size = max(1.0, 1.4826 * float(np.median(np.abs(off[known]))))
        weights = _weights(np.abs(off) / size, convex=iteration < _ITERATIONS // 2) * known
        weighted = jacobian * weights[:, None] / (_CORRELATION * size**2)
        information = jacobian.T @ weighted + prior
        xi = xi + np.linalg.solve(information, weighted.T @ off - prior @ xi)
    return xi, np.linalg.inv(information)


def _weights(off: Array, convex: bool) -> Array:
    """Weights of deviations (in standard deviations): Huber's first, then Tukey's.

    Some directions are determined by few samples (up and down, by the floor). At the start these
    samples may look like outliers, and Tukey's weights would discard them.
    """
    if convex:
        return np.asarray(_HUBER / np.maximum(off, _HUBER))
    return np.asarray(np.square(np.maximum(0.0, 1.0 - np.square(off / _TUKEY))))


def _changed(reference: DriftReference, now: tuple[Image, Image], xi: Array) -> NDArray[np.bool_]:
    """(r, c): where something stands that did not, or stands no longer, with its shadow."""
    gate = _CHANGED_PER_M + _CHANGED_PX * reference.steepness
    off, inside = _off(reference, now, xi)
    changed = (np.abs(off) > gate) & reference.usable & inside
    reach = np.ones((2 * _SHADOW_CELLS + 1,) * 2, np.uint8)
    return cv2.dilate(changed.astype(np.uint8), reach).astype(bool)


def _off(
    reference: DriftReference, now: tuple[Image, Image], xi: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Differences (r, c) of the images from those expected after a displacement xi.

    The stored samples are looked for where they are now (Baker & Matthews 2004, "Lucas-Kanade 20
    years on": inverse compositional), so their sensitivities hold for any xi. Also tells which of
    them are inside the images.
    """
    points = reference.points
    there = transform(invert(se3_exp(xi)), points)
    x, y = np.moveaxis(project(reference.camera, there).astype(np.float32), -1, 0)
    surface, with_gaps = (cv2.remap(image, x, y, cv2.INTER_LINEAR) for image in now)
    seen = np.where(reference.outline, with_gaps, surface)
    nearer = reference.visible * (1.0 / there[..., 2] - 1.0 / points[..., 2])
    height, width = now[0].shape
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return seen - (reference.image + nearer), inside
