"""The SCAPE body model: vertices from pose and shape, and pose and shape from vertices.

After Anguelov et al. 2005, with blended part rotations: the edge e of triangle k becomes

    (sum_p w_kp R_p) (e of the neutral surface X(beta, theta)),
    X = mean + sum_j beta_j U_j + sum_m twist_m C_m        (C: the pose-dependent deformation Q)

and the vertices are those whose edges are nearest to these in least squares. The solution is linear
and the same for each coordinate, so a part's rotation passes through it: Y = sum_p R_p B_p(X) + t.
`SampledBody` keeps B for sample vertices; the whole body takes one sparse solution.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from station.core.errors import FormatError
from station.core.geometry import nearest_rotation, so3_exp, so3_log
from workers.scape.model.deformation import (
    EdgeSolver,
    Faces,
    Graph,
    edges,
    neighbours,
    vertex_areas,
)

FORMAT = "booth-body-model"
VERSIONS = frozenset({1})
SHIPPED = "data/body.npz"

HAND = ("hand", "thumb", "fingers")
"""Parts of a hand, each after its parent."""
FLOOR = "floor"
"""Stands beside the parts for where a body stands: heights end there."""

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class BodyState:
    """Parameters of a body."""

    rotations: Array
    """(L, 3, 3): rotation of each part from the neutral pose to the world."""
    beta: Array
    """(B,): shape, in standard deviations of the training bodies."""
    translation: Array
    """(3,): position of the pelvis' centroid, metres."""


@dataclass(frozen=True, eq=False)
class BodyModel:
    """Learned model of L parts, P vertices, K triangles and B shape components."""

    name: str
    sha256: str
    faces: Faces
    """(K, 3), counter-clockwise seen from outside."""
    part_names: tuple[str, ...]
    part_parents: NDArray[np.int32]
    """(L,): index of the parent, which comes earlier; -1 for the root."""
    vertex_weights: Array
    """(P, L): skin weights, rows sum to 1."""
    mean: Array
    """(P, 3): the mean body in the neutral pose, standing on z = 0, facing -y."""
    directions: Array32
    """(B, P, 3): U_j, displacement by one standard deviation."""
    pose_fields: Array32
    """(3 (L - 1), P, 3): C_m, displacement by one radian of each relative twist."""
    landmarks: dict[str, int]
    symmetry: NDArray[np.int32]
    """(P,): index of the mirrored vertex."""
    vertex_sigma_m: Array
    """(P,): standard deviation of the components' residual on held-out bodies."""
    twist_mean: Array
    """(3 (L - 1),): prior over the relative twists, radians."""
    twist_covariance: Array
    """(3 (L - 1), 3 (L - 1))."""

    @property
    def part_count(self) -> int:
        return len(self.part_names)

    @property
    def beta_count(self) -> int:
        return len(self.directions)

    @property
    def vertex_count(self) -> int:
        return len(self.mean)

    @cached_property
    def part_of_vertex(self) -> NDArray[np.int32]:
        """(P,): part with the largest weight."""
        return np.argmax(self.vertex_weights, axis=1).astype(np.int32)

    def of_parts(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Mask (P,) of the vertices of some parts."""
        return np.isin(self.part_of_vertex, [self.part_names.index(name) for name in names])

    @cached_property
    def hand_parts(self) -> NDArray[np.intp]:
        """Indices of the parts of both hands."""
        return np.flatnonzero([name.rpartition("_")[0] in HAND for name in self.part_names])

    @cached_property
    def adjacency(self) -> sp.csr_matrix:
        """(P, P): 1 where an edge joins two vertices."""
        first, columns = self.neighbours
        return sp.csr_matrix((np.ones(len(columns)), columns, first))

    @cached_property
    def solver(self) -> EdgeSolver:
        return EdgeSolver.build(self.mean, self.faces)

    @cached_property
    def neighbours(self) -> Graph:
        return neighbours(self.faces)

    @cached_property
    def triangle_part_weights(self) -> Array:
        """(K, L): w_kp."""
        return np.asarray(self.vertex_weights[self.faces].mean(axis=1))

    @cached_property
    def anchor(self) -> Array:
        """(P,): weights whose mean is the pelvis' centroid, which the translation refers to."""
        weights = self.vertex_weights[:, 0] * vertex_areas(self.mean, self.faces)
        return np.asarray(weights / weights.sum())

    @cached_property
    def vertex_shares(self) -> Array:
        """(P,): area that each vertex represents, 1 on average."""
        areas = vertex_areas(self.mean, self.faces)
        return np.asarray(areas / areas.mean())

    def part_laplacian(self, part: int) -> sp.csr_matrix:
        """L_p (P, P): Laplacian with every triangle weighted by its share in a part."""
        solver = self.solver
        share = np.repeat(self.triangle_part_weights[:, part], 3)
        tail = self.faces.ravel()
        head = np.roll(self.faces, -1, axis=1).ravel()
        column = np.arange(len(tail))
        ones = np.ones(len(tail))
        gradient = sp.csr_matrix(
            (np.r_[ones, -ones], (np.r_[column, column], np.r_[head, tail])),
            shape=(len(column), self.vertex_count),
        )
        return (solver.incidence.multiply(share[None, :]).tocsr() @ gradient).tocsr()

    def neutral_state(self) -> BodyState:
        """State of the mean body in the neutral pose."""
        return BodyState(
            np.tile(np.eye(3), (self.part_count, 1, 1)),
            np.zeros(self.beta_count),
            np.asarray(self.anchor @ self.mean),
        )

    def relative_twists(self, rotations: Array) -> Array:
        """Rotation vectors (L, 3): the root's, then each part's relative to its parent, radians."""
        relative = rotations.copy()
        children = self.part_parents >= 0
        relative[children] = (
            np.swapaxes(rotations[self.part_parents[children]], 1, 2) @ rotations[children]
        )
        return so3_log(relative)

    def absolute_rotations(self, twists: Array) -> Array:
        """Absolute rotations (..., L, 3, 3) of relative twists: inverse of `relative_twists`."""
        rotations = so3_exp(twists)
        by_part = np.moveaxis(rotations, -3, 0)
        for part, parent in enumerate(self.part_parents):
            if parent >= 0:
                by_part[part] = by_part[parent] @ by_part[part]
        return rotations

    def neutral_surface(self, state: BodyState) -> Array:
        """X (P, 3): neutral surface with the shape and the pose-dependent deformation."""
        twists = self.relative_twists(state.rotations)[1:].ravel().astype(np.float32)
        offset = np.tensordot(state.beta.astype(np.float32), self.directions, 1)
        offset += np.tensordot(twists, self.pose_fields, 1)
        return np.asarray(self.mean + offset)

    def vertices(self, state: BodyState) -> Array:
        """Vertices (P, 3) in metres."""
        return self.turned(self.neutral_surface(state), state.rotations, state.translation)

    def turned(self, surface: Array, rotations: Array, translation: Array) -> Array:
        """Posed surface of a neutral one (P, 3): parts rotated, pelvis at the translation."""
        blended = (self.triangle_part_weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        found = self.solver.carried(surface, blended)
        return np.asarray(found - self.anchor @ found + translation)

    def unturned(self, vertices: Array, rotations: Array) -> Array:
        """Neutral surface (P, 3) of a posed one, with the mean body's pelvis."""
        blended = (self.triangle_part_weights @ rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        found = self.solver.carried(vertices, _inverse(blended))
        return np.asarray(found + self.anchor @ (self.mean - found))

    def repose(self, vertices: Array, state: BodyState, new_state: BodyState) -> Array:
        """Free-form surface (P, 3) that was fitted at `state`, moved to another pose.

        The offsets of the surface from the model are rotated with the parts that they lie on and
        added to the model in the new pose.
        """
        beyond = vertices - self.vertices(state)
        turns = new_state.rotations @ np.swapaxes(state.rotations, 1, 2)
        blended = (self.vertex_weights @ turns.reshape(-1, 9)).reshape(-1, 3, 3)
        return self.vertices(new_state) + np.einsum("vij,vj->vi", blended, beyond)

    def part_rotations(self, surface: Array, vertices: Array, weight: Array | None = None) -> Array:
        """Rotations (L, 3, 3) of the parts from a neutral surface to a posed one.

        Args:
            weight: (P,), of the vertices; all alike by default. A triangle has its corners' mean.
        """
        source, target = edges(surface, self.faces), edges(vertices, self.faces)
        weights = self.triangle_part_weights**2 * self.solver.triangle_weights[:, None]
        if weight is not None:
            weights = weights * weight[self.faces].mean(axis=1)[:, None]
        products = np.einsum("kei,kej->kij", target, source).reshape(-1, 9)
        return nearest_rotation((weights.T @ products).reshape(-1, 3, 3))

    def project(
        self,
        vertices: Array,
        iterations: int = 6,
        ridge: float = 1e-4,
        weight: Array | None = None,
    ) -> BodyState:
        """State whose body is close to a mesh (P, 3) in the template's topology.

        Alternates closed forms: rotations of the parts by Procrustes, shape by ridge regression of
        the unposed surface on the components.

        Args:
            weight: (P,), of the vertices; all alike by default.
        """
        weight = np.ones(len(vertices)) if weight is None else weight
        flat = self.directions.reshape(self.beta_count, -1)
        mass = np.repeat(weight * vertex_areas(self.mean, self.faces), 3).astype(np.float32)
        weighted = flat * mass
        normal = (weighted @ flat.T).astype(np.float64)
        normal[np.diag_indices_from(normal)] += ridge * np.trace(normal) / len(normal)
        state = self.neutral_state()
        surface = self.mean
        for _ in range(iterations):
            rotations = self.part_rotations(surface, vertices, weight)
            state = replace(state, rotations=rotations)
            pose = self.neutral_surface(replace(state, beta=np.zeros(self.beta_count)))
            offset = (self.unturned(vertices, rotations) - pose).ravel().astype(np.float32)
            state = replace(state, beta=np.linalg.solve(normal, (weighted @ offset).astype(float)))
            surface = self.neutral_surface(state)
        placed = self.vertices(state)
        areas = weight * vertex_areas(vertices, self.faces)
        shift = areas @ (vertices - placed) / areas.sum()
        return replace(state, translation=state.translation + shift)


def _inverse(matrices: Array) -> Array:
    """Inverses of 3x3 matrices (K, 3, 3), by cofactors: much quicker than a general inverse."""
    a, b, c = (matrices[:, i] for i in range(3))
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    return np.asarray(cofactors / np.einsum("ki,ki->k", a, cofactors[:, :, 0])[:, None, None])


def save_model(path: Path, fields: dict[str, Any], metadata: dict[str, Any]) -> None:
    """Write a model file: compressed npz without pickles, whose `metadata` is JSON text."""
    document = {"format": FORMAT, "version": 1, **metadata}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, metadata=np.array(json.dumps(document)), **fields)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_bytes(buffer.getvalue())
    temporary.replace(path)


def load_model(path: Path | None = None) -> BodyModel:
    """Load a model file, by default the one that comes with the package.

    Raises:
        FormatError: the file is missing, torn, of another version or not a body model.
    """
    source = path or Path(str(resources.files("workers.scape.model").joinpath(SHIPPED)))
    try:
        content = source.read_bytes()
    except OSError as cause:
        raise FormatError(
            f"{source}: the body model cannot be read ({cause.strerror}); "
            "make one with: reconstruct train --out FILE"
        ) from None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            fields = {key: archive[key] for key in archive.files}
        metadata = json.loads(str(fields.pop("metadata")))
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as cause:
        raise FormatError(f"{source} is torn or not a body model ({cause})") from None
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise FormatError(f"{source} is not a {FORMAT} file")
    if metadata.get("version") not in VERSIONS:
        readable = ", ".join(map(str, sorted(VERSIONS)))
        raise FormatError(
            f"{source} has {FORMAT} version {metadata.get('version')!r}; "
            f"this program reads {readable}"
        )
    try:
        return _from_fields(fields, metadata, hashlib.sha256(content).hexdigest())
    except (KeyError, ValueError, TypeError) as cause:
        raise FormatError(f"{source} is not a complete body model ({cause})") from None


def _from_fields(fields: dict[str, Any], metadata: dict[str, Any], sha256: str) -> BodyModel:
    vertices = len(fields["mean"])
    scale = fields["direction_scale"].astype(np.float32)
    weights = np.zeros((vertices, len(metadata["parts"])))
    np.put_along_axis(weights, fields["weight_parts"].astype(np.int64), fields["weights"], axis=1)
    twist_count = 3 * (len(metadata["parts"]) - 1)
    pose_fields = np.zeros((twist_count, vertices, 3), dtype=np.float32)
    pose_fields[fields["pose_rows"], fields["pose_vertices"]] = fields["pose_values"]
    return BodyModel(
        name=str(metadata["name"]),
        sha256=sha256,
        faces=fields["faces"].astype(np.int32),
        part_names=tuple(metadata["parts"]),
        part_parents=fields["part_parents"].astype(np.int32),
        vertex_weights=weights / weights.sum(axis=1, keepdims=True),
        mean=fields["mean"].astype(np.float64),
        directions=fields["directions"].astype(np.float32) * scale[:, None, None],
        pose_fields=pose_fields,
        landmarks={str(key): int(value) for key, value in metadata["landmarks"].items()},
        symmetry=fields["symmetry"].astype(np.int32),
        vertex_sigma_m=fields["vertex_sigma"].astype(np.float64),
        twist_mean=fields["twist_mean"].astype(np.float64),
        twist_covariance=fields["twist_covariance"].astype(np.float64),
    )
