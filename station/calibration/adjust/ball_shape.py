"""The shape of a ball that is not quite round, as a function of direction.

A ball of play is longer along one axis than along another by about a percent, and its axes turn
with the hand. Where the outward normal is n, its surface stands R n^T Q n higher than a sphere of
radius R, with a symmetric Q (3 x 3) of trace zero: five coefficients in an orthonormal basis of
such matrices, E_1 .. E_5.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHAPE = 5
"""Number of coefficients."""


def _basis() -> Array:
    found = np.zeros((SHAPE, 3, 3))
    found[0] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    found[1] = np.diag([-1.0, -1.0, 2.0]) / np.sqrt(6.0)
    for matrix, (a, b) in zip(found[2:], ((0, 1), (0, 2), (1, 2)), strict=True):
        matrix[a, b] = matrix[b, a] = np.sqrt(0.5)
    return found


_BASIS = _basis()


def shape_terms(normals: Array) -> Array:
    """n^T E_m n (..., 5) of unit normals (..., 3)."""
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    across, along = x * x, y * y
    terms = np.empty((*normals.shape[:-1], SHAPE))
    terms[..., 0] = (across - along) * np.sqrt(0.5)
    terms[..., 1] = (2.0 * z * z - across - along) / np.sqrt(6.0)
    terms[..., 2] = np.sqrt(2.0) * x * y
    terms[..., 3] = np.sqrt(2.0) * x * z
    terms[..., 4] = np.sqrt(2.0) * y * z
    return terms


def shape_turn(rotation: Array) -> Array:
    """Matrix (5, 5) that takes coefficients of frame b to frame a, with the rotation a_from_b."""
    turned = np.einsum("ij,mjk,lk->mil", rotation, _BASIS, rotation)
    return np.asarray(np.einsum("aij,bij->ab", _BASIS, turned))
