"""Parameters of generated bodies, and random ones that are wider than people are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")
_YOUNG = 2.0 / 3.0
_AGE_OF_YEAR = (1.0 - _YOUNG) / 65.0
"""The generator's age of a person of 25, and what each year adds; 1 is one of 90."""
_COMMON_HEIGHT, _COMMON_STATURE_M, _STATURE_OF_HEIGHT_M = 0.33, (1.74, 1.60), 1.19
"""At a third of its scale the generator's height makes men and women so tall; so much taller is who
is at its end than at its start."""
_FACE = (
    "cheek", "chin", "ear", "eye", "forehead", "mouth", "nose", "head-age", "head-angle",
)  # fmt: skip
_BELLY = ("stomach", "pelvis-tone", "hip", "waist", "torso", "bust", "neck", "buttocks")
_FAT = {
    "stomach-pregnant-incr": "belly",
    "measure-waist-circ-incr": "belly",
    "torso-scale-depth-incr": "belly",
    "measure-underbust-circ-incr": "belly",
    "hip-scale-depth-incr": "hips",
    "hip-scale-horiz-incr": "hips",
    "measure-hips-circ-incr": "hips",
    "measure-thigh-circ-incr": "hips",
    "buttocks-volume-incr": "hips",
    "upperleg-fat-incr": "hips",
    "measure-bust-circ-incr": "all",
    "measure-upperarm-circ-incr": "all",
    "measure-calf-circ-incr": "all",
    "lowerleg-fat-incr": "all",
    "measure-neck-circ-incr": "all",
    "neck-double-incr": "all",
    "cheek-volume-incr": "all",
    "head-fat-incr": "all",
}
"""Local changes that grow with fat, and by which of its depots."""
_GAIN = {"belly": 0.5, "hips": 0.18, "all": 0.3}


@dataclass(frozen=True, slots=True)
class Shapes:
    """Parameters of anny for n bodies, from which they can be made in any pose."""

    phenotypes: dict[str, Array]
    local_changes: dict[str, Array]
    scale: Array

    def take(self, index: NDArray[np.intp]) -> Shapes:
        return Shapes(
            {key: value[index] for key, value in self.phenotypes.items()},
            {key: value[index] for key, value in self.local_changes.items()},
            self.scale[index],
        )

    def replaced(self, chosen: NDArray[np.bool_], other: Shapes) -> Shapes:
        """The bodies of another where chosen (n,), these elsewhere."""

        def merged(mine: dict[str, Array], others: dict[str, Array]) -> dict[str, Array]:
            return {key: np.where(chosen, others[key], value) for key, value in mine.items()}

        return Shapes(
            merged(self.phenotypes, other.phenotypes),
            merged(self.local_changes, other.local_changes),
            np.where(chosen, other.scale, self.scale),
        )

    @classmethod
    def joined(cls, pieces: Sequence[Shapes]) -> Shapes:
        """The bodies of all pieces, one after the other."""
        return cls(
            {key: np.concatenate([p.phenotypes[key] for p in pieces]) for key in PHENOTYPES},
            {
                key: np.concatenate([p.local_changes[key] for p in pieces])
                for key in pieces[0].local_changes
            },
            np.concatenate([p.scale for p in pieces]),
        )

    def __len__(self) -> int:
        return len(self.scale)


def years_of(shapes: Shapes) -> Array:
    """(n,): ages in years."""
    return np.asarray(25.0 + (shapes.phenotypes["age"] - _YOUNG) / _AGE_OF_YEAR)


def base_label(label: str) -> str:
    """A local change's name without its side."""
    return label[2:] if label[:2] in ("l-", "r-") else label


def is_asymmetric(label: str) -> bool:
    """True if a local change without a side makes left and right differ."""
    return label == base_label(label) and ("trans-out" in label or label == "head-angle-out")


def is_of_face(label: str) -> bool:
    return base_label(label).startswith(_FACE)


def ordinary(
    labels: Sequence[str], gender: float = 0.5, fat: float = 0.0, height: float = 0.5
) -> Shapes:
    """The young adult in the middle of every other scale; fat in standard deviations."""
    middle = {
        "gender": gender,
        "age": _YOUNG,
        "height": height,
        "weight": float(np.clip(0.5 + 0.27 * fat, 0.0, 1.0)),
    }
    changes = {}
    for label in labels:
        depot = _FAT.get(base_label(label)) if fat else None
        gain = _GAIN[depot] if depot else 0.0
        changes[label] = np.full(1, gain * max(0.5 * fat, -0.4))
    return Shapes(
        {key: np.full(1, middle.get(key, 0.5)) for key in PHENOTYPES}, changes, np.ones(1)
    )


def random_shapes(
    labels: Sequence[str],
    female: NDArray[np.bool_],
    age: Array,
    stature_m: Array,
    fat: Array,
    rng: np.random.Generator,
) -> Shapes:
    """Bodies of persons (n,) whose sex, age, stature and fat are given; all else is drawn wide.

    Args:
        labels: names of the local changes.
        age: years.
        fat: standard deviations.
    """
    count = len(female)
    gender = np.clip(female + rng.normal(0.0, 0.12, count), 0.0, 1.0)
    # The generator's own weight ends short of what people weigh, and hardly acts on the
    # muscular: fat goes on with local changes, and takes muscle's place.
    muscle = rng.beta(2.0, 2.0, count)
    muscle *= 1.0 - np.clip(0.3 * fat, 0.0, 1.0) * rng.random(count)
    common = np.where(female, *_COMMON_STATURE_M[::-1])
    height = _COMMON_HEIGHT + (stature_m - common) / _STATURE_OF_HEIGHT_M
    phenotypes = {
        "gender": gender,
        "age": np.clip(_YOUNG + (age - 25.0) * _AGE_OF_YEAR, 0.6, 1.0),
        "muscle": muscle,
        "weight": np.clip(0.5 + 0.27 * fat + 0.12 * rng.standard_normal(count), 0.0, 1.0),
        "height": np.clip(height, 0.02, 0.98),
        "proportions": rng.uniform(0.0, 1.0, count),
    }
    # A body is ordinary in most places and peculiar in some.
    intensity = rng.uniform(0.3, 1.0, count)
    # Fat sits on the belly, on hips and thighs, or anywhere.
    depots = {name: fat * rng.uniform(0.0, 1.0, count) for name in ("belly", "hips", "all")}
    changes: dict[str, Array] = {}
    for label in sorted(labels):
        base = base_label(label)
        spread = 0.22 if is_of_face(label) else 0.24
        if any(word in base for word in _BELLY):
            spread = 0.3
        common_key = f"common {base}"
        if common_key not in changes:
            changes[common_key] = spread * rng.standard_normal(count) * intensity
            depot = _FAT.get(base)
            if depot is not None:
                changes[common_key] += _GAIN[depot] * np.maximum(depots[depot], -0.4)
        value = changes[common_key]
        if base != label:
            value = value + 0.12 * rng.standard_normal(count) * intensity
        elif is_asymmetric(label):
            value = 0.3 * value
        changes[label] = np.clip(value, -1.0, 1.2 if base in _FAT else 1.0)
    local = {label: changes[label] for label in labels}
    return Shapes(phenotypes, local, np.ones(count))
