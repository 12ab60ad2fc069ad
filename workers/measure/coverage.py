"""The basis of measurements: skin that cameras saw, or the body model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.measure.kinds import Quantity
from workers.measure.tracing import Trace
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]
Basis = Literal["seen", "partly", "inferred"]
"""Skin that cameras saw, skin seen in part, or mostly the body model."""

SEEN_SHARE = 0.9
"""Share of a line that must have been seen for the basis "seen"."""
INFERRED_SHARE = 0.5
"""Share below which the basis is "inferred"."""
_STEP_M = 0.01
"""Distance between the points of a line that are looked up on the skin."""
_BETWEEN_ENDS: frozenset[Quantity] = frozenset({"height", "distance", "breadth", "depth", "drop"})
"""Kinds of rows that depend only on the ends of their lines, which may run inside the body."""


@dataclass(frozen=True, slots=True)
class SeenSkin:
    """The skin of a scanned body, and how much of it was seen around each vertex."""

    vertices: Array
    """(P, 3), as scanned."""
    share: Array
    """(P,): share of a vertex and its neighbours that cameras saw."""
    tree: cKDTree

    @classmethod
    def build(cls, model: BodyModel, vertices: Array, seen: NDArray[np.bool_]) -> SeenSkin:
        """Skin of a body (P, 3) of which cameras saw some vertices (P,)."""
        known = seen.astype(np.float64)
        degree = np.asarray(model.adjacency.sum(axis=1)).ravel()
        share = (known + model.adjacency @ known) / (1.0 + degree)
        return cls(vertices, share, cKDTree(vertices, balanced_tree=False))

    def seen_along(self, trace: Trace) -> float:
        """Share of a row's line that cameras saw, by length; of its ends where only these count.

        Where a tape spans a hollow, the nearest skin counts.
        """
        places = trace.points.on(self.vertices)
        if trace.definition.quantity not in _BETWEEN_ENDS:
            places = _resampled(places, closed=trace.closed)
        return float(self.share[self.tree.query(places)[1]].mean())

    def basis(self, trace: Trace) -> Basis:
        """The basis of a row."""
        share = self.seen_along(trace)
        if share >= SEEN_SHARE:
            return "seen"
        return "partly" if share >= INFERRED_SHARE else "inferred"


def _resampled(places: Array, *, closed: bool) -> Array:
    """Evenly spaced points of a polyline (n, 3)."""
    line = np.concatenate([places, places[:1]]) if closed else places
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    wanted = np.linspace(0.0, along[-1], 1 + max(1, round(along[-1] / _STEP_M)))
    return np.stack([np.interp(wanted, along, line[:, i]) for i in range(3)], axis=1)
