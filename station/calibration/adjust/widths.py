"""Widths (standard deviations) of the priors of sensor, ball and floor errors.

A class of errors is a gain, a lens parameter, a smooth depth field, the ball's radius, the
floor's bow. Its standard deviation is unknown itself: one of a few levels from that of a good
unit to that of the worst unit in use. The level is estimated from the data
(`station.calibration.adjust.averaging`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
LEVELS = 4
_ENDS: Mapping[str, tuple[float, float]] = {
    GAIN: (3e-4, 4e-3),
    FOCAL: (3e-4, 3e-3),
    CENTER: (0.2, 2.0),
    K1: (2e-3, 4e-2),
    FLATTENING: (3e-4, 1e-2),
    RADIUS: (3e-4, 3e-3),
    BOW: (0.1, 1.0),
}
"""Standard deviations of sound units and of poor ones. Gain (relative): Kinects differ by some
0.03 %, the one of Khoshelham & Elberink (2012) was off by 0.2 %. Focal length (relative), centre
(px) and k1: what a checkerboard calibration repeats to, and what units differ by (Herrera, Kannala
& Heikkila 2012; Smisek, Jancosek & Pajdla 2011). Flattening and radius (relative): a turned ball,
and one made for play. Bow: a share of ``BOW_TOLERANCE``."""
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
_OWN_LENS = 0.4
"""Probability that what a driver says of its lens was measured on this unit, and not on its type:
where the distortion proves wrong, nobody measured focal length and centre either."""
_MEASURED = (0.5, 0.3, 0.15, 0.05)
"""Probabilities of the levels of each lens parameter that was measured on the unit, ..."""
_NOMINAL = {FOCAL: (0.05, 0.25, 0.35, 0.35), CENTER: (0.05, 0.25, 0.35, 0.35),
            K1: (0.5, 0.15, 0.15, 0.2)}  # fmt: skip
"""... and of those of a type: many of them hardly distort."""


def sigma(name: str, level: int) -> float:
    """Standard deviation of a class at a level, 0 (sound) to ``LEVELS`` - 1 (worst)."""
    low, high = _ENDS[name]
    return float(low * (high / low) ** (level / (LEVELS - 1)))


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
        worst = LEVELS - 1
        return cls(
            {name: (worst,) * len(SENSOR) for name in cameras},
            float(FIELD_LEVELS[-1]),
            float(SHAPE_LEVELS[-1]),
            worst,
            worst,
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

    The first is the narrowest, the ``LEVELS``-th the widest in all cameras. A lens's options say
    nothing of their levels, which `lens_log_prior` does.
    """
    sound = (_SOUND, *([(1.0 - _SOUND) / (LEVELS - 1)] * (LEVELS - 1)))
    shares = (1.0,) * LEVELS if name in LENS else sound
    if name in (RADIUS, BOW):
        return tuple(Option((level,), float(np.log(share))) for level, share in enumerate(shares))
    shared = [
        Option((level,) * cameras, float(np.log((1.0 - _ALONE) * share)))
        for level, share in enumerate(shares)
    ]
    alone = [
        Option(
            tuple(LEVELS - 1 if other == camera else 0 for other in range(cameras)),
            float(np.log(_ALONE / cameras)),
        )
        for camera in range(cameras if cameras > 1 else 0)
    ]
    return (*shared, *alone)


def lens_log_prior(cameras: int) -> Array:
    """Log-probability (n, n, n) of the levels of the options of each class of ``LENS``."""
    places = [[max(option.levels) for option in width_options(name, cameras)] for name in LENS]
    measured = [np.array(_MEASURED)[at] for at in places]
    nominal = [np.array(_NOMINAL[name])[at] for name, at in zip(LENS, places, strict=True)]
    both = [np.einsum("i,j,k->ijk", *shares) for shares in (measured, nominal)]
    return np.asarray(np.log(_OWN_LENS * both[0] + (1.0 - _OWN_LENS) * both[1]))
