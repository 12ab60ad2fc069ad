"""Bodies unlike those that the model was learned from, with their true measurements.

Held-out bodies, subdivided and sculpted (sculpting.py), in held-out poses. The sculpting is done in
the neutral pose and carried along, so that one body can be measured as it was scanned and in the
standard pose. Development and test share no body: tune on the former alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from room import first_with_room
from sculpting import Body, sculpted
from true_measurements import TrueBody

from station.core.words.tables import Pose
from station.simulation.scene import Mesh
from workers.measure.standing import on_both_feet, standard_turns
from workers.scape.learn.database import PARTS, Shapes, body_database
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces, vertex_normals

Array = NDArray[np.float64]
UnlikeSplit = Literal["development", "test"]

_SEEDS: dict[UnlikeSplit, int] = {"development": 61, "test": 62}
POOL = 40
"""Bodies of a split that are drawn, however many of them are used."""
_DRAWN = 16
"""Bodies that are drawn at a time: fewer take the database as long."""
_POSE_SHARE = 0.7
"""People who are shown how to stand vary less than the poses that the model was learned from."""
_TOUCHING = 80
"""Crossings of the finer triangles that armpits and toes have in any pose."""


@dataclass(frozen=True, slots=True)
class UnlikeBody:
    """A body that no training body is like."""

    name: str
    mesh: Mesh
    """As it stands in the booth, finer than the template; the template's vertices come first."""
    truth: dict[Pose, dict[str, float]]
    """Row -> metres, in both poses that are measured."""


class UnlikeBodies:
    """Sculpted bodies by split and number; the same number is the same body."""

    def __init__(self, model: BodyModel, split: UnlikeSplit) -> None:
        self._model, self._split = model, split
        self._database = body_database()
        self._shapes = Shapes({}, {}, np.zeros(0))
        self._poses = _POSE_SHARE * self._database.sample_poses("test", POOL, _SEEDS[split])
        self._subdivision, self.faces = loop_subdivision(self._database.faces, model.vertex_count)

    def bodies(self, count: int) -> Iterator[UnlikeBody]:
        """The first so many, at most POOL."""
        for index in range(min(count, POOL)):
            yield self.body(index)

    def body(self, index: int) -> UnlikeBody:
        """One body (0 to POOL - 1), its middle above the origin, on the floor, facing -y."""
        if index >= len(self._shapes):
            drawn = _DRAWN * (index // _DRAWN + 1)
            self._shapes = self._database.sample("test", drawn, _SEEDS[self._split])
        shapes = self._shapes.take(np.array([index]))
        neutral, standing = self._finer(shapes, np.zeros_like(self._standing), self._standing)
        female = bool(shapes.phenotypes["gender"][0] > 0.5)
        moved = self._sculpted(neutral, index, female=female)
        posed = self._with_room(shapes, neutral, moved, index)
        middle = 0.5 * (posed.min(axis=0) + posed.max(axis=0))
        posed -= (middle[0], middle[1], posed[:, 2].min())
        standing = standing + carried(moved, neutral, standing, self.faces)
        coarse = standing[: self._model.vertex_count]
        standing += (on_both_feet(self._model, coarse) - coarse)[0]
        truth: dict[Pose, dict[str, float]] = {
            "as-scanned": TrueBody(self._template, posed).values(),
            "standard": TrueBody(self._template, standing).values(),
        }
        name = f"unlike {self._split} {index:02d}"
        return UnlikeBody(name, Mesh(posed, self.faces), truth)

    def _finer(self, shapes: Shapes, *poses: Array) -> list[Array]:
        """One body in some poses, subdivided."""
        one = shapes.take(np.zeros(len(poses), np.intp))
        return [self._subdivision @ body for body in self._database.vertices(one, np.stack(poses))]

    def _with_room(self, shapes: Shapes, neutral: Array, moved: Array, index: int) -> Array:
        """The sculpted body in the first pose, from its own on, that it has room for."""
        poses = (self._finer(shapes, pose)[0] for pose in np.roll(self._poses, -index, axis=0))
        moved_poses = (posed + carried(moved, neutral, posed, self.faces) for posed in poses)
        return first_with_room(neutral + moved, moved_poses, self.faces, _TOUCHING)

    def _sculpted(self, neutral: Array, index: int, *, female: bool) -> Array:
        landmarks = self._model.landmarks
        body = Body(
            vertices=neutral,
            normals=vertex_normals(neutral, self.faces),
            parts=dict(zip(PARTS, self._part_shares.T, strict=True)),
            at={name: neutral[vertex] for name, vertex in landmarks.items()},
            female=female,
        )
        return sculpted(body, np.random.default_rng((_SEEDS[self._split], index)))

    @cached_property
    def _part_shares(self) -> Array:
        return np.asarray(self._subdivision @ self._database.part_weights)

    @cached_property
    def _template(self) -> BodyModel:
        """The model with the finer triangles, for the measurements' parts and landmarks alone."""
        return replace(
            self._model,
            faces=self.faces,
            vertex_weights=self._part_shares,
            sha256=f"{self._model.sha256} subdivided",
        )

    @cached_property
    def _standing(self) -> Array:
        """Turns (bones, 3) that lead to the standard pose."""
        turns = np.zeros((len(self._database.bones), 3))
        for part, turn in standard_turns(self._model).items():
            turns[self._database.bones.index(PARTS[part][1][0])] = turn
        return turns


def loop_subdivision(faces: Faces, count: int) -> tuple[sp.csr_matrix, Faces]:
    """Loop's scheme for a closed mesh: the matrix from its vertices to the finer ones (the old
    ones first) and the finer triangles. Loop 1987, with Warren's weights.
    """
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    opposite = faces[:, [2, 0, 1]].ravel()
    unique, edge_of = np.unique(edges, axis=0, return_inverse=True)
    edge_of = edge_of.ravel()
    middle = count + np.arange(len(unique))
    rows = np.concatenate([middle, middle, count + edge_of])
    columns = np.concatenate([unique[:, 0], unique[:, 1], opposite])
    values = np.repeat([0.375, 0.375, 0.125], [len(unique), len(unique), len(opposite)])
    valence = np.bincount(unique.ravel(), minlength=count)
    beta = np.where(valence == 3, 3.0 / 16.0, 3.0 / (8.0 * np.maximum(valence, 1)))
    pairs = np.concatenate([unique, unique[:, ::-1]])
    rows = np.concatenate([rows, pairs[:, 0], np.arange(count)])
    columns = np.concatenate([columns, pairs[:, 1], np.arange(count)])
    values = np.concatenate([values, beta[pairs[:, 0]], 1.0 - valence * beta])
    matrix = sp.csr_matrix((values, (rows, columns)), shape=(count + len(unique), count))
    ab, bc, ca = (count + edge_of.reshape(-1, 3)).T
    a, b, c = faces.T
    finer = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    triangles = np.concatenate([np.stack(corners, axis=1) for corners in finer])
    return matrix, triangles.astype(np.int32)


def carried(moved: Array, before: Array, after: Array, faces: Faces) -> Array:
    """Displacements (P, 3) of a surface, turned with it as its vertices go from before to after.

    Each vertex turns as the edges around it do, in least squares (Kabsch 1976).
    """
    ring = np.zeros((len(before), 3, 3))
    tail, head = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    products = (after[head] - after[tail])[:, :, None] * (before[head] - before[tail])[:, None, :]
    np.add.at(ring, tail, products)
    np.add.at(ring, head, products)
    # The normals make flat surroundings as good as curved ones.
    size = np.sqrt(np.square(ring).sum(axis=(1, 2)))[:, None, None]
    normals = vertex_normals(after, faces)[:, :, None] * vertex_normals(before, faces)[:, None, :]
    left, _, right = np.linalg.svd(ring + 0.3 * size * normals)
    left[..., 2] *= np.linalg.det(left @ right)[:, None]
    return np.asarray(np.einsum("nij,njk,nk->ni", left, right, moved))
