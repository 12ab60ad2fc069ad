"""Spread of values some of which are wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NORMAL = 1.4826
"""Standard deviation of a normal distribution over the median of its sizes."""


def spread_of(values: NDArray[np.float64]) -> float:
    """Standard deviation of values (n,) around 0, by the median of their sizes: half of them may be
    wrong."""
    return _NORMAL * float(np.median(np.abs(values)))
