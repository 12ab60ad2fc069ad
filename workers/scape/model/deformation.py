"""Edges of a triangle mesh, and vertices from transformed edges.

SCAPE (Anguelov et al. 2005) transforms the edges of every triangle and solves for the vertices
whose edges are nearest to them in area-weighted least squares. With all three edges of a triangle
the normal matrix is a weighted graph Laplacian L, which depends only on the template and is
factored once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from cholespy import CholeskySolverD, MatrixType
from numpy.typing import NDArray

from workers.scape.model import kernels

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
Graph = tuple[NDArray[np.int32], NDArray[np.int32]]
"""Start of each vertex's neighbours (P + 1,), and all neighbours."""

_PINNED = 0
"""Vertex at the origin of solutions, since a Laplacian leaves the translation free."""
_COLUMNS_AT_ONCE = 16
"""Right-hand sides that are solved at once; more do not fit into the processor's cache."""
_MIN_AREA = 1e-2
"""Least weight of a triangle, as a share of the mean: slivers keep their vertices in place."""
_MIN_NORMAL_M2 = 1e-12
"""Guards the division by the length of a vertex normal."""


def area_vectors(vertices: Array, faces: Faces) -> Array:
    """Normals of the triangles (K, 3), of twice their areas' length.

    Raises:
        IndexError: a triangle refers to a vertex that does not exist.
    """
    # Compiled loops do not check bounds.
    if int(faces.max(initial=-1)) >= len(vertices):
        raise IndexError(f"triangles name vertex {faces.max()}; there are {len(vertices)}")
    return np.asarray(kernels.area_vectors(vertices, faces))


def triangle_areas(vertices: Array, faces: Faces) -> Array:
    """Areas (K,) in square metres."""
    return np.asarray(0.5 * np.linalg.norm(area_vectors(vertices, faces), axis=1))


def vertex_areas(vertices: Array, faces: Faces) -> Array:
    """A third of the areas of the triangles around each vertex, (P,) in square metres."""
    thirds = np.repeat(triangle_areas(vertices, faces) / 3.0, 3)
    return np.asarray(np.bincount(faces.ravel(), thirds, minlength=len(vertices)), np.float64)


def signed_volume(vertices: Array, faces: Faces) -> float:
    """Volume of a closed surface in cubic metres, positive for faces that point outwards."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ki,ki->", a, np.cross(b, c))) / 6.0


def vertex_normals(vertices: Array, faces: Faces) -> Array:
    """Area-weighted unit normals (P, 3), outwards for counter-clockwise faces."""
    normals = kernels.summed_at_corners(area_vectors(vertices, faces), faces, len(vertices))
    return np.asarray(
        normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), _MIN_NORMAL_M2)
    )


def neighbours(faces: Faces) -> Graph:
    """Graph of the vertices that edges join."""
    tail = np.concatenate([faces.ravel(), np.roll(faces, -1, axis=1).ravel()])
    head = np.concatenate([np.roll(faces, -1, axis=1).ravel(), faces.ravel()])
    graph = sp.csr_matrix((np.ones(len(tail), bool), (tail, head)))
    return graph.indptr, graph.indices


def edges(vertices: Array, faces: Faces) -> Array:
    """Three edges of every triangle (K, 3, 3): triangle, edge, coordinate."""
    corners = vertices[faces]
    return np.asarray(np.roll(corners, -1, axis=1) - corners)


@dataclass(frozen=True, slots=True)
class EdgeSolver:
    """Least-squares vertices of given edges: argmin_Y sum_k a_k sum_e |e_k - (y_j - y_i)|^2."""

    faces: Faces
    triangle_weights: Array
    """a_k: areas of the template's triangles, normalised to mean 1, (K,)."""
    incidence: sp.csr_matrix
    """(P, 3K): adjoint of the linear map from vertices to weighted edges."""
    laplacian: sp.csr_matrix
    """(P, P)."""
    solver: CholeskySolverD

    @classmethod
    def build(cls, vertices: Array, faces: Faces) -> EdgeSolver:
        """Factor the normal matrix of a template's triangles."""
        areas = triangle_areas(vertices, faces)
        weights = np.maximum(areas / areas.mean(), _MIN_AREA)
        count = len(vertices)
        tail = faces.ravel()
        head = np.roll(faces, -1, axis=1).ravel()
        column = np.arange(len(tail))
        weight = np.repeat(weights, 3)
        incidence = sp.csr_matrix(
            (np.r_[weight, -weight], (np.r_[head, tail], np.r_[column, column])),
            shape=(count, len(column)),
        )
        gradient = sp.csr_matrix(
            (
                np.r_[np.ones_like(weight), -np.ones_like(weight)],
                (np.r_[column, column], np.r_[head, tail]),
            ),
            shape=(len(column), count),
        )
        laplacian = (incidence @ gradient).tocsr()
        pinned = laplacian + sp.csr_matrix(([1.0], ([_PINNED], [_PINNED])), shape=laplacian.shape)
        coordinates = pinned.tocoo()
        solver = CholeskySolverD(
            count, coordinates.row, coordinates.col, coordinates.data, MatrixType.COO
        )
        return cls(faces, weights, incidence, laplacian, solver)

    def solve(self, right_hand_side: Array) -> Array:
        """Solve L x = b for columns (P, m); every column of x is 0 at the pinned vertex."""
        b = np.ascontiguousarray(right_hand_side, dtype=np.float64)
        x = np.empty_like(b)
        for start in range(0, b.shape[1], _COLUMNS_AT_ONCE):
            part = np.ascontiguousarray(b[:, start : start + _COLUMNS_AT_ONCE])
            solved = np.empty_like(part)
            self.solver.solve(part, solved)
            x[:, start : start + _COLUMNS_AT_ONCE] = solved
        x -= x[_PINNED].copy()
        return x

    def vertices(self, edges_: Array) -> Array:
        """Vertices (P, 3) whose edges are nearest to (K, 3, 3), with vertex 0 at the origin."""
        return self.solve(self.incidence @ edges_.reshape(-1, 3))

    def carried(self, surface: Array, matrices: Array) -> Array:
        """Vertices (P, 3) whose edges are nearest to a surface's transformed ones; vertex 0 at the
        origin.

        Args:
            surface: (P, 3).
            matrices: (K, 3, 3), which the edges of each triangle are multiplied by.
        """
        return self.solve(kernels.edge_sums(surface, self.faces, matrices, self.triangle_weights))
