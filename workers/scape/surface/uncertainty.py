"""Standard deviation of the surface at each vertex, in excess of an ordinary body's and scan's.

The errors of bodies of the model's own family, seen by all cameras, are known from held-out scans
(`workers.measure.intervals`). A scan adds to them where it shows more mismatch between the person
and the model than such bodies have, and where more of the skin is unseen. A share of the further
mismatch is left even where readings are; where there are none, it is the standard deviation of a
field at a distance s from where it is known, its correlation falling as exp(-s / range):

    u^2 = a^2 (1 - exp(-2 s / range)),

with a^2 the further mismatch around the vertex. Far from all readings it is not the skin alone that
is unknown but where the limb is; this grows with the distance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel
from workers.scape.surface.offset_prior import RANGE_M, OffsetPrior, offset_prior

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COMMON_SHARE = 0.2
"""Weight of the whole body's amplitude against that of fully seen surroundings."""
_FAMILY_MISMATCH_M = 0.0013
"""Mismatch of bodies of the model's own family (1.2 to 1.5 mm on validation bodies): noise of the
readings and what the components leave out. People whom the model does not know show 2 to 3 mm."""
_MAX_FURTHER_M = 0.0018
"""Largest further mismatch that counts, that of sculpted bodies (2.0 to 2.5 mm in all): the gains
are learned on these, and real people, who show 2.8 to 3.2 mm, are not measured worse."""
_LEFT_WHERE_SEEN = 0.35
"""Share of the further mismatch that is left where there are readings: folds that the cameras do
not see into leave about 1.2 mm of 3."""
_USUAL_GAP_M = 0.04
"""Unseen skin of an ordinary scan lies within this distance of seen skin."""
_DRIFT = 0.01
"""Growth of a limb's standard deviation with the distance from readings, beyond the field's range:
a joint that is known to 0.6 degrees."""
_HIDDEN_HEAD = 1.5
"""Standard deviation below hair per that of the head's top: where dark hair hides all but the face,
head girths of the model's own family err by 12 mm rms."""
_TOP_M = 0.05
"""Height of the top of the head, whose uncertainty counts by itself."""
_FARTHEST_M = 1.0
"""Distances to readings count up to this."""


def surface_sigma(
    model: BodyModel,
    seen: Mask,
    mismatch_m: Array,
    observed: Mask,
    noise_m: float = 0.0,
) -> Array:
    """Standard deviation (P,) along the normals, metres.

    Args:
        seen: (P,): readings lie on the vertex or next to it.
        mismatch_m: (P,): mean distance of the vertex's readings from the model's surface ...
        observed: (P,): ... where there were any.
        noise_m: standard deviation of the mismatch by noise beyond that of ordinary scans.
    """
    if not observed.any():
        return np.full(len(seen), _DRIFT * _FARTHEST_M)
    prior = offset_prior(model)
    away = np.minimum(prior.distance_m(seen), _FARTHEST_M)
    around = _amplitude_square(prior, mismatch_m, observed)
    usual2 = _FAMILY_MISMATCH_M**2 + noise_m**2
    further = np.clip(around - usual2, 0.0, _MAX_FURTHER_M**2)
    further *= _unknown_share(away) + _LEFT_WHERE_SEEN**2
    usual = model.vertex_sigma_m**2 * _unknown_share(np.maximum(away - _USUAL_GAP_M, 0.0))
    drift = _DRIFT * np.maximum(away - RANGE_M, 0.0)
    return np.asarray(np.sqrt(further + usual + drift**2))


def hidden_head_sigma(model: BodyModel, seen: Mask, crown_sigma_m: float) -> Array:
    """Standard deviation (P,) of a head below a top that no camera saw: hair hides its skin, too.

    Args:
        seen: (P,): readings lie on the vertex or next to it.
        crown_sigma_m: of the top; 0 where it was seen.
    """
    sigma_m = np.zeros(len(seen))
    if crown_sigma_m > 0.0 and seen.any():
        head = model.part_of_vertex == model.part_names.index("head")
        head &= model.mean[:, 2] < model.mean[head, 2].max() - _TOP_M
        away = offset_prior(model).distance_m(seen)[head]
        sigma_m[head] = _HIDDEN_HEAD * crown_sigma_m * np.sqrt(_unknown_share(away))
    return sigma_m


def _unknown_share(away_m: Array) -> Array:
    """Share of a field's variance that is left at distances from where it is known."""
    return np.asarray(1.0 - np.exp(-2.0 * away_m / RANGE_M))


def _amplitude_square(prior: OffsetPrior, mismatch_m: Array, observed: Mask) -> Array:
    """(P,): mean square of the mismatch around each vertex, drawn towards the whole body's."""
    weight = observed.astype(np.float64)
    common = float(np.mean(mismatch_m[observed] ** 2))
    around = prior.share_around(weight)
    total = prior.share_around(weight * mismatch_m**2)
    return np.asarray((total + _COMMON_SHARE * common) / (around + _COMMON_SHARE))
