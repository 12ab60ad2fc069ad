"""The one inner loop that numpy would pass over memory several times for: B, its value and its
derivative at every sample, in one pass (numba; each sample alone, so threads change nothing)."""

from __future__ import annotations

import numba
import numpy as np

# The layer that every wheel of numba brings; a process runs one job, so one caller is enough.
numba.config.THREADING_LAYER = "workqueue"  # type: ignore[attr-defined]  # set at run time


@numba.njit(cache=True, parallel=True, fastmath=True)
def value_and_derivative(  # type: ignore[no-untyped-def]  # pragma: no cover
    basis, coefficients, rotations, shapes, all_shapes, parts_out, by_field
):
    """Fill B_p(x) and dY/dx of some fields for every sample.

    Args:
        basis: (n, L, 3, F) float32.
        coefficients: (F,) float32.
        rotations: (L, 3, 3) float32.
        shapes: how many shape fields are wanted, of all_shapes that there are.
        parts_out: (n, L, 3) float32, out: B_p in the parts' own frames.
        by_field: (n, 3, shapes + F - 1 - all_shapes) float32, out: shapes, then twists.
    """
    count, parts, _, fields = basis.shape
    twist_start = 1 + all_shapes
    for v in numba.prange(count):
        by_field[v] = 0.0
        for p in range(parts):
            for c in range(3):
                row = basis[v, p, c]
                total = np.float32(0.0)
                for f in range(fields):
                    total += row[f] * coefficients[f]
                parts_out[v, p, c] = total
                for i in range(3):
                    turn = rotations[p, i, c]
                    out = by_field[v, i]
                    for f in range(shapes):
                        out[f] += turn * row[1 + f]
                    for f in range(fields - twist_start):
                        out[shapes + f] += turn * row[twist_start + f]
