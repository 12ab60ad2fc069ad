"""People's sizes: a survey that measured them, and draws of persons as they are in the public.

The survey is ANSUR II (Gordon et al. 2014, NATICK/TR-15/007): 4,082 men and 1,986 women of the U.S.
Army, fit people of 17 to 58. How the sizes of one person hang together is taken from it: each size
is regressed on stature, waist and age, and what a person deviates by is kept as a whole. Statures,
waists and ages themselves are drawn as they are in the public (NHANES 2015-2018, Fryar et al. 2021,
Vital and Health Statistics 3-46).
"""

from __future__ import annotations

import csv
import gzip
import io
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from workers.measure.definitions import DEFINITIONS
from workers.measure.kinds import Definition, Level, Route, Section, Tilted
from workers.measure.vocabulary import NECK_FOOT, SHOULDERS, TRUNK

Array = NDArray[np.float64]

SURVEY = "data/ansur2.csv.gz"

_WAIST = ("waist_front", "waist_back", "waist_side_left", "waist_side_right")
_HIP = ("buttock_left", "buttock_right")
_NAVEL = Level(_WAIST, _HIP, 0.2)
"""The survey's waist is at the navel, a fifth of the way from the natural waist (midway between
tenth rib and hip bone) to the level of the buttocks: means of the survey's heights."""
_SIDES = ("waist_side_right", "waist_side_left")


@dataclass(frozen=True, slots=True)
class Comparison:
    """A size that the survey has and that can be measured here."""

    definition: Definition
    columns: tuple[str, ...]
    """The survey's columns; their mean counts."""
    definition_offset_m: tuple[float, float] = (0.0, 0.0)
    """Excess of the definition here over the survey's, men and women."""
    difference: str = ""
    """Difference of the definitions, in words."""

    @property
    def name(self) -> str:
        return self.definition.name

    @property
    def same_mean(self) -> bool:
        """False where the excess is an estimate, so that means say nothing."""
        return self.definition_offset_m == (0.0, 0.0)


def _row(name: str) -> Definition:
    return next(definition for definition in DEFINITIONS if definition.name == name)


def _height(name: str, landmark: str) -> Definition:
    return Definition(name, f"{landmark} above the floor", "height", Route((landmark,), ("floor",)))


_NECK_SIDES = ("side_neck_right", "side_neck_left")
_HEAD_PLANE = Tilted("glabella", "occiput", *_NECK_SIDES)
COMPARISONS: tuple[Comparison, ...] = (
    Comparison(_row("height"), ("stature",)),
    Comparison(_row("nape_to_floor"), ("cervicaleheight",)),
    Comparison(_row("shoulder_height"), ("acromialheight",)),
    Comparison(_height("neck_pit_height", "suprasternale"), ("suprasternaleheight",)),
    Comparison(_row("bust_height"), ("chestheight",)),
    Comparison(
        _row("waist_height"),
        ("tenthribheight", "iliocristaleheight"),
        difference="the survey has tenth rib and hip bone; their middle counts",
    ),
    Comparison(_row("hip_height"), ("buttockheight",)),
    Comparison(_row("crotch_height"), ("crotchheight",)),
    Comparison(_row("knee_height"), ("kneeheightmidpatella",)),
    Comparison(_height("ankle_height", "ankle_right"), ("lateralmalleolusheight",)),
    Comparison(_row("head_girth"), ("headcircumference",)),
    Comparison(_row("head_length"), ("headlength",)),
    Comparison(
        Definition(
            "head_breadth", "above the ears, from side to side", "breadth",
            Section(_HEAD_PLANE, ("head",), whole=True, across=_NECK_SIDES),
        ),
        ("headbreadth",),
    ),
    Comparison(_row("neck_girth"), ("neckcircumference",)),
    Comparison(
        # By this tape, not by the shorter one of `neck_base_girth`, the training bodies are drawn.
        Definition(
            "neck_foot_girth", "taut over four landmarks, each leg in a level direction outwards",
            "girth",
            Route(NECK_FOOT, ("tape", "tape", "tape", "tape"), SHOULDERS, closed=True, bulge=0.25),
        ),
        ("neckcircumferencebase",), (0.010, 0.0),
        "a chain lies there; a tape over four landmarks here",
    ),
    Comparison(_row("chest_girth"), ("chestcircumference",)),
    Comparison(
        _row("chest_breadth"), ("chestbreadth",), (0.055, 0.025),
        "callipers press there; an ellipse of the survey's breadth and depth is a fifth shorter "
        "than its girth",
    ),
    Comparison(_row("chest_depth"), ("chestdepth",), (0.012, 0.004), "callipers press"),
    Comparison(
        Definition("navel_girth", "level, at the navel", "large girth",
                   Section(_NAVEL, TRUNK, whole=True)),
        ("waistcircumference",),
    ),
    Comparison(
        Definition("navel_breadth", "at the navel, from side to side", "breadth",
                   Section(_NAVEL, TRUNK, whole=True, across=_SIDES)),
        ("waistbreadth",), (0.008, 0.008), "callipers press",
    ),
    Comparison(
        Definition("navel_depth", "at the navel, from front to back", "depth",
                   Section(_NAVEL, TRUNK, whole=True, across=_SIDES)),
        ("waistdepth",), (0.014, 0.016), "callipers press",
    ),
    Comparison(_row("hip_girth"), ("buttockcircumference",)),
    Comparison(
        _row("hip_breadth"), ("hipbreadth",), (0.018, 0.025),
        "callipers press there, and feet are together",
    ),
    Comparison(_row("hip_depth"), ("buttockdepth",)),
    Comparison(
        Definition("upper_thigh_girth", "level, just below the crotch", "girth",
                   Section(Level(("crotch",), ("knee_right",), 0.05),
                           ("thigh_right", "pelvis", "shin_right"))),
        ("thighcircumference",), (-0.012, -0.012),
        "in the fold below the buttock there, 5 % of the thigh below the crotch here",
    ),
    Comparison(
        Definition("lower_thigh_girth", "level, just above the kneecap", "girth",
                   Section(Level(("crotch",), ("knee_right",), 0.93),
                           ("thigh_right", "pelvis", "shin_right"))),
        ("lowerthighcircumference",),
    ),
    Comparison(_row("calf_girth_right"), ("calfcircumference",)),
    Comparison(_row("ankle_girth_right"), ("anklecircumference",)),
    Comparison(
        _row("upper_arm_girth_right"), ("bicepscircumferenceflexed",), (-0.028, -0.018),
        "flexed there, relaxed here",
    ),
    Comparison(
        _row("forearm_girth_right"), ("forearmcircumferenceflexed",), (-0.012, -0.006),
        "flexed there, relaxed here",
    ),
    Comparison(_row("wrist_girth_right"), ("wristcircumference",)),
    Comparison(_row("shoulder_width"), ("biacromialbreadth",)),
    Comparison(_row("shoulder_length_right"), ("shoulderlength",)),
    Comparison(
        _row("upper_arm_length_right"), ("acromionradialelength", "shoulderelbowlength"),
        difference="to the head of the radius, and to the bent elbow; the tip of the elbow lies "
        "between them",
    ),
    Comparison(
        _row("forearm_length_right"), ("radialestylionlength",),
        difference="along the radius there, along the ulna here",
    ),
    Comparison(
        _row("hand_length_right"), ("handlength",), (0.013, 0.013),
        "from the tip of the radius there; here from the head of the ulna, 10 mm higher, and over "
        "the knuckles",
    ),
    Comparison(_row("foot_length_right"), ("footlength",)),
    Comparison(_row("foot_breadth_right"), ("footbreadthhorizontal",)),
)  # fmt: skip
"""Every size that both have, right side where a body has two."""
NAMES = tuple(comparison.name for comparison in COMPARISONS)
STATURE, WAIST = NAMES.index("height"), NAMES.index("navel_girth")


@dataclass(frozen=True, slots=True)
class Public:
    """Adults of one sex in the public (NHANES 2015-2018)."""

    stature_m: float
    stature_sd_m: float
    waist_m: float
    """Median, at the navel."""
    waist_sd: float
    """Standard deviation of the logarithm of the waist."""


PUBLIC = {
    "men": Public(1.753, 0.073, 1.010, 0.150),
    "women": Public(1.615, 0.069, 0.968, 0.165),
}
"""Means and percentiles of adults of the United States: waists 102.9 and 98.3 cm on the mean."""
_STATURES_M = (1.40, 2.10)
_WAISTS_M = (0.58, 1.55)
_AGES = (18.0, 80.0)
_OLDEST_EFFECT = 58.0
"""Years; beyond the survey's oldest the effect of age stays as it is."""
_UNUSUAL = 0.15
"""Share of persons whose deviations are wider, so that the model reaches who is outside."""
_UNUSUAL_SCALE = 1.6
_SPLITS = {"train": (0, 14), "validation": (14, 17), "test": (17, 20)}
"""Persons of every twenty of the survey that serve each split."""


@dataclass(frozen=True, slots=True)
class Persons:
    """Sizes of n persons, in the order of COMPARISONS and as they are defined here."""

    female: NDArray[np.bool_]
    age: Array
    sizes: Array
    """(n, D) metres."""

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Persons:
        return Persons(self.female[chosen], self.age[chosen], self.sizes[chosen])


@cache
def surveyed() -> Persons:
    """Everyone who was measured."""
    path = resources.files("workers.scape.learn.people").joinpath(SURVEY)
    with gzip.open(io.BytesIO(path.read_bytes()), "rt", encoding="ascii") as file:
        rows = list(csv.DictReader(file))
    female = np.array([row["sex"] == "Female" for row in rows])
    sizes = np.empty((len(rows), len(COMPARISONS)))
    for column, comparison in enumerate(COMPARISONS):
        values = [[float(row[name]) for name in comparison.columns] for row in rows]
        offset = np.where(female, *comparison.definition_offset_m[::-1])
        sizes[:, column] = 1e-3 * np.mean(values, axis=1) + offset
    return Persons(female, np.array([float(row["age"]) for row in rows]), sizes)


@dataclass(frozen=True, slots=True)
class Regression:
    """Sizes of one sex on stature, waist and age, in least squares."""

    coefficients: Array
    """(4, D)."""
    deviations: Array
    """(n, D): what each person deviates by."""

    @classmethod
    def of(cls, persons: Persons) -> Regression:
        design = design_matrix(persons.sizes[:, STATURE], persons.sizes[:, WAIST], persons.age)
        coefficients = np.asarray(np.linalg.lstsq(design, persons.sizes, rcond=None)[0], np.float64)
        deviations = np.asarray(persons.sizes - design @ coefficients, np.float64)
        return cls(coefficients, deviations)

    def sizes(self, stature_m: Array, waist_m: Array, age: Array) -> Array:
        """(n, D): what is expected."""
        return design_matrix(stature_m, waist_m, age) @ self.coefficients


def design_matrix(stature_m: Array, waist_m: Array, age: Array) -> Array:
    """(n, 4)."""
    years = np.clip(age, 0.0, _OLDEST_EFFECT)
    return np.stack([np.ones_like(stature_m), stature_m, waist_m, years], axis=1)


def drawn(split: str, count: int, rng: np.random.Generator) -> Persons:
    """Adults of the public, half of them women, with generous tails; splits share no person.

    Stature, waist and age are drawn as the public has them; all other sizes are what the survey's
    regression expects for these, plus the deviations of one person of the survey.
    """
    everyone = surveyed()
    turn = np.arange(len(everyone.age)) % 20
    first, beyond = _SPLITS[split]
    mine = (turn >= first) & (turn < beyond)
    female = rng.random(count) < 0.5
    age = rng.uniform(*_AGES, count)
    unusual = np.where(rng.random(count) < _UNUSUAL, _UNUSUAL_SCALE, 1.0)
    sizes = np.empty((count, len(COMPARISONS)))
    for sex, wanted in (("men", ~female), ("women", female)):
        of_sex = everyone.female == (sex == "women")
        regression = Regression.of(everyone.take(of_sex))
        donors = regression.deviations[mine[of_sex]]
        public, n = PUBLIC[sex], int(wanted.sum())
        stature = public.stature_m + public.stature_sd_m * unusual[wanted] * rng.standard_normal(n)
        spread = public.waist_sd * unusual[wanted] * rng.standard_normal(n)
        stature = np.clip(stature, *_STATURES_M)
        waist = np.clip(public.waist_m * np.exp(spread), *_WAISTS_M)
        deviation = unusual[wanted, None] * donors[rng.integers(0, len(donors), n)]
        sizes[wanted] = regression.sizes(stature, waist, age[wanted]) + deviation
    return Persons(female, age, sizes)
