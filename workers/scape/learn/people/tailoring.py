"""Bodies made to measure: the generator's parameters are changed until each body has given sizes.

Gauss-Newton, all bodies at once, from one finite-difference Jacobian for each sex and weight. Of
the many changes that give the sizes the smallest is taken, so that what no size speaks of stays as
it was drawn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from station.core.errors import InputError
from workers.measure.tracing import trace_all
from workers.scape.learn.people.shapes import (
    Shapes,
    base_label,
    is_asymmetric,
    is_of_face,
    ordinary,
)
from workers.scape.learn.people.survey import COMPARISONS, WAIST, Persons, Regression, surveyed
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_FREE_PHENOTYPES = {"muscle": 0.25, "weight": 0.25, "height": 0.25, "proportions": 0.3}
"""Phenotypes that may change, and the spread by which each of them does so readily."""
_LOCAL_SPREAD = 0.35
_SHIFT_SPREAD = 0.15
"""Spread of changes that shift one part of the body against another: they reach sizes by shapes
that no person has."""
_SCALE_SPREAD = 0.02
_SHIFTS = ("-trans-", "buttocks-volume", "pelvis-tone", "neck-back", "neck-double")
_MAX_LOCAL = 1.0
_SCALES = (0.9, 1.1)
_STEP = 0.3
"""Step of the finite differences, in spreads."""
_ROUNDS = 9
_UNMEASURED = 100.0
_TOLERANCE = 0.15
"""Tolerance of a size, in standard deviations of people alike in stature, waist and age."""
_MAX_CHANGE = 1.0
"""Spreads by which a round changes a parameter at most."""
_FATS = (-1.0, 0.8, 2.6)
"""Fat of the lean, the middle and the heavy reference body, in standard deviations."""
_HEIGHT = 0.33
"""The generator's height of the reference bodies: a man of 1.75 m, a woman of 1.60 m."""
_BATCH = 256


class Generator(Protocol):
    """Makes bodies of parameters."""

    labels: list[str]

    @property
    def template(self) -> BodyModel:
        """Topology, parts and landmarks."""
        ...

    def surveyed_vertices(self, shapes: Shapes) -> Array:
        """(n, P, 3), in the posture in which people are surveyed."""
        ...


def sizes_of(generator: Generator, shapes: Shapes) -> Array:
    """Sizes (n, D) in metres of bodies, in the order of COMPARISONS; NaN where there is none."""
    definitions = [comparison.definition for comparison in COMPARISONS]
    found = np.full((len(shapes), len(definitions)), np.nan)
    for rows in _batches(len(shapes)):
        for row, body in zip(rows, generator.surveyed_vertices(shapes.take(rows)), strict=True):
            try:
                traces = trace_all(generator.template, body, definitions)
            except InputError:
                continue
            found[row] = [trace.value_m for trace in traces]
    return found


@dataclass(frozen=True, slots=True)
class _Parameters:
    """The parameters that may change, as columns of an array."""

    labels: tuple[str, ...]
    """Local changes without their sides."""

    @classmethod
    def of(cls, labels: list[str]) -> _Parameters:
        free = {base_label(x) for x in labels if not (is_asymmetric(x) or is_of_face(x))}
        return cls(tuple(sorted(free)))

    @property
    def spreads(self) -> Array:
        """(K,): how readily each changes."""
        shifts = [any(word in label for word in _SHIFTS) for label in self.labels]
        local = np.where(shifts, _SHIFT_SPREAD, _LOCAL_SPREAD)
        return np.array([*_FREE_PHENOTYPES.values(), *local, _SCALE_SPREAD])

    def changed(self, shapes: Shapes, change: Array) -> Shapes:
        """Bodies whose parameters are changed by (n, K), within what the generator can do."""
        column = {name: i for i, name in enumerate((*_FREE_PHENOTYPES, *self.labels))}
        phenotypes = {
            key: np.clip(value + change[:, column[key]], 0.0, 1.0)
            if key in _FREE_PHENOTYPES
            else value
            for key, value in shapes.phenotypes.items()
        }
        local = {
            label: _within(value, change[:, column[base]])
            if (base := base_label(label)) in column and not is_asymmetric(label)
            else value
            for label, value in shapes.local_changes.items()
        }
        scale = np.clip(shapes.scale * np.exp(change[:, -1]), *_SCALES)
        return Shapes(phenotypes, local, scale)

    def room(self, shapes: Shapes, change: Array) -> NDArray[np.bool_]:
        """(n, K): whether a small change of this sign is possible."""
        few = np.sign(change) * 0.02 * self.spreads
        room = np.empty(change.shape, bool)
        moved = self.changed(shapes, few)
        for index, key in enumerate(_FREE_PHENOTYPES):
            room[:, index] = moved.phenotypes[key] != shapes.phenotypes[key]
        for index, base in enumerate(self.labels, start=len(_FREE_PHENOTYPES)):
            label = base if base in shapes.local_changes else f"r-{base}"
            room[:, index] = moved.local_changes[label] != shapes.local_changes[label]
        room[:, -1] = moved.scale != shapes.scale
        return room


def _within(value: Array, change: Array) -> Array:
    """A change ends at the limits, but never turns round what lies beyond them already."""
    limit = np.maximum(_MAX_LOCAL, np.abs(value))
    return np.clip(value + change, -limit, limit)


class Tailor:
    """Changes bodies until they have the sizes of persons."""

    def __init__(self, generator: Generator) -> None:
        self._generator = generator
        self._parameters = _Parameters.of(generator.labels)
        everyone = surveyed()
        self._tolerance = np.empty((2, len(COMPARISONS)))
        for sex in (0, 1):
            deviations = Regression.of(everyone.take(everyone.female == bool(sex))).deviations
            self._tolerance[sex] = _TOLERANCE * deviations.std(axis=0)
            # Stature and waist are what the others are judged by.
            fixed = self._tolerance[sex] < 1e-6
            self._tolerance[sex, fixed] = 0.002
        self._jacobians, self._reference_sizes = self._finite_differences()

    def _finite_differences(self) -> tuple[Array, Array]:
        """By sex and fat: change (2, F, D, K) of the sizes by a spread of each parameter, and the
        sizes (2, F, D) themselves.
        """
        spreads = self._parameters.spreads
        steps = np.concatenate([np.zeros((1, len(spreads))), _STEP * np.diag(spreads)])
        jacobians, sizes = [], []
        for sex in (0.0, 1.0):
            for fat in _FATS:
                one = ordinary(self._generator.labels, sex, fat, _HEIGHT)
                many = one.take(np.zeros(len(steps), np.intp))
                found = sizes_of(self._generator, self._parameters.changed(many, steps))
                jacobians.append(np.nan_to_num((found[1:] - found[0]).T / _STEP))
                sizes.append(found[0])
        by_sex = (2, len(_FATS), len(COMPARISONS))
        return np.reshape(jacobians, (*by_sex, -1)), np.reshape(sizes, by_sex)

    def _jacobian(self, persons: Persons) -> Array:
        """(n, D, K), between the references by the persons' waists."""
        found = np.empty((len(persons.age), *self._jacobians.shape[2:]))
        for index, (female, sizes) in enumerate(zip(persons.female, persons.sizes, strict=True)):
            sex = int(female)
            waists = self._reference_sizes[sex, :, WAIST]
            place = np.interp(sizes[WAIST], waists, np.arange(len(waists)))
            low = min(int(place), len(waists) - 2)
            share = place - low
            lower, upper = self._jacobians[sex, low], self._jacobians[sex, low + 1]
            found[index] = (1.0 - share) * lower + share * upper
        return found

    def fitted(self, shapes: Shapes, persons: Persons) -> tuple[Shapes, Array]:
        """Bodies with the sizes of persons (n,), and by how many tolerances they miss them (n,).

        A change that makes a body worse is taken back, and the next one is smaller.
        """
        tolerance = self._tolerance[persons.female.astype(np.intp)]
        jacobian = self._jacobian(persons) / tolerance[:, :, None]
        left = self._left(shapes, persons, tolerance)
        trust = np.full(len(shapes), _MAX_CHANGE)
        every = np.ones(jacobian.shape[::2], bool)
        for _ in range(_ROUNDS):
            room = self._parameters.room(shapes, self._smallest(jacobian, left, every))
            change = self._smallest(jacobian, left, room)
            largest = np.abs(change).max(axis=1)
            change *= np.minimum(1.0, trust / np.maximum(largest, 1e-9))[:, None]
            tried = self._parameters.changed(shapes, change * self._parameters.spreads)
            found = self._left(tried, persons, tolerance)
            # Broyden 1965: the Jacobian learns from what the change did.
            unforeseen = left - found - np.einsum("ndk,nk->nd", jacobian, change)
            size = np.square(change).sum(axis=1) + 1e-9
            jacobian += unforeseen[:, :, None] * (change / size[:, None])[:, None, :]
            better = np.square(found).sum(axis=1) < np.square(left).sum(axis=1)
            trust = np.where(better, np.minimum(1.5 * trust, _MAX_CHANGE), 0.4 * trust)
            shapes = shapes.replaced(better, tried)
            left = np.where(better[:, None], found, left)
        return shapes, np.sqrt(np.square(left).mean(axis=1))

    def _left(self, shapes: Shapes, persons: Persons, tolerance: Array) -> Array:
        """(n, D): what is missing, in tolerances; a size that cannot be taken is far off."""
        missing = (persons.sizes - sizes_of(self._generator, shapes)) / tolerance
        return np.nan_to_num(missing, nan=_UNMEASURED)

    @staticmethod
    def _smallest(jacobian: Array, wanted: Array, free: NDArray[np.bool_]) -> Array:
        """The least change (n, K) of the free parameters that gives what is wanted (n, D)."""
        mine = jacobian * free[:, None, :]
        normal = mine @ np.swapaxes(mine, 1, 2)
        normal += np.eye(wanted.shape[1])
        force = np.linalg.solve(normal, wanted[:, :, None])
        return np.asarray((np.swapaxes(mine, 1, 2) @ force)[:, :, 0])


def _batches(count: int) -> Iterator[NDArray[np.intp]]:
    for start in range(0, count, _BATCH):
        yield np.arange(start, min(start + _BATCH, count))
