"""Widths (standard deviations) of the priors of sensor, ball and floor errors.

A class of errors is a gain, a lens parameter, a smooth depth field, the ball's radius, the
floor's bow. Its standard deviation is unknown itself: one of a few levels from that of a good
unit to that of the worst unit in use. The level is estimated from the data
(`station.calibration.adjust.averaging`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GAIN, FOCAL, CENTER, K1, FLATTENING = "gain", "focal", "center", "k1", "flattening"
SENSOR = (GAIN, FOCAL, CENTER, K1, FLATTENING)
"""Classes that each camera has a width of, in the order of the sensor's parameters."""
RADIUS, BOW = "radius", "bow"
CLASSES = (*SENSOR, RADIUS, BOW)
LENS = (FOCAL, CENTER, K1)
"""Classes whose widths have a prior in common, see `lens_log_prior`."""
_LEVELS = 4
_ENDS: Mapping[str, tuple[float, float]] = {
    GAIN: (3e-4, 4e-3),
    FOCAL: (3e-4, 3e-3),
    CENTER: (0.2, 2.0),
    K1: (2e-3, 4e-2),
    FLATTENING: (3e-4, 1e-2),
    RADIUS: (8e-4, 3e-3),
    BOW: (0.1, 1.0),
}
"""Standard deviations of sound units and of poor ones. Gain (relative): Kinects differ by some
0.03 %, the one of Khoshelham & Elberink (2012) was off by 0.2 %. Focal length (relative), centre
(px) and k1: what a checkerboard calibration repeats to, and what units differ by (Herrera, Kannala
& Heikkila 2012; Smisek, Jancosek & Pajdla 2011). Flattening (relative): a turned ball, and one made
for play. Radius (relative): half a millimetre of a circumference of 63 cm, as a tape shows it, is
0.08 %. Bow: a share of ``BOW_TOLERANCE``."""
_CAREFUL = {FOCAL: 5e-5, CENTER: 0.03, K1: 3e-4}
"""Standard deviations of a lens that was measured with care: what hundreds of images of a
checkerboard repeat to."""
BOW_TOLERANCE = np.array([1.2e-3] * 2 + [1.5e-3] * 3 + [0.7e-3] * 4)
"""Standard deviations of a bowed floor, metres at 1 m: DIN 18202 lets a finished floor be off by
4 mm over 1 m. A wave of 2 mm that is 4 m long leans by 1.2 mm over 1 m, rms, near its crest."""
FIELD_LEVELS = 6e-5 * 2.0 ** np.arange(6)
"""Standard deviations of the depth fields, 1/m: 0.2 mm to 6 mm at 1.8 m; after a polynomial
correction a Kinect's depth error leaves 2 mm (Herrera, Kannala & Heikkila 2012)."""
SHAPE_LEVELS = (3e-4, 1.4e-3, 6e-3)
"""Standard deviations of the coefficients of a ball's shape: a ball that is longer along one axis
by the share e has coefficients of 0.37 e, rms. Of a turned ball, and of one made for play (up to
1.6 %)."""
_SOUND = 0.6
"""Probability that a class is as in sound units, before anything is seen."""
_ALONE = 0.1
"""Probability that it is wrong in one camera alone."""
_KINDS: tuple[tuple[float, Mapping[str, tuple[float, ...]]], ...] = (
    (0.25, {FOCAL: (1.0, 0.0, 0.0, 0.0, 0.0), CENTER: (1.0, 0.0, 0.0, 0.0, 0.0),
            K1: (0.6, 0.4, 0.0, 0.0, 0.0)}),
    (0.35, {FOCAL: (0.0, 0.5, 0.3, 0.15, 0.05), CENTER: (0.0, 0.5, 0.3, 0.15, 0.05),
            K1: (0.4, 0.3, 0.15, 0.1, 0.05)}),
    (0.4, {FOCAL: (0.0, 0.05, 0.25, 0.35, 0.35), CENTER: (0.0, 0.05, 0.25, 0.35, 0.35),
           K1: (0.4, 0.15, 0.1, 0.15, 0.2)}),
)  # fmt: skip
"""Kinds of what drivers say of their lenses, and the probabilities of each parameter's levels:
measured on the unit with care; measured on it; measured on others of its type. Where the distortion
proves wrong, focal length and centre are hardly measured either; where it proves right, they may
still not be: many lenses hardly distort."""


def sound_level(name: str) -> int:
    """Level of a class in sound units: a lens may have been measured better than that."""
    return 1 if name in LENS else 0


def worst_level(name: str) -> int:
    """Level of a class in the worst units in use."""
    return sound_level(name) + _LEVELS - 1


def sigma(name: str, level: int) -> float:
    """Standard deviation of a class at a level, up to `worst_level`."""
    if level < sound_level(name):
        return _CAREFUL[name]
    low, high = _ENDS[name]
    return float(low * (high / low) ** ((level - sound_level(name)) / (_LEVELS - 1)))


@dataclass(frozen=True, slots=True)
class Widths:
    """One choice of levels."""

    sensors: Mapping[str, tuple[int, ...]]
    """Level of each class of ``SENSOR`` by camera."""
    field_per_m: float
    shape: float
    """Standard deviation of each coefficient of the ball's shape."""
    radius: int
    bow: int

    @classmethod
    def widest(cls, cameras: Iterable[str]) -> Widths:
        """The widest priors, for a first solution."""
        worst = tuple(worst_level(name) for name in SENSOR)
        return cls(
            dict.fromkeys(cameras, worst),
            float(FIELD_LEVELS[-1]),
            float(SHAPE_LEVELS[-1]),
            worst_level(RADIUS),
            worst_level(BOW),
        )

    def sensor(self, camera: str) -> Array:
        """Standard deviations (5,) of what each class of ``SENSOR`` is for a camera."""
        levels = self.sensors[camera]
        return np.array([sigma(name, level) for name, level in zip(SENSOR, levels, strict=True)])


@dataclass(frozen=True, slots=True)
class Option:
    """One assignment of levels to the cameras for a class, and its prior probability."""

    levels: tuple[int, ...]
    """Level of each camera; a single one of the ball or the floor."""
    log_prior: float


def width_options(name: str, cameras: int) -> tuple[Option, ...]:
    """All options of a class: one level for all cameras, or the widest level for one camera only.

    The first are the levels in all cameras, from the narrowest to the widest. A lens's options say
    nothing of their probabilities, which `lens_log_prior` does.
    """
    levels, lens = worst_level(name) + 1, name in LENS
    sound = (_SOUND, *([(1.0 - _SOUND) / (levels - 1)] * (levels - 1)))
    logs = np.zeros(levels) if lens else np.log(sound)
    if name in (RADIUS, BOW):
        return tuple(Option((level,), float(log)) for level, log in enumerate(logs))
    if not lens:
        logs += np.log(1.0 - _ALONE)
    shared = [Option((level,) * cameras, float(log)) for level, log in enumerate(logs)]
    one_alone = 0.0 if lens else float(np.log(_ALONE / cameras))
    alone = []
    for camera in range(cameras if cameras > 1 else 0):
        levels_of = [sound_level(name)] * cameras
        levels_of[camera] = worst_level(name)
        alone.append(Option(tuple(levels_of), one_alone))
    return (*shared, *alone)


def lens_log_prior(cameras: int) -> Array:
    """Log-probability (n, n, n) of the options of each class of ``LENS``.

    All cameras' lenses are of one of ``_KINDS``; or all are sound but one camera's.
    """
    levels, alone = _LEVELS + 1, cameras if cameras > 1 else 0
    share = np.zeros((levels + alone,) * len(LENS))
    for probability, of_kind in _KINDS:
        every = _product([np.array(of_kind[name]) for name in LENS])
        share[:levels, :levels, :levels] += probability * every
    share *= 1.0 - _ALONE if alone else 1.0
    # Of a single lens of its type only the worse half of the levels is told from a measured one.
    of_type = [np.array(_KINDS[-1][1][name]) for name in LENS]
    halves = [np.array([own[:3].sum(), own[3:].sum()]) for own in of_type]
    for camera in range(levels, levels + alone):
        share[np.ix_(*[[1, camera]] * len(LENS))] += _ALONE / alone * _product(halves)
    return np.asarray(np.log(np.maximum(share, _IMPOSSIBLE)))


_IMPOSSIBLE = 1e-30
"""A probability that no evidence makes up for, but of which there is a logarithm."""


def _product(shares: Sequence[Array]) -> Array:
    return np.asarray(np.einsum("i,j,k->ijk", *shares))
