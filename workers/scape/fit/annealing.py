"""Schedule of the joint fit: from few shape components and wide gates to all and narrow ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workers.scape.fit.sampling import COARSE_SAMPLES, FINE_SAMPLES

_ALL_COMPONENTS = 1 << 20
"""More than any model has."""
_USUAL_SPREAD_M = 0.93e-3
"""With the points' noise 1.4 mm where ten frames are averaged: bodies of the model's own family
have 1.1 to 1.5 in the first fine step, sculpted ones 2.3 to 2.9. Of one frame alone 3.3: 2.9 to 3.2
and 3.6 to 4.0."""


@dataclass(frozen=True, slots=True)
class AnnealingStep:
    """Settings of one Gauss-Newton step."""

    samples: int
    """Number of sample vertices."""
    components: int
    """Number of shape components that are estimated."""
    gate_m: float
    """Largest distance of a correspondence."""
    angle_rad: float
    """Largest angle between the normals of a correspondence."""
    scale_m: float
    """Scale of the robust weight: larger residuals are weighted down."""
    row_share: float
    """Share with which a row counts, since neighbouring rows share the model's error. It is low at
    first, so that the prior keeps the face and the hands in shape while they move into place."""
    usual_spread_m: float = np.inf
    """Spread of the points' distances from the body, beyond their noise, up to which rows of points
    count so. Beyond it they count less, by its inverse: on a body that the model cannot follow
    neighbours have more error in common."""
    relaxation: float = 1.0
    """Factor of the body's step. Points are paired anew in every step, so that skin that slides
    along itself comes only a part of its way: longer steps (successive over-relaxation, Young 1954)
    bring it as far as twice as many would. The last step is a plain one, in which settles what the
    rows determine well."""

    @property
    def coarse(self) -> bool:
        """Whether sample vertices represent the whole surface."""
        return self.samples == COARSE_SAMPLES

    @property
    def limits(self) -> dict[str, float]:
        """Limits of the correspondences, as keyword arguments."""
        return {"max_distance_m": self.gate_m, "max_angle_rad": self.angle_rad}


COARSE = (
    *(AnnealingStep(COARSE_SAMPLES, 6, 0.20, np.radians(75), 0.060, 0.06) for _ in range(4)),
    *(AnnealingStep(COARSE_SAMPLES, 16, 0.12, np.radians(65), 0.030, 0.06) for _ in range(4)),
    *(AnnealingStep(COARSE_SAMPLES, 40, 0.08, np.radians(55), 0.018, 0.06) for _ in range(3)),
)
MIDDLE = tuple(
    AnnealingStep(FINE_SAMPLES, _ALL_COMPONENTS, 0.05, np.radians(45), 0.010, 0.06, relaxation=1.5)
    for _ in range(3)
)
FINE = tuple(
    AnnealingStep(
        FINE_SAMPLES, _ALL_COMPONENTS, 0.03, np.radians(40), 0.006, 1.2, _USUAL_SPREAD_M, relaxation
    )
    for relaxation in (2.0, 1.8, 1.0)
)
