"""How much of a measurement's line the cameras saw."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workers.measure.tracing import Trace

Array = NDArray[np.float64]
Basis = Literal["seen", "partly", "inferred"]
"""What a value rests on: skin that cameras saw, skin seen in part, or mostly the body model."""

SEEN_SHARE = 0.9
"""Share of a line that must have been seen for the basis "seen": a tenth of a girth is about what
an arm hides."""
INFERRED_SHARE = 0.5
"""Share below which the basis is "inferred"."""


def line_weights(places: Array, *, closed: bool) -> Array:
    """Share (n,) of a line's length that each of its points (n, 3) stands for; sums to 1.

    Half of both segments at a point belong to it. Points of a line without length share equally.
    """
    count = len(places)
    steps = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1)
    if not closed:
        steps[-1] = 0.0
    weights = 0.5 * (steps + np.roll(steps, 1))
    total = float(weights.sum())
    return np.full(count, 1.0 / count) if total <= 0.0 else np.asarray(weights / total)


def mean_along(trace: Trace, vertices: Array, values: Array) -> float:
    """Mean of vertex values (P,) along a row's line, weighted by length, on a body (P, 3)."""
    points = trace.points
    along = values[points.tail] + points.share * (values[points.head] - values[points.tail])
    return float(line_weights(points.on(vertices), closed=trace.closed) @ along)


def basis_of(trace: Trace, vertices: Array, seen: NDArray[np.bool_] | None) -> Basis:
    """Basis of a row.

    Args:
        vertices: (P, 3), the body that was traced.
        seen: (P,), vertices that cameras saw; None for a mesh that counts as exact.
    """
    if seen is None:
        return "seen"
    share = mean_along(trace, vertices, seen.astype(np.float64))
    if share >= SEEN_SHARE:
        return "seen"
    return "partly" if share >= INFERRED_SHARE else "inferred"
