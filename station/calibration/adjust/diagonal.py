"""Evidence of a quadratic after a change of a few diagonal entries."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def evidence_changes(
    spread: Array, step: Array, values: Array, before: Array, after: Array
) -> Array:
    """Changes (n,) of g^T H^-1 g / 2 - log|H| / 2 where a diagonal prior is exchanged.

    The prior of the information p about the deviations v has p on the diagonal of H and p v in g.
    With the few entries d of the change, both follow from matrices of their number (the matrix
    determinant lemma, and Woodbury's identity), ten times as fast as a factorisation.

    Args:
        spread: (m, m), H^-1 before the change.
        step: (m,), H^-1 g before it.
        values: (m,), v.
        before: (m,), p before the change.
        after: (n, m), p after each of n changes.
    """
    return np.asarray(_changes(spread, step, values, before, after))


@numba.njit(cache=True, nogil=True)
def _changes(spread, step, values, before, after):  # type: ignore[no-untyped-def]  # pragma: no cover
    count, size = after.shape
    found = np.zeros(count)
    index = np.empty(size, np.int64)
    d, pull, y, z = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    matrix = np.empty((size, size))
    for n in range(count):
        k = 0
        for i in range(size):
            if after[n, i] != before[i]:
                index[k], d[k] = i, after[n, i] - before[i]
                pull[k] = d[k] * values[i]
                k += 1
        for a in range(k):
            y[a] = step[index[a]]
            for b in range(k):
                s = spread[index[a], index[b]]
                y[a] += s * pull[b]
                matrix[a, b] = s * d[b]
            matrix[a, a] += 1.0
            z[a] = y[a]
            found[n] += 0.5 * pull[a] * (step[index[a]] + y[a])
        found[n] -= 0.5 * _eliminated(matrix, z, k)
        for a in range(k):
            found[n] -= 0.5 * y[a] * d[a] * z[a]
    return found


@numba.njit(cache=True, nogil=True)
def _eliminated(matrix, right, size):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Solve for the right-hand side in place, by Gauss with pivots; log|determinant|."""
    log = 0.0
    for a in range(size):
        top = a
        for b in range(a + 1, size):
            if abs(matrix[b, a]) > abs(matrix[top, a]):
                top = b
        if top != a:
            for c in range(a, size):
                matrix[a, c], matrix[top, c] = matrix[top, c], matrix[a, c]
            right[a], right[top] = right[top], right[a]
        log += np.log(abs(matrix[a, a]))
        for b in range(a + 1, size):
            share = matrix[b, a] / matrix[a, a]
            for c in range(a + 1, size):
                matrix[b, c] -= share * matrix[a, c]
            right[b] -= share * right[a]
    for a in range(size - 1, -1, -1):
        for b in range(a + 1, size):
            right[a] -= matrix[a, b] * right[b]
        right[a] /= matrix[a, a]
    return log
