"""The ball's path through the booth as a uniform cubic B-spline in time.

Cameras run free, so no two see the ball at one moment. A continuous path (Furgale, Barfoot &
Sibley 2012) can be evaluated at the time of every frame, and a camera's clock offset is an
ordinary parameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

KNOT_S = 0.1
"""A hand's motion is smooth over this time: at 1 Hz and 50 mm a cubic is off by 0.02 mm."""
ACCELERATION_M_S2 = 5.0
"""Standard deviation that is assumed of a hand; carries the path over gaps."""
_BASIS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0


@dataclass(frozen=True, slots=True)
class TimeGrid:
    """Uniform knots from start_s on; control point j weighs on (j - 3 .. j + 1) knots."""

    start_s: float
    count: int
    """Control points."""
    knot_s: float = KNOT_S

    @classmethod
    def over(cls, times_s: Array, knot_s: float = KNOT_S) -> TimeGrid:
        """Knots that cover all times and a margin of `KNOT_S`."""
        start = float(times_s.min()) - KNOT_S
        count = int(np.ceil((times_s.max() + KNOT_S - start) / knot_s)) + 3
        return cls(start, count, knot_s)

    def basis(self, times_s: Array) -> tuple[Indices, Array, Array]:
        """First control point (n,), weights (n, 4) of it and the next three, and their rates."""
        x = (times_s - self.start_s) / self.knot_s
        first = np.clip(np.floor(x), 0, self.count - 4).astype(np.int64)
        s = x - first
        one = np.ones_like(s)
        powers = np.stack([one, s, s**2, s**3], axis=1)
        rates = np.stack([0 * s, one, 2 * s, 3 * s**2], axis=1) / self.knot_s
        return first, powers @ _BASIS, rates @ _BASIS

    def smoothness(self) -> Array:
        """Upper band (3, count) of the acceleration's information, one axis."""
        band = np.zeros((3, self.count))
        weight = self.knot_s**-4 / ACCELERATION_M_S2**2
        for offset, values in ((0, (1.0, 4.0, 1.0)), (1, (-2.0, -2.0)), (2, (1.0,))):
            for place, value in enumerate(values):
                start = place + offset
                band[2 - offset, start : start + self.count - 2] += weight * value
        return band

    def fit(self, times_s: Array, points: Array, weights: Array) -> Array:
        """Control points (count, 3) of least weighted squares through points (n, 3)."""
        first, value, _ = self.basis(times_s)
        band = np.zeros((4, self.count))
        band[1:] += self.smoothness()
        right = np.zeros((self.count, 3))
        for i in range(4):
            np.add.at(right, first + i, (weights * value[:, i])[:, None] * points)
            for j in range(i, 4):
                np.add.at(band[3 - (j - i)], first + j, weights * value[:, i] * value[:, j])
        band[3] += 1e-6 * self.smoothness()[2, 0]
        return np.asarray(cho_solve_banded((cholesky_banded(band), False), right))


def path_points(controls: Array, first: Indices, weights: Array) -> Array:
    """Points (n, 3) on the path of control points (count, 3), by ``TimeGrid.basis``."""
    return np.einsum("nk,nki->ni", weights, controls[first[:, None] + np.arange(4)])
