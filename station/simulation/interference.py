"""Interference: other sensors' projectors shine on what a sensor looks at.

Where two patterns overlap, some of a sensor's matching windows find no match, and a few find a
wrong one, in patches of about the window's size that hardly change while nothing moves; noise grows
elsewhere (Maimone & Fuchs 2012: of a room that six Kinects see, one loses 16.6 % of its pixels).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from station.core.geometry import invert, transform
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Image = NDArray[np.float32]

BASELINE_M = 0.075
"""Distance of the projector from the camera, along the camera's x axis."""

_BLUR_PX = 2.5
_MOST = 0.6
"""Largest share of lost windows, where foreign light is much the brighter."""
_WRONG_OFF = (0.01, 0.12)
"""Ends of the relative depth error of a wrong match."""
_DIMMEST = 0.02
"""Light of a sensor's own projector in comparisons at least, 1 / m^2: a twentieth of that on what
faces it at 1.6 m."""


@dataclass(frozen=True, slots=True)
class Projector:
    """A sensor's projector, which lights what the sensor's camera would see from its place."""

    camera: CameraCalibration
    world_from_camera: Array

    @property
    def place_m(self) -> Array:
        """(3,), world frame."""
        return transform(self.world_from_camera, (BASELINE_M, 0.0, 0.0))

    def brightness(self, places: Array, outwards: Array) -> Array:
        """Light (n,) on surfaces at (n, 3) with normals (n, 3), 1 / m^2; what stands in between is
        not looked at."""
        local = transform(invert(self.world_from_camera), places) - (BASELINE_M, 0.0, 0.0)
        K = self.camera.K
        ahead = np.maximum(local[:, 2], 1e-3)
        u = K[0, 0] * local[:, 0] / ahead + K[0, 2]
        v = K[1, 1] * local[:, 1] / ahead + K[1, 2]
        within = (u > 0.0) & (u < self.camera.width) & (v > 0.0) & (v < self.camera.height)
        return np.where(within & (local[:, 2] > 0.0), self._falling(places, outwards), 0.0)

    def in_shares(self, foreign: Array, places: Array, outwards: Array) -> Image:
        """Foreign light (n,) on what the sensor's camera sees, in shares of the sensor's own, which
        reaches to the borders of the camera's image."""
        own = np.maximum(self._falling(places, outwards), _DIMMEST)
        return np.asarray(foreign / own, np.float32)

    def _falling(self, places: Array, outwards: Array) -> Array:
        """Light (n,) by Lambert's law, of a projector that shines in all directions."""
        towards = self.place_m - places
        square = np.einsum("ni,ni->n", towards, towards)
        cosine = np.einsum("ni,ni->n", towards, outwards) / np.sqrt(square)
        return np.asarray(np.maximum(cosine, 0.0) / square)


@dataclass(frozen=True, slots=True)
class Interference:
    """Effect on one unit of foreign light, whose brightness is in shares of its own light's."""

    lost: float
    """Share of the windows that fail where foreign light is as bright as its own."""
    wrong: float
    """Share of these that give a wrong depth instead of none."""
    noise: float
    """Excess of the noise's variance where foreign light is as bright."""
    lasting: float
    """Share of the chance that stays from frame to frame."""
    seed: tuple[int, ...]

    def failing(
        self, foreign: Image, rng: np.random.Generator
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks (h, w) of pixels without a match, and of those with a wrong one."""
        field = _patches(self.seed, foreign.shape)
        passing = _smooth(rng.standard_normal(foreign.shape, dtype=np.float32))
        chance = np.sqrt(self.lasting) * field + np.sqrt(1.0 - self.lasting) * passing
        share = np.minimum(self.lost * foreign, _MOST)
        fails = chance > ndtri(1.0 - np.maximum(share, 1e-9))
        wrong = fails & (_patches((*self.seed, 1), foreign.shape) > ndtri(1.0 - self.wrong))
        return fails & ~wrong, wrong

    def wrong_m(self, depth_m: Image) -> Image:
        """Depths (h, w) of wrong matches."""
        rng = np.random.default_rng((*self.seed, 2))
        low, high = _WRONG_OFF
        size = low * (high / low) ** rng.random()
        swing = np.tanh(2.0 * _patches((*self.seed, 3), depth_m.shape))
        return np.asarray(depth_m * (1.0 + size * swing), np.float32)


def _smooth(white: Image) -> Image:
    """Noise (h, w) of unit variance in patches of the matching window's size."""
    blurred = cv2.GaussianBlur(white, (0, 0), _BLUR_PX)
    return np.asarray(blurred / max(float(blurred.std()), 1e-6), np.float32)


@lru_cache(maxsize=32)
def _patches(seed: tuple[int, ...], shape: tuple[int, int]) -> Image:
    rng = np.random.default_rng(seed)
    return _smooth(rng.standard_normal(shape, dtype=np.float32))
