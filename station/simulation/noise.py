"""A structured-light Kinect v1's errors, applied to a true depth image.

Geometry: baseline 75 mm, disparity steps of 1/8 px. Random error and silhouette pixels that flicker
and fly: Nguyen, Izadi & Lovell 2012. (The reconstruction assumes another published model, that of
Khoshelham & Elberink, so that it is not tested with its own assumption.) Errors are correlated over
the matching window of about 9 x 9 px; there is no reading beyond 70-75 degrees of incidence or in
the projector's shadow. Raw values: metres = 0.1236 tan(raw / 2842.5 + 1.1863).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.kinect_v1 import NO_READING
from station.simulation.interference import Interference
from station.simulation.violations import SmoothBias, ZeroPlane

_WINDOW_PX = 9
_FADE_START_RAD, _FADE_END_RAD = np.radians(66.0), np.radians(76.0)
_STEEP_RAD = np.radians(60.0)
_RANGE_M = (0.5, 4.5)
_MIDDLE_M = 1.0 / 0.6
"""Depth that a unit's curvature refers to."""

Image = NDArray[np.float32]


def raw_from_depth(
    depth_m: NDArray[np.floating], zero_plane: ZeroPlane | None = None
) -> NDArray[np.uint16]:
    """The nearest raw 11-bit values; no reading where the depth is 0 or out of range."""
    seen = (depth_m > _RANGE_M[0]) & (depth_m < _RANGE_M[1])
    safe = np.where(seen, depth_m, 1.0)
    raw = raw_by_tangent(safe) if zero_plane is None else zero_plane.raw(safe)
    return np.where(seen, np.clip(np.rint(raw), 0, NO_READING - 1), NO_READING).astype(np.uint16)


def raw_by_tangent(depth_m: NDArray[np.floating]) -> NDArray[np.floating]:
    """Raw values (not rounded) by the tangent law."""
    return np.asarray(2842.5 * (np.arctan(depth_m / 0.1236) - 1.1863))


@dataclass(frozen=True, slots=True)
class TrueView:
    """The view of a perfect sensor, (h, w) each."""

    depth_m: Image
    """Distance along the optical axis; 0 = nothing."""
    incidence_rad: Image
    lit: NDArray[np.bool_]
    """Mask of the pixels that the projector's light reaches."""
    reflects: NDArray[np.bool_]
    """False on dark hair or underwear, which give no reading."""
    foreign: Image | None = None
    """Light of other sensors' projectors, in shares of the sensor's own; None for none."""


@dataclass(frozen=True, slots=True)
class Window:
    """Position of a part of an image in the whole."""

    top: int
    left: int
    image_height: int
    image_width: int


@dataclass(frozen=True, slots=True)
class UnitError:
    """One sensor's smooth systematic depth error."""

    bias_m: float = 0.0
    """Its size at 2 m, growing with z^2."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Relative change over the image, per half width and half height."""
    gain: float = 0.0
    """Relative error of all inverse depths: a baseline or a focal length that is slightly off."""
    curvature: float = 0.0
    """Error of the inverse depth where it is 1 / m off that of 1.7 m, growing with the square."""
    warmth: tuple[float, int] = (0.0, 0)
    """By which share depths of 2.5 m are larger at another temperature, and with which power of the
    depth this share grows."""
    smooth: SmoothBias | None = None
    zero_plane: ZeroPlane | None = None
    frozen_share: float = 0.0
    """Share of the noise's variance that is the same in every frame ..."""
    frozen_seed: tuple[int, ...] = ()
    """... and which pattern it is."""
    interference: Interference | None = None

    def apply(self, depth_m: Image, window: Window | None = None) -> Image:
        """The depths that the unit reports; of a part of the image where a window is given."""
        if self == UnitError():
            return depth_m
        window = window or Window(0, 0, *depth_m.shape)
        height, width = depth_m.shape
        x = np.linspace(-1.0, 1.0, window.image_width, dtype=np.float32)
        y = np.linspace(-1.0, 1.0, window.image_height, dtype=np.float32)
        columns = x[None, window.left : window.left + width]
        rows = y[window.top : window.top + height, None]
        off = self.offset_m(columns, rows, depth_m)
        return np.where(depth_m > 0.0, depth_m + off, 0.0).astype(np.float32)

    def offset_m(self, x: Any, y: Any, depth_m: Any) -> Any:
        """Error (...) in metres at x, y from -1 to 1 over the image."""
        shape = 1.0 + self.tilt[0] * x + self.tilt[1] * y
        off = 0.25 * self.bias_m * shape * np.square(depth_m) + self.gain * depth_m
        off = off + self.curvature * np.square(1.0 - depth_m / _MIDDLE_M)
        share, power = self.warmth
        if share:
            off = off + share * depth_m * (np.maximum(depth_m, _RANGE_M[0]) / 2.5) ** power
        if self.smooth is not None:
            off = off + self.smooth.offset_m(x, y, depth_m)
        return off

    def decoded_m(self, depth_m: Any) -> Any:
        """Depth that the station makes of a depth that the unit encodes by its own law."""
        if self.zero_plane is None:
            return depth_m
        return 0.1236 * np.tan(self.zero_plane.raw(depth_m) / 2842.5 + 1.1863)


def axial_sigma_m(depth_m: Image, incidence_rad: Image) -> Image:
    """Standard deviation of a reading along the axis (Nguyen, Izadi & Lovell 2012), metres."""
    facing = 0.0012 + 0.0019 * np.square(depth_m - 0.4)
    angle = np.minimum(incidence_rad, np.float32(1.5))
    steep = np.square(angle / (0.5 * np.pi - angle)) * (1e-4 / np.sqrt(np.maximum(depth_m, 0.1)))
    return np.asarray(facing + np.where(angle > _STEEP_RAD, steep, 0.0), np.float32)


@dataclass(frozen=True, slots=True)
class NoiselessView:
    """The readings of one unit without noise, (h, w) each."""

    depth_m: Image
    seen: NDArray[np.bool_]
    sigma_m: Image
    fade: Image
    """Probability of no reading at a slant."""
    unit: UnitError
    frozen: Image | None
    """The part of the noise that stays, of unit variance."""
    foreign: Image | None

    @classmethod
    def of(cls, view: TrueView, unit: UnitError, window: Window | None = None) -> NoiselessView:
        """The unit's view; of a part of the image where a window is given."""
        depth = unit.apply(view.depth_m, window)
        whole = window or Window(0, 0, *depth.shape)
        frozen = None
        if unit.frozen_share:
            pattern = _frozen_pattern(unit.frozen_seed, whole.image_height, whole.image_width)
            height, width = depth.shape
            frozen = pattern[whole.top : whole.top + height, whole.left : whole.left + width]
        sigma_m = axial_sigma_m(depth, np.minimum(view.incidence_rad, _FADE_END_RAD))
        foreign = None if unit.interference is None else view.foreign
        if unit.interference is not None and foreign is not None:
            sigma_m = sigma_m * np.sqrt(1.0 + unit.interference.noise * foreign)
        return cls(
            depth_m=depth,
            seen=(depth > 0) & view.lit & view.reflects,
            sigma_m=sigma_m,
            fade=(view.incidence_rad - _FADE_START_RAD) / (_FADE_END_RAD - _FADE_START_RAD),
            unit=unit,
            frozen=frozen,
            foreign=foreign,
        )

    def read(self, rng: np.random.Generator) -> NDArray[np.uint16]:
        """One noisy raw 11-bit frame (h, w)."""
        noise = _correlated(rng, self.depth_m.shape)
        if self.frozen is not None:
            share = self.unit.frozen_share
            noise = np.sqrt(1.0 - share) * noise + np.sqrt(share) * self.frozen
        measured = np.where(self.seen, self.depth_m + self.sigma_m * noise, 0.0).astype(np.float32)
        if self.unit.interference is not None and self.foreign is not None:
            lost, wrong = self.unit.interference.failing(self.foreign, rng)
            measured[lost] = 0.0
            taken = wrong & self.seen
            measured[taken] = self.unit.interference.wrong_m(self.depth_m)[taken]
        measured[rng.random(self.depth_m.shape, dtype=np.float32) < self.fade] = 0.0
        return raw_from_depth(_flying(measured, rng), self.unit.zero_plane)


def _correlated(rng: np.random.Generator, shape: tuple[int, ...]) -> Image:
    """Noise (h, w) of unit variance, correlated over the matching window."""
    white = rng.standard_normal(shape, dtype=np.float32)
    blurred = cv2.GaussianBlur(white, (_WINDOW_PX, _WINDOW_PX), 1.6)
    return np.asarray(blurred / max(float(blurred.std()), 1e-6), np.float32)


@lru_cache(maxsize=16)
def _frozen_pattern(seed: tuple[int, ...], height: int, width: int) -> Image:
    return _correlated(np.random.default_rng(seed), (height, width))


def observe(
    view: TrueView, unit: UnitError, rng: np.random.Generator, window: Window | None = None
) -> NDArray[np.uint16]:
    """One noisy raw 11-bit frame (h, w) of what a perfect sensor would see."""
    return NoiselessView.of(view, unit, window).read(rng)


def _flying(depth: Image, rng: np.random.Generator) -> Image:
    """Silhouette pixels flicker: some vanish, some jump to the other side, some lie between."""
    filled = np.where(depth > 0, depth, np.float32(9.0))
    window = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(filled, window), cv2.dilate(filled, window)
    edge = np.flatnonzero(far - near > 0.05)
    fate = rng.random(depth.shape, dtype=np.float32).ravel()[edge]
    share = rng.random(depth.shape, dtype=np.float32).ravel()[edge]
    near, far = near.ravel()[edge], far.ravel()[edge]
    far = np.where(far > 8.0, near, far)
    result = depth.ravel().copy()
    result[edge[fate < 0.30]] = 0.0
    swapped = (fate >= 0.30) & (fate < 0.55)
    result[edge[swapped]] = near[swapped]
    flying = (fate >= 0.55) & (fate < 0.65)
    result[edge[flying]] = (near + (far - near) * share)[flying]
    return result.reshape(depth.shape)
