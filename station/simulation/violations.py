"""Sensors, balls, floors and helpers that err otherwise than a calibration assumes.

Each violation is a switch of a `SimulatedBooth`. Its parameters are drawn here, from distributions
that nothing under `station.calibration` reads; their ends lie beyond those of the solution's
priors, and the shapes of the errors differ from the terms that are solved for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from station.core.rig import CameraCalibration
from station.simulation.interference import Interference

Array = NDArray[np.float64]

BIAS = "bias"
"""Smooth depth error of 1.5 mm rms at 1.7 m, rings and bumps, and a gain of 0.1 to 0.3 %."""
LENS = "lens"
"""Focal length off by up to 0.2 %, principal point by up to 1 px along each axis."""
K1 = "k1"
"""Radial distortion k1 of 0.02 to 0.045, either sign, unknown to the driver."""
FLOOR = "floor"
"""Floor bowed by 2 mm."""
SLOPE = "slope"
"""Floor that slopes by up to 5 mm per metre. Only a plumb line shows that: none of ``ALL``."""
BALL = "ball"
"""Ball 0.35 % larger or smaller than stated."""
OVAL = "oval"
"""Ball 1.2 % longer along one axis, which turns with the hand."""
FROZEN = "frozen"
"""Two fifths of the noise's variance are a pattern that stays from frame to frame."""
HELPER = "helper"
"""A second person at the edge of the booth while the ball is waved."""
HAND = "hand"
"""The ball is gripped from changing sides by a hand that covers up to half of it."""
RAW_LAW = "raw-law"
"""Raw values by libfreenect's own law (its zero-plane constants, a little different in each unit),
decoded by the tangent law."""
INTERFERENCE = "interference"
"""The sensors' patterns disturb each other where they overlap: none of ``ALL``."""
ALL = (BIAS, LENS, K1, FLOOR, BALL, OVAL, FROZEN, HELPER, HAND, RAW_LAW)

_BIAS_RMS_M, _BIAS_AT_M = 1.5e-3, 1.7
_GAIN = (1e-3, 3e-3)
_FOCAL_SHARE, _CENTER_PX = 2e-3, 1.0
_K1 = (0.02, 0.045)
_BOW_M, _SLOPE = 2e-3, 5e-3
_BALL_SHARE, _OVAL_SHARE = 3.5e-3, 1.2e-2
_FROZEN_SHARE = 0.4
_RINGS, _BUMPS = 2, 6
_NORMALISING_GRID = 24


@dataclass(frozen=True, slots=True)
class SmoothBias:
    """Depth error that is smooth over image and depth: rings around a centre, and bumps.

    Coordinates x, y run from -1 to 1 over the image's width and height.
    """

    seed: tuple[int, ...]

    def offset_m(self, x: Array, y: Array, depth_m: Array) -> Array:
        """Error (...) in metres, growing with the square of the depth."""
        scale, rings, bumps = _drawn_bias(self.seed)
        return np.asarray(scale * _pattern(rings, bumps, x, y, depth_m) * depth_m**2)


@lru_cache(maxsize=64)
def _drawn_bias(seed: tuple[int, ...]) -> tuple[float, Array, Array]:
    rng = np.random.default_rng(seed)
    rings = np.column_stack(
        [
            rng.uniform(-0.3, 0.3, (_RINGS, 2)),
            rng.uniform(0.7, 1.4, _RINGS),
            rng.uniform(0.0, 2.0 * np.pi, (_RINGS, 2)),
            rng.uniform(0.6, 1.5, _RINGS),
            rng.uniform(0.5, 1.0, _RINGS),
        ]
    )
    bumps = np.column_stack(
        [
            rng.uniform(-1.0, 1.0, (_BUMPS, 2)),
            rng.uniform(0.2, 0.4, _BUMPS),
            rng.uniform(0.0, 2.0 * np.pi, _BUMPS),
            rng.uniform(0.6, 1.5, _BUMPS),
            rng.choice([-1.0, 1.0], _BUMPS) * rng.uniform(0.6, 1.4, _BUMPS),
        ]
    )
    axis = np.linspace(-1.0, 1.0, _NORMALISING_GRID)
    x, y = np.meshgrid(axis, axis)
    size = np.sqrt(np.mean(_pattern(rings, bumps, x, y, np.full_like(x, _BIAS_AT_M)) ** 2))
    return _BIAS_RMS_M / float(size) / _BIAS_AT_M**2, rings, bumps


def _pattern(rings: Array, bumps: Array, x: Array, y: Array, depth_m: Array) -> Array:
    inverse = 1.0 / np.maximum(depth_m, 0.3)
    total = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y), np.shape(depth_m)))
    for at_x, at_y, wave, phase, depth_phase, depth_wave, size in rings:
        radius = np.hypot(x - at_x, 0.75 * (y - at_y))
        swing = np.cos(2.0 * np.pi * inverse / depth_wave + depth_phase)
        total += size * np.cos(2.0 * np.pi * radius / wave + phase) * (0.6 + 0.4 * swing)
    for at_x, at_y, width, depth_phase, depth_wave, size in bumps:
        away2 = (x - at_x) ** 2 + (0.75 * (y - at_y)) ** 2
        swing = np.cos(2.0 * np.pi * inverse / depth_wave + depth_phase)
        total += size * np.exp(-0.5 * away2 / width**2) * (0.6 + 0.4 * swing)
    return total


def _rng(seed: int, *what: int) -> np.random.Generator:
    return np.random.default_rng((seed, 4711, *what))


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def smooth_bias(switches: frozenset[str], seed: int, unit: int) -> SmoothBias | None:
    """A unit's own bias pattern, where the booth has any."""
    return SmoothBias((seed, 4711, 1, unit)) if BIAS in switches else None


def extra_gain(switches: frozenset[str], seed: int, unit: int) -> float:
    """A unit's further relative error of inverse depth."""
    return _signed(_rng(seed, 2, unit), *_GAIN) if BIAS in switches else 0.0


def frozen_share(switches: frozenset[str]) -> float:
    """Share of the noise's variance that is the same in every frame."""
    return _FROZEN_SHARE if FROZEN in switches else 0.0


_LOST, _WRONG, _NOISE, _LASTING = (0.05, 0.2), (0.05, 0.3), (0.5, 2.0), (0.5, 0.95)


def interference(switches: frozenset[str], seed: int, unit: int) -> Interference | None:
    """Effect of the other units' light on one, where the booth's sensors disturb each other."""
    if INTERFERENCE not in switches:
        return None
    rng = _rng(seed, 14, unit)
    lost, wrong, noise, lasting = (rng.uniform(*ends) for ends in (_LOST, _WRONG, _NOISE, _LASTING))
    return Interference(lost, wrong, noise, lasting, (seed, 4711, 15, unit))


def true_lens(
    switches: frozenset[str], seed: int, unit: int, believed: CameraCalibration
) -> CameraCalibration:
    """A unit's lens as it is; ``believed`` is what its driver says."""
    rng = _rng(seed, 3, unit)
    K, distortion = believed.K.copy(), believed.distortion.copy()
    focal = rng.uniform(-_FOCAL_SHARE, _FOCAL_SHARE)
    center = rng.uniform(-_CENTER_PX, _CENTER_PX, 2)
    radial = _signed(rng, *_K1)
    if LENS in switches:
        K[0, 0] *= 1.0 + focal
        K[1, 1] *= 1.0 + focal
        K[:2, 2] += center
    if K1 in switches:
        distortion[0] += radial
    return replace(believed, K=K, distortion=distortion)


def ball_scale(switches: frozenset[str], seed: int) -> float:
    """True over stated radius."""
    sign = float(_rng(seed, 4).choice([-1.0, 1.0]))
    return 1.0 + sign * _BALL_SHARE if BALL in switches else 1.0


def oval_share(switches: frozenset[str]) -> float:
    """Excess of the ball's long axis over the others, relative."""
    return _OVAL_SHARE if OVAL in switches else 0.0


def oval_axis(seed: int, heading_rad: float) -> Array:
    """Unit vector (3,) of the ball's long axis, held by somebody who faces a heading."""
    tilt = float(_rng(seed, 5).uniform(0.2, 1.3))
    return np.array(
        [np.cos(heading_rad) * np.cos(tilt), np.sin(heading_rad) * np.cos(tilt), np.sin(tilt)]
    )


def bow_m(switches: frozenset[str], seed: int, x: Array, y: Array) -> Array:
    """Height (...) of the floor above level at x, y (metres from the mark)."""
    height_m = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
    if SLOPE in switches:
        rng = _rng(seed, 11)
        slope, turn = rng.uniform(0.0, _SLOPE), rng.uniform(0.0, 2.0 * np.pi)
        height_m += slope * (np.cos(turn) * x + np.sin(turn) * y)
    if FLOOR not in switches:
        return height_m
    rng = _rng(seed, 6)
    turn, phase, wave = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6), rng.uniform(3.0, 4.5)
    along = np.cos(turn) * x + np.sin(turn) * y
    across = -np.sin(turn) * x + np.cos(turn) * y
    shape = np.cos(2.0 * np.pi * along / wave + phase) - np.cos(phase)
    return height_m + float(rng.choice([-1.0, 1.0])) * _BOW_M * (shape + 0.15 * across**2)


_ALONG_HOOK_M, _ACROSS_HOOK_M = 2e-3, 5e-4
"""Largest shifts of the string on its hook, a bent wire, from one height to another."""
_BALANCE_M = 7e-4
"""Standard deviation of a ball's middle from where its weight hangs, along each axis; the direction
turns with the string."""
_HOOK_HEIGHTS_M, _SWINGS_M = (2.2, 3.0), (5e-4, 8e-3)
"""Ends of the hook's height, and of the amplitude with which a hanging ball still swings."""
_GRAVITY_M_S2 = 9.81


def hung_m(seed: int, stated_mm: int, height_m: float, time_s: float) -> Array:
    """x, y (2,) of a ball's centre from below the hook on which it hangs."""
    once, rng = _rng(seed, 10), _rng(seed, 8, stated_mm)
    string_m = once.uniform(*_HOOK_HEIGHTS_M) - height_m
    wire, off_m = once.uniform(0.0, 2.0 * np.pi), once.normal(0.0, _BALANCE_M, 2)
    slid_m = rng.uniform(-1.0, 1.0, 2) * (_ALONG_HOOK_M, _ACROSS_HOOK_M)
    turn, phase, twist = rng.uniform(0.0, 2.0 * np.pi, 3)
    # A swing is an ellipse: the ball was let go with a push to one side.
    wave = np.sqrt(_GRAVITY_M_S2 / string_m) * time_s + phase
    ellipse = np.array([np.sin(wave), rng.uniform(-0.5, 0.5) * np.cos(wave)])
    swing_m = rng.uniform(*_SWINGS_M) * ellipse
    return np.asarray(_turned(wire) @ slid_m + _turned(twist) @ off_m + _turned(turn) @ swing_m)


def _turned(angle_rad: float) -> Array:
    """Rotation (2, 2) about the vertical."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


_ZERO_PLANE_M, _PIXEL_MM, _EMITTER_CM = 1.2, 0.1042, 7.5
"""libfreenect's zero-plane constants: reference distance, pixel size and baseline."""


_PLANE_ENDS_M, _PIXEL_ENDS_MM = 4e-3, 1.5e-4
"""Largest differences of a unit's constants."""


@dataclass(frozen=True, slots=True)
class ZeroPlane:
    """One unit's constants of libfreenect's law: 1/z is linear in the raw value.

    z = z0 b / (b - m) with m = ((raw - 800) / 4 - 0.375) p (libfreenect, registration.c).
    """

    distance_m: float = _ZERO_PLANE_M
    pixel_mm: float = _PIXEL_MM

    def raw(self, depth_m: Array) -> Array:
        """Raw values (not rounded) of depths."""
        metric = _EMITTER_CM * (1.0 - self.distance_m / depth_m)
        return np.asarray(4.0 * (metric / self.pixel_mm + 0.375) + 800.0)


def zero_plane(switches: frozenset[str], seed: int, unit: int) -> ZeroPlane | None:
    """A unit's own law, where it is not the tangent law."""
    if RAW_LAW not in switches:
        return None
    off = _rng(seed, 7, unit).uniform(-1.0, 1.0, 2)
    return ZeroPlane(
        _ZERO_PLANE_M + _PLANE_ENDS_M * float(off[0]), _PIXEL_MM + _PIXEL_ENDS_MM * float(off[1])
    )
