"""Pixels of a ball that hands and fingers cover or touch."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.ball_image import INCIDENCE_COSINE, ball_image
from station.core.kinect_v1 import RANDOM_SIGMA
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_STRAY_BLUR_PX = 7
_STRAY_NOISE = 0.7
"""Share of a pixel's noise that is left in the mean over the blur."""
_STRAY_SIGMAS = 3.0
_STRAY_CLIP = 12.0
_STRAY_COSINE = 0.4
_RING = (1.1, 1.25)
"""Shares of the radius: a ring outside the flickering silhouette, where a hand is visible."""
_FINGERS_M = 0.055
"""Visible reach of fingers of 8 cm, bent round a ball, from the hand."""
_FINGER_M = 0.022
"""Breadth of a finger: it reaches so far from a gap at its edge, to one side or the other."""
_GAPS = 3
"""Missing readings within the averaging window that are an edge: single losses of one pixel in 200
come so close together a few times in a ball of ten thousand pixels."""
_SECTORS, _ALL_AROUND = 8, 7
"""Sectors of a ball, and how many of them have gaps that no hand has made."""
_WIDEST_GAP_M = 0.07
"""Patches that other sensors' patterns take are smaller; a wider gap is hair or a shadow. Without
this limit two to four times as many heads were taken for the ball where patterns overlap."""
_FINGERS_SHOW_M = 1.7
"""Up to this distance a finger is as wide as the averaging window that reveals strays."""


def hand_pixels(
    part: Image,
    camera: CameraCalibration,
    ray: Image,
    center: Array,
    radius: float,
    radius_m: float,
    gate: float,
) -> Mask:
    """Mask (h, w) of pixels that may show a hand, to be left out of the fit of the ball.

    ``radius`` is the fitted radius, ``radius_m`` the true one, ``gate`` the largest noise of a
    pixel, 1/m. Fingers on a distant ball are too narrow to be told from noise and have shifted its
    centre by 0.7 mm in many frames: there all pixels within a hand's reach are left out.
    """
    off = _strays(part, ray, center, radius)
    if center[2] > _FINGERS_SHOW_M:
        off |= _held(part, camera, ray, center, radius_m, gate)
    return off


def _strays(part: Image, ray: Image, center: Array, radius: float) -> Mask:
    """Pixels near areas that do not lie on the ball: what touches or covers it.

    A finger stands out of the ball by no more than a few pixels' noise; the mean over its width
    tells it apart. Areas off to either side are left out alike, so that noise cannot pull.
    """
    expected, cosine = ball_image(ray, center, radius)
    seen = (cosine > _STRAY_COSINE) & (part > 0.0)
    away = np.where(seen, part - expected, 0.0).astype(np.float32)
    away = np.clip(away, -_STRAY_CLIP * RANDOM_SIGMA, _STRAY_CLIP * RANDOM_SIGMA)
    size = (_STRAY_BLUR_PX, _STRAY_BLUR_PX)
    share = cv2.blur(seen.astype(np.float32), size)
    mean = cv2.blur(away, size) / np.maximum(share, 0.2)
    limit = _STRAY_SIGMAS * _STRAY_NOISE * RANDOM_SIGMA / np.sqrt(np.maximum(cosine, 0.2))
    off = seen & (np.abs(mean) > limit)
    return np.asarray(cv2.dilate(off.astype(np.uint8), np.ones(size, np.uint8)) > 0)


def beside_gaps(
    part: Image, camera: CameraCalibration, ray: Image, center: Array, radius: float
) -> Mask:
    """Pixels within a finger's breadth of where readings are missing amid the ball.

    A ball alone is seen whole up to the limit of incidence. Readings are missing at the edges of
    what stands out of it, and these gaps stay where they are when the ball is fitted to the
    fingers, too, which hides how far they stand out: it has been moved by 5 mm. Small gaps all
    around are no hand's: another sensor's pattern lies over the ball. Of a ball that the image's
    border cuts nobody knows what is all around it.
    """
    cap = ball_image(ray, center, radius)[1] > INCIDENCE_COSINE
    gaps = (cap & (part == 0.0)).astype(np.float32)
    near = cv2.boxFilter(gaps, -1, (_STRAY_BLUR_PX, _STRAY_BLUR_PX), normalize=False)
    several = ((gaps > 0.0) & (near > _GAPS - 0.5)).astype(np.uint8)
    pixels_per_m = camera.K[0, 0] / center[2]
    small = _small(several, _WIDEST_GAP_M * pixels_per_m)
    if not _cut(cap) and _sectors(small, ray, center) >= _ALL_AROUND:
        return np.zeros_like(cap)
    apart_px = cv2.distanceTransform(1 - several, cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(apart_px < _FINGER_M * pixels_per_m)


def _cut(cap: Mask) -> bool:
    """True if the image's border cuts a ball, whose window is wider than the ball."""
    return bool(cap[0].any() or cap[-1].any() or cap[:, 0].any() or cap[:, -1].any())


def _small(gaps: NDArray[np.uint8], widest_px: float) -> Mask:
    """The gaps that are no wider or higher; those next to each other are one."""
    joined = cv2.morphologyEx(gaps, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, label, extent, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    sides = extent[:, (cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT)].max(axis=1)
    return np.asarray((gaps > 0) & (sides <= widest_px)[label])


def _sectors(mask: Mask, ray: Image, center: Array) -> int:
    """Number of the sectors around a ball's middle that a part of it lies in."""
    away = ray[mask][:, :2] - center[:2] / center[2]
    angle = np.arctan2(away[:, 1], away[:, 0])
    return len(np.unique(np.floor((angle / np.pi + 1.0) * 0.5 * _SECTORS) % _SECTORS))


def _held(
    part: Image, camera: CameraCalibration, ray: Image, center: Array, radius: float, gate: float
) -> Mask:
    """Pixels within fingers' reach of what stands before the ball, or beside it no farther than
    its rim."""
    expected, cosine = ball_image(ray, center, radius)
    before = (cosine > INCIDENCE_COSINE) & (part > expected + gate)
    ring, beyond = surroundings(part, ray, center, radius)
    hand = _solid(before) | (_solid(~beyond) & ring)
    reach_px = _FINGERS_M * camera.K[0, 0] / center[2]
    apart_px = cv2.distanceTransform((~hand).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(apart_px < reach_px)


def _solid(mask: Mask) -> Mask:
    """The mask without specks of noise."""
    window = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, window) > 0)


def surroundings(part: Image, ray: Image, center: Array, radius: float) -> tuple[Mask, Mask]:
    """The ring around the ball, and where one sees past its rim (or nothing)."""
    along = ray @ center
    away2 = center @ center - along**2 / np.einsum("hwi,hwi->hw", ray, ray)
    ring = (away2 > (_RING[0] * radius) ** 2) & (away2 < (_RING[1] * radius) ** 2)
    return ring, part < 1.0 / (center[2] + 0.3 * radius)
