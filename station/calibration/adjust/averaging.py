"""Bayesian model averaging over the widths (standard deviations) of the priors.

About a solution the squared deviations are quadratic, with information H and gradient b without the
uncertain priors. For a prior with information L the marginal likelihood of the data is, by
Laplace, log p = -(least of the quadratic) - log|H + L| / 2 + log|L| / 2 (MacKay 1992): the last two
terms are Occam's factor, which favours narrow priors unless the data contradict them. Means and
covariances of all choices are averaged with their evidence as weights (Hoeting et al. 1999), so
that the covariance includes the uncertainty about the widths.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from scipy.special import logsumexp

from station.calibration.adjust.contacts import Belief, Contacts, beliefs
from station.calibration.adjust.mixture import Mixture
from station.calibration.adjust.problem import Doubt, Layout, Problem, State, moved_state
from station.calibration.adjust.quadratic import Quadratic, evidence_changes
from station.calibration.adjust.widths import (
    BOW,
    BOW_TOLERANCE,
    CLASSES,
    FIELD_LEVELS,
    LENS,
    RADIUS,
    SENSOR,
    SHAPE_LEVELS,
    Option,
    Widths,
    lens_log_prior,
    sigma,
    sound_level,
    width_options,
    worst_level,
)

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Choice = tuple[int, ...]
"""Index of an option of each of ``CLASSES``."""

_UNLIKELY = 7.0
"""Choices less likely by a factor e^7 than the best do not count."""
_MIDDLE = len(FIELD_LEVELS) // 2, len(SHAPE_LEVELS) // 2
"""Levels of depth fields and ball shape."""


def most_probable_widths(problem: Problem, state: State) -> Widths:
    """The widths with the largest evidence, from the information and gradient of a state."""
    best = _smooth_choices(Quadratic.of(problem, state), _MIDDLE, None)[0]
    return best.widths(best.best[0])


def averaged_state(problem: Problem, state: State) -> State:
    """The state moved to the mean over all widths and beliefs, with the covariance over them."""
    layout = Layout.of(problem)
    contacts = Contacts.of(problem, layout, state)
    sure, *doubtful = beliefs(problem)
    mixture, base = Mixture(layout.size), Quadratic.of(problem, state)
    smooth = []
    start = _smooth_levels(problem.widths), _choice_of(problem.widths)
    for one in _smooth_choices(base.under(contacts, sure), *start):
        if _add(mixture, sure, one):
            smooth.append((one.levels, one.best[0]))
    for belief in doubtful:
        doubted = base.under(contacts, belief)
        for levels, choice in smooth:
            _add(mixture, belief, _SmoothChoice(doubted, levels, choice))
    doubts = []
    for belief in doubtful:
        probability, step = mixture.share(belief)
        doubts.append(Doubt(belief.wrong, probability, contacts.size_m(belief, step)))
    mean, covariance = mixture.moments()
    return replace(
        moved_state(problem, layout, state, mean),
        covariance=covariance,
        doubts=sorted(doubts, key=lambda doubt: -doubt.probability),
    )


def _add(mixture: Mixture, belief: Belief, one: _SmoothChoice) -> bool:
    """Add choices that are likely enough, of those so far."""
    log = one.log_evidence()
    if log < mixture.top - _UNLIKELY:
        return False
    mixture.add(belief, log, *one.moments())
    return True


def _smooth_levels(widths: Widths) -> tuple[int, int]:
    """Levels of depth fields and ball shape, nearest to these widths."""
    return (
        int(np.argmin(np.abs(np.log(FIELD_LEVELS / widths.field_per_m)))),
        int(np.argmin(np.abs(np.log(np.array(SHAPE_LEVELS) / widths.shape)))),
    )


def _choice_of(widths: Widths) -> Choice:
    """The options that make up these widths."""
    sensors = list(widths.sensors.values())
    levels = [*zip(*sensors, strict=True), (widths.radius,), (widths.bow,)]
    return tuple(
        [option.levels for option in width_options(name, len(sensors))].index(own)
        for name, own in zip(CLASSES, levels, strict=True)
    )


def _smooth_choices(
    base: Quadratic, start: tuple[int, int], choice: Choice | None
) -> list[_SmoothChoice]:
    """The evidence for levels of depth fields and ball shape, climbed from ``start``; the largest
    first.

    Each search goes on from the best choice of the level before, the first from ``choice``.
    """
    levels = (len(FIELD_LEVELS), len(SHAPE_LEVELS) if len(base.shape) else 1)
    here = (start[0], min(start[1], levels[1] - 1))
    found = {here: _SmoothChoice(base, here, choice)}
    while True:
        for axis, step in ((0, -1), (0, 1), (1, -1), (1, 1)):
            near = (here[0] + step * (axis == 0), here[1] + step * (axis == 1))
            if near not in found and 0 <= near[axis] < levels[axis]:
                found[near] = _SmoothChoice(base, near, found[here].best[0])
        best = max(found, key=lambda one: found[one].best[1])
        if best == here:
            return sorted(found.values(), key=lambda one: -one.best[1])
        here = best


class _SmoothChoice:
    """All choices of the other widths where depth fields and ball shape have given ones."""

    def __init__(self, base: Quadratic, levels: tuple[int, int], near: Choice | None) -> None:
        self._base, self.levels = base, levels
        self._field_per_m, self._shape = float(FIELD_LEVELS[levels[0]]), SHAPE_LEVELS[levels[1]]
        self._inner, self._outer = inner, outer = base.inner, base.outer
        information, mixed = base.outer_information.copy(), base.mixed_information
        gradient = base.gradient[outer]
        parts = [(index, base.field_precision, self._field_per_m) for index in base.fields]
        if len(base.shape):
            parts.append((base.shape, base.shape_precision, self._shape))
        cost, log_widths = -base.log_belief, 0.0
        for index, unit, width in parts:
            precision = unit / width**2
            pull = precision @ base.values[index]
            # Such unknowns follow one another among the outer ones, too.
            start = int(np.searchsorted(outer, index[0]))
            own = slice(start, start + len(index))
            information[own, own] += precision
            gradient[own] += pull
            cost += 0.5 * float(base.values[index] @ pull)
            log_widths += len(index) * float(np.log(width))
        # LAPACK's order of a symmetric matrix: no copy.
        self._factor = cho_factor(information.T, lower=True, overwrite_a=True, check_finite=False)
        solved = cho_solve(self._factor, np.column_stack([mixed, gradient]))
        self._response, self._outer_step = -solved[:, :-1], -solved[:, -1]
        reduced = base.information[np.ix_(inner, inner)] + mixed.T @ self._response
        self._information = 0.5 * (reduced + reduced.T)
        self._gradient = base.gradient[inner] + mixed.T @ self._outer_step
        log_det = 2.0 * float(np.log(np.diag(self._factor[0])).sum())
        cost += 0.5 * float(gradient @ self._outer_step)
        self._constant = -cost - 0.5 * log_det
        self._constant -= log_widths
        self._values = base.values[inner]
        self._options = [width_options(name, len(base.cameras)) for name in CLASSES]
        self._precisions = [
            np.stack([self._precision(name, option) for option in own])
            for name, own in zip(CLASSES, self._options, strict=True)
        ]
        self._priors = [np.array([option.log_prior for option in own]) for own in self._options]
        self._lens_prior = lens_log_prior(len(base.cameras))
        self._counts = tuple(len(own) for own in self._options)
        self._visited, self._log = np.zeros(0, np.intp), np.zeros(0)
        self.best = self._search(near)

    def widths(self, choice: Choice) -> Widths:
        """The widths that a choice means."""
        chosen = [own[k].levels for own, k in zip(self._options, choice, strict=True)]
        sensors = {
            name: tuple(levels[place] for levels in chosen[: len(SENSOR)])
            for place, name in enumerate(self._base.cameras)
        }
        return Widths(sensors, self._field_per_m, self._shape, chosen[-2][0], chosen[-1][0])

    def log_evidence(self) -> float:
        """Log of the sum over all choices that were visited."""
        return float(logsumexp(self._log))

    def moments(self) -> tuple[Array, Array]:
        """Step (m,) to the mean over all choices, and the covariance (m, m) over them."""
        likely = self._log > self.best[1] - _UNLIKELY
        weights = np.exp(self._log[likely] - logsumexp(self._log[likely]))
        visited = np.unravel_index(self._visited[likely], self._counts)
        precision = self._diagonals(np.stack(visited, axis=1))
        spread = np.linalg.inv(self._information + precision[:, None] * np.eye(len(self._values)))
        steps = -np.einsum("mij,mj->mi", spread, self._gradient + precision * self._values)
        mean = weights @ steps
        inner = np.einsum("m,mij->ij", weights, spread)
        inner += np.einsum("m,mi,mj->ij", weights, steps - mean, steps - mean)
        size = len(self._inner) + len(self._outer)
        step, covariance = np.zeros(size), np.zeros((size, size))
        step[self._inner] = mean
        step[self._outer] = self._outer_step + self._response @ mean
        # Covariance of the outer unknowns given the inner ones, plus the propagated one.
        carry = np.zeros((size, len(self._inner)))
        carry[self._inner] = np.eye(len(self._inner))
        carry[self._outer] = self._response
        half = np.tril(dpotri(self._factor[0], lower=True)[0])
        covariance[np.ix_(self._outer, self._outer)] = half + np.tril(half, -1).T
        return step, covariance + carry @ inner @ carry.T

    def _precision(self, name: str, option: Option) -> Array:
        """Diagonal of a class's prior information."""
        scales = {RADIUS: np.array([self._base.radius_m]), BOW: BOW_TOLERANCE}
        scale = scales.get(name, np.ones(1))
        added = self._base.slope_sigma if name == BOW else np.zeros(1)
        groups = self._base.groups[name]
        return np.concatenate(
            [
                np.ones(len(group)) * np.hypot(sigma(name, level) * scale, added) ** -2.0
                for group, level in zip(groups, option.levels, strict=True)
            ]
        )

    def _diagonals(self, choices: Index) -> Array:
        """Diagonals (n, m) of the priors' information of choices (n, classes)."""
        return np.concatenate(
            [own[k] for own, k in zip(self._precisions, choices.T, strict=True)], axis=1
        )

    def _search(self, near: Choice | None) -> tuple[Choice, float]:
        """The choice with the largest evidence, from the narrowest, sound and widest priors."""
        ends = [(0,) * len(CLASSES)]
        ends += [tuple(level(name) for name in CLASSES) for level in (sound_level, worst_level)]
        found = [self._climb(choice) for choice in (ends if near is None else [*ends, near])]
        return max(found, key=lambda one: one[1])

    def _climb(self, choice: Choice) -> tuple[Choice, float]:
        """The choice with the largest evidence, by steps in one class or in two."""
        moves = _moves(self._counts)
        while True:
            here = np.array(choice)
            near = np.where(moves < 0, here, moves)[~(moves == here).any(axis=1)]
            near = np.concatenate([here[None], near])
            keys = self._keys(near)
            self._weigh(here, near[~np.isin(keys, self._visited)])
            order = np.argsort(self._visited)
            log = self._log[order[np.searchsorted(self._visited, keys, sorter=order)]]
            best = int(np.argmax(log))
            if best == 0:
                return choice, float(log[0])
            choice = tuple(near[best].tolist())

    def _keys(self, choices: Index) -> Index:
        """One number (n,) for each of choices (n, classes)."""
        return np.asarray(np.ravel_multi_index(list(choices.T), self._counts), np.intp)

    def _weigh(self, here: Index, choices: Index) -> None:
        """Visit choices (n, classes), which differ little from one of them all."""
        if not len(choices):
            return
        own, precision = self._diagonals(here[None])[0], self._diagonals(choices)
        whole = self._information + np.diag(own)
        sign, log_det = np.linalg.slogdet(whole)
        if sign <= 0.0:
            raise np.linalg.LinAlgError("what the priors leave open is not determined")
        spread = np.linalg.inv(whole)
        pull = self._gradient + own * self._values
        step = spread @ pull
        log = evidence_changes(spread, step, self._values, own, precision)
        log += 0.5 * float(pull @ step) - 0.5 * float(log_det)
        log += 0.5 * np.sum(np.log(precision) - precision * self._values**2, axis=1)
        log += sum(own[k] for own, k in zip(self._priors, choices.T, strict=True))
        log += self._lens_prior[tuple(choices[:, CLASSES.index(name)] for name in LENS)]
        self._visited = np.concatenate([self._visited, self._keys(choices)])
        self._log = np.concatenate([self._log, self._constant + log])


@cache
def _moves(options: tuple[int, ...]) -> Index:
    """Changes (n, classes) of one class or two to all of their options; -1 where one stays."""
    found = []
    for a, b in combinations_with_replacement(range(len(options)), 2):
        for k in range(options[a]):
            for j in range(options[b]) if a < b else (k,):
                found.append([k if c == a else j if c == b else -1 for c in range(len(options))])
    return np.array(found)
