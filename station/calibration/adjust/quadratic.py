"""The squared deviations about a solution, a quadratic, without priors whose widths are uncertain.

These are added for each choice of widths (`station.calibration.adjust.averaging`): where a few
entries of the diagonal differ, the evidence follows from that of another choice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.contacts import Belief, Contacts
from station.calibration.adjust.priors import priors, shape_precision, slope_sigma
from station.calibration.adjust.problem import Indices, Layout, Problem, State
from station.calibration.adjust.widths import BOW, CLASSES, RADIUS, SENSOR

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Quadratic:
    """The squared deviations about a state, without its uncertain priors."""

    cameras: tuple[str, ...]
    information: Array
    gradient: Array
    values: Array
    """(m,) deviations of the unknowns from their prior means."""
    groups: dict[str, list[Indices]]
    """Unknowns of each class, one group a camera, or a single one."""
    fields: list[Indices]
    field_precision: Array
    shape: Indices
    shape_precision: Array
    radius_m: float
    slope_sigma: Array
    """(9,) that a sloping floor adds to its bow."""
    log_belief: float = 0.0
    """Log-probability of a belief and of what it says of the contacts at the state."""

    @classmethod
    def of(cls, problem: Problem, state: State) -> Quadratic:
        layout, model = Layout.of(problem), problem.model
        information, gradient = state.information.copy(), state.gradient.copy()
        values = np.zeros(layout.size)
        for prior in priors(problem, layout, state):
            values[prior.index] = prior.values
        groups: dict[str, list[Indices]] = {name: [] for name in CLASSES}
        fields = []
        for name in problem.cameras:
            index = layout.sensor(name)
            gain, focal, cx, cy, k1, flat = index[model.widths_at]
            members = ((gain,), (focal,), (cx, cy), (k1,), (flat,))
            for group, of_group in zip(SENSOR, members, strict=True):
                groups[group].append(np.array(of_group))
            fields.append(index[model.field_start :])
        groups[RADIUS], groups[BOW] = [layout.radius], [layout.bow]
        certain = np.setdiff1d(
            np.arange(layout.size),
            np.concatenate([*(g for own in groups.values() for g in own), *fields, layout.shapes]),
        )
        kept = np.isin(np.arange(layout.size), certain)
        for prior in priors(problem, layout, state):
            uncertain = ~kept[prior.index]
            block = prior.information * uncertain[:, None] * uncertain
            information[np.ix_(prior.index, prior.index)] -= block
            gradient[prior.index] -= block @ prior.values
        return cls(
            tuple(problem.cameras), information, gradient, values, groups, fields,
            model.field_precision, layout.shapes, shape_precision(problem, layout),
            problem.radius_m, slope_sigma(problem),
        )  # fmt: skip

    @cached_property
    def inner(self) -> Indices:
        """Unknowns whose widths are chosen."""
        return np.concatenate([group for own in self.groups.values() for group in own])

    @cached_property
    def outer(self) -> Indices:
        """All others, depth fields and ball shape among them."""
        return np.setdiff1d(np.arange(len(self.gradient)), self.inner)

    @cached_property
    def outer_information(self) -> Array:
        """The outer unknowns' information, without the priors of depth fields and ball shape."""
        return self.information[np.ix_(self.outer, self.outer)]

    @cached_property
    def mixed_information(self) -> Array:
        """Outer by inner unknowns."""
        return self.information[np.ix_(self.outer, self.inner)]

    def under(self, contacts: Contacts, belief: Belief) -> Quadratic:
        """The same under a belief on the contacts, which the solution weighs otherwise."""
        expected, off_m, rows = contacts.covariance(belief), contacts.off_m, contacts.rows
        weight = np.linalg.inv(expected)
        log = float(np.log(belief.probability)) - 0.5 * float(np.linalg.slogdet(expected)[1])
        return replace(
            self,
            information=self.information + rows.T @ (weight - np.diag(contacts.weight)) @ rows,
            gradient=self.gradient + rows.T @ (weight @ off_m - contacts.weight * off_m),
            log_belief=log - 0.5 * float(off_m @ weight @ off_m),
        )


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
