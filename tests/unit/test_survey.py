"""The survey's people, those drawn from them, and the table that compares bodies with people."""

import numpy as np
import pytest

from workers.scape.learn.people.population import likenesses, population_table
from workers.scape.learn.people.survey import (
    COMPARISONS,
    NAMES,
    PUBLIC,
    STATURE,
    WAIST,
    Persons,
    drawn,
    surveyed,
)

PERSONS = 3000


@pytest.fixture(scope="module")
def public() -> Persons:
    return drawn("train", PERSONS, np.random.default_rng(0))


def test_the_survey_is_whole() -> None:
    people = surveyed()
    assert len(people.age) == 6068
    assert people.female.sum() == 1986
    assert np.isfinite(people.sizes).all()
    means = dict(zip(NAMES, people.sizes[~people.female].mean(axis=0), strict=True))
    assert abs(means["height"] - 1.756) < 0.001
    assert abs(means["chest_girth"] - 1.059) < 0.001
    assert len(set(NAMES)) == len(COMPARISONS) >= 36


def test_the_public_is_heavier_than_the_army(public: Persons) -> None:
    people = surveyed()
    for sex, figures in PUBLIC.items():
        female = sex == "women"
        mine = public.sizes[public.female == female]
        theirs = people.sizes[people.female == female]
        assert 0.06 < mine[:, WAIST].mean() - theirs[:, WAIST].mean() < 0.14
        assert abs(np.median(mine[:, WAIST]) - figures.waist_m) < 0.012
        assert abs(mine[:, STATURE].mean() - figures.stature_m) < 0.006
    assert np.median(public.age) > 45.0


def test_persons_are_drawn_with_people_s_own_proportions(public: Persons) -> None:
    """Given stature, waist and age: the same means, and spreads as wide or a little wider."""
    people = surveyed()
    for female in (False, True):
        mine, theirs = (group.take(group.female == female) for group in (public, people))
        for row in likenesses(mine, theirs):
            assert abs(row.off) < 0.1, row.name
            assert 0.9 < row.spread < 1.3, row.name


def test_the_table_tells_what_is_missed() -> None:
    people = surveyed()
    assert not any("MISSED" in line for line in population_table(people))
    column = NAMES.index("hand_length_right")
    sizes = people.sizes.copy()
    sizes[:, column] += 1.5 * (sizes[:, column] - sizes[:, column].mean())
    wide = list(population_table(Persons(people.female, people.age, sizes)))
    missed = [line for line in wide if "MISSED" in line]
    assert len(missed) == 2
    assert all("hand_length" in line for line in missed)
    assert any("70 of 72 sizes met" in line for line in wide)
