"""Prior of the offset between a person's skin and the model's surface: a Matern field.

Each coordinate of the offset d (P, 3) is a Gaussian field on the template's surface whose
correlation falls to about 0.1 over a range. Its precision is that of the stochastic differential
equation (kappa^2 - Laplacian) d = noise in linear finite elements (Lindgren, Rue & Lindstrom 2011,
equation 10 with alpha = 2):

    Q = tau^2 (kappa^2 M + K) M^-1 (kappa^2 M + K),
    kappa = sqrt(8) / range,    tau^2 = 1 / (4 pi kappa^2 sigma^2),

with M the lumped areas, K the cotangent Laplacian and sigma the standard deviation of the offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from cholespy import CholeskySolverD, MatrixType
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces, vertex_areas

Array = NDArray[np.float64]

RANGE_M = 0.1
"""Distance at which offsets no longer tell of each other. Errors on real people hardly change
between 0.06 and 0.15 m."""
_KAPPA = np.sqrt(8.0) / RANGE_M
_COTANGENTS = (0.05, 5.0)
"""Cotangents are clipped to this: obtuse triangles would couple vertices negatively, slivers
infinitely."""
_MIN_AREA_M2 = 1e-8


@dataclass(frozen=True, eq=False)
class OffsetPrior:
    """The field on one template. P vertices."""

    operator: sp.csr_matrix
    """(P, P): kappa^2 M + K, with an entry for each vertex and for each edge."""
    area_m2: Array
    """(P,): the diagonal of M."""
    edge_lengths: sp.csr_matrix
    """(P, P), metres, on the mean body."""
    smoother: CholeskySolverD
    """Factor of kappa^2 M + K."""

    @classmethod
    def build(cls, vertices: Array, faces: Faces) -> OffsetPrior:
        """Assemble the operator on a template's mean body (P, 3)."""
        area = np.maximum(vertex_areas(vertices, faces), _MIN_AREA_M2)
        operator = (_KAPPA**2 * sp.diags(area) + _cotangent_laplacian(vertices, faces)).tocsr()
        operator.sort_indices()
        entries = operator.tocoo()
        smoother = CholeskySolverD(
            len(vertices), entries.row, entries.col, entries.data, MatrixType.COO
        )
        return cls(operator, area, _edge_lengths(vertices, faces), smoother)

    @staticmethod
    def tau_square(sigma_m: Array) -> Array:
        """(P,): tau^2 of a field with a standard deviation (P,) at each vertex."""
        return 1.0 / (4.0 * np.pi * _KAPPA**2 * sigma_m**2)

    def share_around(self, values: Array) -> Array:
        """(P,): means of values (P,) over the surroundings of each vertex, with the kernel
        kappa^2 (kappa^2 M + K)^-1 M, whose weights sum to 1 and fall off over the range."""
        right = np.ascontiguousarray(_KAPPA**2 * self.area_m2 * values)
        found = np.empty_like(right)
        self.smoother.solve(right, found)
        return found

    def distance_m(self, known: NDArray[np.bool_]) -> Array:
        """(P,): length of the shortest way along the edges to a vertex of a set (P,); infinite
        where there is none."""
        sources = np.flatnonzero(known)
        if not len(sources):
            return np.full(len(known), np.inf)
        return np.asarray(dijkstra(self.edge_lengths, indices=sources, min_only=True))


@lru_cache(maxsize=2)
def offset_prior(model: BodyModel) -> OffsetPrior:
    """The field on a model's mean body, which is the same for every scan."""
    return OffsetPrior.build(model.mean, model.faces)


def _cotangent_laplacian(vertices: Array, faces: Faces) -> sp.csr_matrix:
    """K (P, P) of linear finite elements (Pinkall & Polthier 1993)."""
    rows, columns, values = [], [], []
    for corner in range(3):
        start, stop = faces[:, (corner + 1) % 3], faces[:, (corner + 2) % 3]
        one, other = (
            vertices[start] - vertices[faces[:, corner]],
            (vertices[stop] - vertices[faces[:, corner]]),
        )
        area = np.linalg.norm(np.cross(one, other), axis=1)
        cotangent = np.einsum("ki,ki->k", one, other) / np.maximum(area, _MIN_AREA_M2)
        rows += [start, stop]
        columns += [stop, start]
        values += [0.5 * np.clip(cotangent, *_COTANGENTS)] * 2
    coupling = sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(vertices), len(vertices)),
    )
    return (sp.diags(np.asarray(coupling.sum(axis=1)).ravel()) - coupling).tocsr()


def _edge_lengths(vertices: Array, faces: Faces) -> sp.csr_matrix:
    """(P, P): each edge of a closed surface is met twice, once in either direction."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    length = np.linalg.norm(vertices[tail] - vertices[head], axis=1)
    return sp.csr_matrix((length, (tail, head)), shape=(len(vertices), len(vertices)))
