"""Mean and covariance of a mixture of normal distributions, which are added one by one.

Each takes tens of megabytes: none is kept.
"""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Mixture:
    """A mixture of distributions of m numbers, each under a key."""

    def __init__(self, size: int) -> None:
        self.top = -np.inf
        """The largest log-weight so far, to which all weights are relative."""
        self._first, self._second = np.zeros(size), np.zeros((size, size))
        self._of: dict[Hashable, tuple[float, Array]] = {}
        """Weight of each key, and the weighted sum of its means."""

    def add(self, key: Hashable, log_weight: float, mean: Array, covariance: Array) -> None:
        """Add a distribution with a mean (m,) and a covariance (m, m)."""
        if log_weight > self.top:
            fade = float(np.exp(self.top - log_weight))
            self._first *= fade
            self._second *= fade
            self._of = {of: (fade * weight, fade * sums) for of, (weight, sums) in self._of.items()}
            self.top = log_weight
        weight = float(np.exp(log_weight - self.top))
        self._first += weight * mean
        self._second += weight * (covariance + np.outer(mean, mean))
        so_far, sums = self._of.get(key, (0.0, np.zeros(len(mean))))
        self._of[key] = (so_far + weight, sums + weight * mean)

    def moments(self) -> tuple[Array, Array]:
        """Mean (m,) and covariance (m, m) of the mixture."""
        mean = self._first / self._whole()
        return mean, self._second / self._whole() - np.outer(mean, mean)

    def share(self, key: Hashable) -> tuple[float, Array]:
        """Probability of a key, and the mean (m,) under it; 0 where nothing was added to it."""
        weight, sums = self._of.get(key, (0.0, np.zeros(len(self._first))))
        return weight / self._whole(), sums / max(weight, np.finfo(float).tiny)

    def _whole(self) -> float:
        return sum(weight for weight, _ in self._of.values())
