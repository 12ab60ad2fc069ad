"""The database's bodies beside people: every size that a survey and this project both have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.scape.learn.people.survey import (
    COMPARISONS,
    PUBLIC,
    STATURE,
    WAIST,
    Persons,
    design_matrix,
    surveyed,
)

Array = NDArray[np.float64]

MAX_MEAN_OFF = 0.3
"""Difference of the means at equal stature, waist and age, in deviations of the survey."""
SPREADS = (0.8, 1.3)
"""Standard deviation given stature, waist and age, against the survey's."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """Comparison of bodies of one sex with people, in one size."""

    name: str
    mean_m: float
    """Mean of people."""
    off_m: float
    """Bodies less people, at the mean stature, waist and age of people."""
    off: float
    """`off_m` in standard deviations of people."""
    spread_m: float
    """Standard deviation of people alike in stature, waist and age."""
    spread: float
    """Standard deviation of bodies in units of people's."""
    same_mean: bool
    """True if the definitions are near enough for means to be compared."""

    @property
    def met(self) -> bool:
        low, high = SPREADS
        return (not self.same_mean or abs(self.off) <= MAX_MEAN_OFF) and low <= self.spread <= high


def likenesses(bodies: Persons, people: Persons) -> list[Likeness]:
    """Compare bodies with people of the same sex, size by size, at equal stature, waist and age."""
    there = _known(people).mean(axis=0)
    found = []
    for column, comparison in enumerate(COMPARISONS):
        if column in (STATURE, WAIST):
            continue
        theirs, their_spread = _given(people, column, there)
        ours, our_spread = _given(bodies, column, there)
        deviation = float(people.sizes[:, column].std())
        found.append(
            Likeness(
                comparison.name,
                theirs,
                ours - theirs,
                (ours - theirs) / deviation,
                their_spread,
                our_spread / their_spread,
                comparison.same_mean,
            )
        )
    return found


def _given(persons: Persons, column: int, there: Array) -> tuple[float, float]:
    """A size expected at a stature, waist and age, and its standard deviation around that."""
    known = _known(persons) - there
    design = np.column_stack([np.ones(len(known)), known])
    values = persons.sizes[:, column]
    coefficients = np.linalg.lstsq(design, values, rcond=None)[0]
    return float(coefficients[0]), float((values - design @ coefficients).std())


def _known(persons: Persons) -> Array:
    """(n, 3): stature, waist and age, as the regression of sizes takes them."""
    sizes = persons.sizes
    return design_matrix(sizes[:, STATURE], sizes[:, WAIST], persons.age)[:, 1:]


def population_table(bodies: Persons) -> Iterator[str]:
    """Lines of a table that compares bodies with the survey's people."""
    people = surveyed()
    yield f"population: {len(bodies.age)} bodies against {len(people.age)} people (ANSUR II)"
    yield "                    here: median,  p5,   p95   public (NHANES 2015-2018): median"
    for sex, public in PUBLIC.items():
        mine = bodies.take(bodies.female == (sex == "women"))
        for name, column, median in (
            ("stature", STATURE, public.stature_m),
            ("waist", WAIST, public.waist_m),
        ):
            low, middle, high = 100.0 * np.quantile(mine.sizes[:, column], (0.05, 0.5, 0.95))
            yield f" {sex:<6}{name:<20}{middle:7.1f}{low:7.1f}{high:7.1f}{100.0 * median:9.1f} cm"
    yield " mm at equal stature, waist, age    people    off  in sd (bar)  spread  of theirs (bar)"
    met, judged = 0, 0
    for sex in PUBLIC:
        female = sex == "women"
        mine = bodies.take(bodies.female == female)
        for row in likenesses(mine, people.take(people.female == female)):
            judged += 1
            met += row.met
            limit = f"{MAX_MEAN_OFF:.1f}" if row.same_mean else "none"
            yield (
                f" {sex:<6}{row.name:<28}{1e3 * row.mean_m:8.0f}{1e3 * row.off_m:7.1f}"
                f"{row.off:7.2f}  ({limit:>4}){1e3 * row.spread_m:8.1f}{row.spread:8.2f}"
                f"   ({SPREADS[0]:g}-{SPREADS[1]:g})  {'met' if row.met else 'MISSED'}"
            )
    yield f" {met} of {judged} sizes met"
    for comparison in COMPARISONS:
        if comparison.difference:
            men, women = (1e3 * offset for offset in comparison.definition_offset_m)
            yield (
                f" {comparison.name}: {comparison.difference}; allowed for: "
                f"men {men:+.0f}, women {women:+.0f} mm"
            )
