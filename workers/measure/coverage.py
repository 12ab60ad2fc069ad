"""The basis of measurements: skin that cameras saw, or the body model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numba
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

    def seen_along(self, traces: Sequence[Trace]) -> Array:
        """Shares (n,) of rows' lines that cameras saw, by length; of their ends where only these
        count.

        Where a tape spans a hollow, the nearest skin counts.
        """
        lines = [self._looked_up(trace) for trace in traces]
        nearest = self.tree.query(np.concatenate(lines))[1]
        counts = np.array([len(line) for line in lines])
        return np.add.reduceat(self.share[nearest], np.cumsum(counts) - counts) / counts

    def _looked_up(self, trace: Trace) -> Array:
        """Places (n, 3) at which the skin of a row is looked up."""
        places = trace.points.on(self.vertices)
        if trace.definition.quantity in _BETWEEN_ENDS:
            return places
        return np.asarray(_evenly(places, trace.closed, _STEP_M))

    def bases(self, traces: Sequence[Trace]) -> list[Basis]:
        """The bases of some rows."""
        if not traces:
            return []
        return [
            "seen" if share >= SEEN_SHARE else "partly" if share >= INFERRED_SHARE else "inferred"
            for share in self.seen_along(traces)
        ]


@numba.njit(cache=True, nogil=True)
def _evenly(places, closed, step_m):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Evenly spaced points of a polyline (n, 3), about a step apart, ends included."""
    count = len(places)
    along = np.zeros(count + 1)
    for index in range(count):
        square = 0.0
        for i in range(3):
            square += (places[(index + 1) % count, i] - places[index, i]) ** 2
        along[index + 1] = along[index] + np.sqrt(square)
    length = along[count] if closed else along[count - 1]
    steps = max(1, int(np.rint(length / step_m)))
    out = np.empty((steps + 1, 3))
    at = 0
    for index in range(steps + 1):
        wanted = length * index / steps
        while at < count - 1 and along[at + 1] < wanted:
            at += 1
        share = (wanted - along[at]) / max(along[at + 1] - along[at], 1e-12)
        for i in range(3):
            start, end = places[at, i], places[(at + 1) % count, i]
            out[index, i] = start + min(share, 1.0) * (end - start)
    return out
