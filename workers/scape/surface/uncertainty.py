"""The uncertainty of the surface at each vertex, from the scan itself.

Three things add up: the noise of the readings, a share of the mismatch between the person and the
model that is left even where readings are, and, where there are none, the field that nobody
measured. The last is the standard deviation of a field at a distance s from where it is known,
its correlation falling as exp(-s / range):

    u^2 = a^2 (1 - exp(-2 s / range)),

with a the amplitude of the mismatch around the vertex. Far from all readings it is not the skin
alone that is unknown but where the limb is; this grows with the distance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workers.scape.surface.offset_prior import RANGE_M, OffsetPrior

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COMMON_SHARE = 0.2
"""Weight of the whole body's amplitude against that of fully seen surroundings."""
_FAMILY_MISMATCH_M = 0.0012
"""Amplitude on the model's own bodies, whose errors the calibration of the intervals knows
already: 1.1 to 1.4 mm."""
_LEFT_WHERE_SEEN = 0.35
"""Share of a larger amplitude that is left where there are readings: of 2.9 to 3.8 mm on real
people, folds that the cameras do not see into leave about 1.2 mm."""
_DRIFT = 0.03
"""Growth of a limb's uncertainty with the distance from readings, beyond the field's range: a joint
that is known to 2 degrees."""
_FARTHEST_M = 1.0
"""Distances to readings count up to this."""


def surface_sigma(
    prior: OffsetPrior, seen: Mask, information: Array, mismatch_m: Array, observed: Mask
) -> Array:
    """Standard deviation (P,) along the normals, metres.

    Args:
        seen: (P,): readings lie on the vertex or next to it.
        information: (P,): sum of the inverse variances of its readings.
        mismatch_m: (P,): mean distance of its readings from the model's surface ...
        observed: (P,): ... where there were any.
    """
    if not observed.any():
        return np.full(len(seen), _DRIFT * _FARTHEST_M)
    away = np.minimum(prior.distance_m(seen), _FARTHEST_M)
    square = _amplitude_square(prior, mismatch_m, observed)
    unknown = square * (1.0 - np.exp(-2.0 * away / RANGE_M))
    left = _LEFT_WHERE_SEEN**2 * np.maximum(square - _FAMILY_MISMATCH_M**2, 0.0)
    drift = (_DRIFT * np.maximum(away - RANGE_M, 0.0)) ** 2
    noise = np.where(information > 0.0, 1.0 / np.where(information > 0.0, information, 1.0), 0.0)
    return np.asarray(np.sqrt(np.minimum(noise, square) + unknown + left + drift))


def _amplitude_square(prior: OffsetPrior, mismatch_m: Array, observed: Mask) -> Array:
    """(P,): mean square of the mismatch around each vertex, drawn towards the whole body's."""
    weight = observed.astype(np.float64)
    common = float(np.mean(mismatch_m[observed] ** 2))
    around = prior.share_around(weight)
    total = prior.share_around(weight * mismatch_m**2)
    return (total + _COMMON_SHARE * common) / (around + _COMMON_SHARE)
