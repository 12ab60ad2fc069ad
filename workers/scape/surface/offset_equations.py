"""Normal equations of the offsets (P, 3) of all vertices, and their solution (numba).

A row says that the offset at a place of the surface is r along a unit direction n:

    n . sum_c b_c d_c = r,       weight w,

with b the barycentric weights of the place in its triangle. The rows' matrix has a 3 x 3 block for
each pair of vertices that share a triangle; the prior couples each coordinate on its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel
from workers.scape.surface.attachment import Attachments
from workers.scape.surface.offset_prior import OffsetPrior

Array = NDArray[np.float64]
Index = NDArray[np.integer]

_MAX_STEPS = 400


@dataclass(frozen=True, slots=True)
class OffsetRows:
    """n rows."""

    at: Attachments
    direction: Array
    """(n, 3), unit."""
    residual_m: Array
    """(n,): r."""
    weight: Array
    """(n,): one over the variance, times the share with which the row counts."""

    @classmethod
    def joined(cls, *rows: OffsetRows) -> OffsetRows:
        """All rows of several sets."""
        return cls(
            Attachments.joined(*(one.at for one in rows)),
            np.concatenate([one.direction for one in rows]),
            np.concatenate([one.residual_m for one in rows]),
            np.concatenate([one.weight for one in rows]),
        )


@dataclass(frozen=True, slots=True)
class _Pattern:
    """Pairs of vertices that share an edge, and each vertex with itself, in compressed rows.

    Places are unsigned: the compiler then leaves out what makes a negative one count from the end.
    """

    first: NDArray[np.uint32]
    """(P + 1,)."""
    columns: NDArray[np.uint32]
    """(b,)."""
    of_triangle: Index
    """(K, 3, 3): the pair of each two of a triangle's corners."""


def solved(
    model: BodyModel,
    prior: OffsetPrior,
    sigma_m: Array,
    rows: OffsetRows,
    start: Array,
    enough: float,
) -> Array:
    """Offsets (P, 3) that minimise the rows' weighted squares plus the prior's.

    Preconditioned conjugate gradients (Hestenes & Stiefel 1952) with the 3 x 3 blocks of the
    diagonal: where there are data they settle in a few steps.

    Args:
        sigma_m: (P,), standard deviation of the offsets in the prior.
        start: (P, 3), offsets to start from.
        enough: squared residual, in the preconditioner's norm, at which to stop: about the energy
            that is still to be gained. An energy and no share of one, since the share would solve
            people near the model to micrometres and others to millimetres.
    """
    pattern = _pattern(model)
    blocks, right = _assembled(
        rows.at.triangle, rows.at.weights, rows.direction, rows.residual_m, rows.weight,
        model.faces, pattern.of_triangle, len(pattern.columns), model.vertex_count,
    )  # fmt: skip
    return np.asarray(
        _conjugate_gradients(
            pattern.first, pattern.columns, prior.operator.data,
            prior.tau_square(sigma_m) / prior.area_m2, blocks, right, start, enough, _MAX_STEPS,
        )
    )  # fmt: skip


@lru_cache(maxsize=2)
def _pattern(model: BodyModel) -> _Pattern:
    linked = (model.adjacency + sp.identity(model.vertex_count)).tocsr()
    linked.sort_indices()
    numbered = sp.csr_matrix(
        (np.arange(1, linked.nnz + 1), linked.indices, linked.indptr), shape=linked.shape
    )
    one = np.repeat(model.faces, 3, axis=1).ravel()
    other = np.tile(model.faces, (1, 3)).ravel()
    pair = np.asarray(numbered[one, other]).ravel().astype(np.int64) - 1
    return _Pattern(
        linked.indptr.astype(np.uint32), linked.indices.astype(np.uint32), pair.reshape(-1, 3, 3)
    )


@numba.njit(cache=True, nogil=True)
def _assembled(  # type: ignore[no-untyped-def]  # pragma: no cover
    triangle, weights, direction, residual, information, faces, of_triangle, size, count
):
    """Blocks (b, 6), upper triangles of symmetric 3 x 3 ones, and the right-hand side (P, 3)."""
    blocks, right = np.zeros((size, 6)), np.zeros((count, 3))
    for p in range(len(triangle)):
        k = triangle[p]
        x, y, z = direction[p, 0], direction[p, 1], direction[p, 2]
        for i in range(3):
            strength = weights[p, i] * information[p]
            if strength == 0.0:
                continue
            out, pull = right[faces[k, i]], strength * residual[p]
            out[0] += pull * x
            out[1] += pull * y
            out[2] += pull * z
            for j in range(3):
                share = strength * weights[p, j]
                block = blocks[of_triangle[k, i, j]]
                block[0] += share * x * x
                block[1] += share * x * y
                block[2] += share * x * z
                block[3] += share * y * y
                block[4] += share * y * z
                block[5] += share * z * z
    return blocks, right


@numba.njit(cache=True, nogil=True)
def _conjugate_gradients(  # type: ignore[no-untyped-def]  # pragma: no cover
    first, columns, operator, scale, blocks, right, start, enough, most
):
    count = len(right)
    inverse = _inverse_diagonal(first, columns, operator, scale, blocks)
    data = _with_data(first, columns, blocks)
    found = start.copy()
    product, residual = np.empty((count, 3)), np.empty((count, 3))
    conditioned = np.empty((count, 3))
    _multiply(first, columns, operator, scale, data, found, conditioned, product)
    for v in range(count):
        for i in range(3):
            residual[v, i] = right[v, i] - product[v, i]
    strength = _precondition(inverse, residual, conditioned)
    direction = conditioned.copy()
    for _ in range(most):
        if strength <= enough:
            break
        _multiply(first, columns, operator, scale, data, direction, conditioned, product)
        along = 0.0
        for v in range(count):
            for i in range(3):
                along += direction[v, i] * product[v, i]
        step = strength / along
        for v in range(count):
            for i in range(3):
                found[v, i] += step * direction[v, i]
                residual[v, i] -= step * product[v, i]
        following = _precondition(inverse, residual, conditioned)
        share = following / strength
        strength = following
        for v in range(count):
            for i in range(3):
                direction[v, i] = conditioned[v, i] + share * direction[v, i]
    return found


@numba.njit(cache=True, nogil=True)
def _with_data(first, columns, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The blocks that are not 0, a third of all: where each row's begin (P + 1,), columns, blocks.

    Skin that no camera saw has none.
    """
    starts = np.zeros_like(first)
    kept = np.empty_like(columns)
    filled = np.empty_like(blocks)
    size = np.uint32(0)
    for v in range(len(first) - 1):
        for index in range(first[v], first[v + 1]):
            # The trace: each row adds to it.
            if blocks[index, 0] + blocks[index, 3] + blocks[index, 5] != 0.0:
                kept[size] = columns[index]
                # Assigning a row takes 4 s to compile.
                for i in range(6):
                    filled[size, i] = blocks[index, i]
                size += np.uint32(1)
        starts[v + 1] = size
    return starts, kept[:size].copy(), filled[:size].copy()


@numba.njit(cache=True, nogil=True)
def _inverse_diagonal(  # type: ignore[no-untyped-def]  # pragma: no cover
    first, columns, operator, scale, blocks
):
    """(P, 6): inverses of the diagonal's symmetric 3 x 3 blocks, by their cofactors."""
    count = len(first) - 1
    inverse = np.empty((count, 6))
    for v in range(count):
        prior = 0.0
        for index in range(first[v], first[v + 1]):
            prior += scale[columns[index]] * operator[index] ** 2
        for index in range(first[v], first[v + 1]):
            if columns[index] == v:
                block = blocks[index]
                a, b, c = block[0] + prior, block[1], block[2]
                d, e, f = block[3] + prior, block[4], block[5] + prior
        minor_a, minor_b, minor_c = d * f - e * e, c * e - b * f, b * e - c * d
        determinant = a * minor_a + b * minor_b + c * minor_c
        inverse[v, 0], inverse[v, 1], inverse[v, 2] = minor_a, minor_b, minor_c
        inverse[v, 3], inverse[v, 4] = a * f - c * c, b * c - a * e
        inverse[v, 5] = a * d - b * b
        for i in range(6):
            inverse[v, i] /= determinant
    return inverse


@numba.njit(cache=True, nogil=True)
def _precondition(inverse, values, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Multiply (P, 3) by the blocks, and return the product's scalar product with the values."""
    total = 0.0
    for v in range(len(values)):
        x, y, z = values[v, 0], values[v, 1], values[v, 2]
        block = inverse[v]
        out[v, 0] = block[0] * x + block[1] * y + block[2] * z
        out[v, 1] = block[1] * x + block[3] * y + block[4] * z
        out[v, 2] = block[2] * x + block[4] * y + block[5] * z
        total += out[v, 0] * x + out[v, 1] * y + out[v, 2] * z
    return total


@numba.njit(cache=True, nogil=True)
def _multiply(  # type: ignore[no-untyped-def]  # pragma: no cover
    first, columns, operator, scale, data, values, between, out
):
    """The equations' matrix times values (P, 3).

    The prior's part is the operator (symmetric), a scale (P,) and the operator again: its product
    has three times the entries.
    """
    for v in range(len(values)):
        x, y, z = 0.0, 0.0, 0.0
        for index in range(first[v], first[v + 1]):
            other, factor = columns[index], operator[index]
            x += factor * values[other, 0]
            y += factor * values[other, 1]
            z += factor * values[other, 2]
        between[v, 0], between[v, 1], between[v, 2] = scale[v] * x, scale[v] * y, scale[v] * z
    starts, other_with_data, blocks = data
    for v in range(len(values)):
        x, y, z = 0.0, 0.0, 0.0
        for index in range(first[v], first[v + 1]):
            other, factor = columns[index], operator[index]
            x += factor * between[other, 0]
            y += factor * between[other, 1]
            z += factor * between[other, 2]
        for index in range(starts[v], starts[v + 1]):
            other, block = other_with_data[index], blocks[index]
            a, b, c = values[other, 0], values[other, 1], values[other, 2]
            x += block[0] * a + block[1] * b + block[2] * c
            y += block[1] * a + block[3] * b + block[4] * c
            z += block[2] * a + block[4] * b + block[5] * c
        out[v, 0], out[v, 1], out[v, 2] = x, y, z
