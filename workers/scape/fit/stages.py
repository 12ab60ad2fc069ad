"""The annealing of the joint fit: from few components and wide gates to all and narrow ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workers.scape.fit.sampling import COARSE_SAMPLES, FINE_SAMPLES

_EVERY = 1 << 20
"""Components: as many as the model has."""


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the annealing."""

    samples: int
    components: int
    gate_m: float
    angle_rad: float
    scale_m: float
    """Of the robust weight: residuals beyond it lose their pull."""
    row_share: float
    """What one row counts: neighbours share what the model cannot express. Low at first, so that
    the prior carries the face and the hands as they are to where they belong."""

    @property
    def coarse(self) -> bool:
        """Whether samples stand for the whole skin."""
        return self.samples == COARSE_SAMPLES

    @property
    def limits(self) -> dict[str, float]:
        """Of the correspondences."""
        return {"max_distance_m": self.gate_m, "max_angle_rad": self.angle_rad}


COARSE = (
    *(Stage(COARSE_SAMPLES, 6, 0.20, np.radians(75), 0.060, 0.06) for _ in range(4)),
    *(Stage(COARSE_SAMPLES, 16, 0.12, np.radians(65), 0.030, 0.06) for _ in range(4)),
    *(Stage(COARSE_SAMPLES, 40, 0.08, np.radians(55), 0.018, 0.06) for _ in range(3)),
)
MIDDLE = tuple(Stage(FINE_SAMPLES, _EVERY, 0.05, np.radians(45), 0.010, 0.06) for _ in range(2))
FINE = tuple(Stage(FINE_SAMPLES, _EVERY, 0.03, np.radians(40), 0.006, 0.60) for _ in range(3))
