"""The model at sample vertices: fast values and derivatives.

Y = sum_p R_p B_p(X) + t. B_p is nearly constant over the vertices of another limb, since everything
beyond a joint moves as a whole. Therefore the samples of a part share a constant for each p, and a
sample has a block of its own only where it differs from that by more than hundredths of a
millimetre. That is a third of all, near the borders of the parts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.cache import cached_arrays
from workers.scape.model.kernels import add_blocks, add_places

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Index = NDArray[np.int32]

_SHAPE_FLOOR_M = 4e-5
"""Standard deviation over bodies below which a block is left out."""
_TWIST_FLOOR_M = 1.5e-4
"""The same for a radian of a relative twist."""
_SOLVED_AT_ONCE = 192
_LAYOUT = 1
"""Version of the cached arrays: those of another version are built anew."""


@dataclass(frozen=True, slots=True)
class SampledBody:
    """The model at n vertices, with L parts and F = 1 + B + 3 (L - 1) fields (mean, U, C)."""

    model: BodyModel
    indices: NDArray[np.int64]
    groups: Index
    """(n,): part of each sample, whose constants it shares."""
    shared: Array32
    """(L, L, 3, F): B_p shared by the samples of a part; first index the samples' part, then p."""
    starts: Index
    """(n, 2): range of each sample's blocks."""
    parts: Index
    mean: Array32
    """(m, 3): difference of a sample's B_p from the shared one."""
    shape: Array32
    """(m, 3, B)."""
    twist_starts: Index
    twist_parts: Index
    twist_joints: Index
    twist_blocks: Array32
    """(k, 3, 3): B_p of unit twists of one joint, one axis per column."""

    @classmethod
    def build(cls, model: BodyModel, indices: NDArray[np.integer[Any]]) -> SampledBody:
        """Prepare the model at vertices (n,); the arrays are kept in the user's cache folder."""
        chosen = np.asarray(indices, dtype=np.int64)
        made_by = f"{_LAYOUT} {_SHAPE_FLOOR_M} {_TWIST_FLOOR_M} {model.sha256}"
        key = hashlib.sha256(made_by.encode() + chosen.tobytes()).hexdigest()
        arrays = cached_arrays(f"samples-{key[:32]}", lambda: _blocks(model, chosen))
        return cls(model, chosen, model.part_of_vertex[chosen].astype(np.int32), **arrays)

    def first(self, count: int) -> SampledBody:
        """The first samples only."""
        return SampledBody(
            self.model,
            self.indices[:count],
            self.groups[:count],
            self.shared,
            self.starts[:count],
            self.parts,
            self.mean,
            self.shape,
            self.twist_starts[:count],
            self.twist_parts,
            self.twist_joints,
            self.twist_blocks,
        )

    def evaluate(self, state: BodyState) -> Array:
        """Positions (n, 3) in metres."""
        twists = self._twists(state)
        coefficients = np.concatenate([[1.0], state.beta, twists[1:].ravel()])
        arms = np.einsum("pij,gpj->gi", state.rotations, self.shared @ coefficients)
        positions = (arms + state.translation)[self.groups]
        add_places(
            self._blocks(),
            state.rotations.astype(np.float32),
            state.beta[: _used(state)].astype(np.float32),
            twists.astype(np.float32),
            positions,
        )
        return positions

    def jacobian(self, state: BodyState, shapes: int | None = None) -> tuple[Array, Array32]:
        """Positions (n, 3) and derivatives (n, 3, D), D = 3 L + shapes + 3.

        The parameters are delta (L, 3) with R_p <- so3_exp(delta_p) R_p, then the first `shapes`
        of beta (all by default), then the translation. The pose-dependent fields follow the
        twists' first-order change. Float32 moves no vertex by more than a hundredth of a
        millimetre a step.
        """
        model, rotations = self.model, state.rotations
        shapes = model.beta_count if shapes is None else min(shapes, model.beta_count)
        twists = self._twists(state)
        positions, derivative = self._of_groups(state, twists, shapes)
        positions, derivative = positions[self.groups], derivative[self.groups]
        add_blocks(
            self._blocks(),
            model.part_parents,
            rotations.astype(np.float32),
            state.beta[: max(shapes, _used(state))].astype(np.float32),
            twists.astype(np.float32),
            positions,
            derivative,
        )
        return positions, derivative

    def _blocks(self) -> tuple[NDArray[Any], ...]:
        """Arrays in the order that the kernels take them."""
        return (
            self.starts,
            self.parts,
            self.mean,
            self.shape,
            self.twist_starts,
            self.twist_parts,
            self.twist_joints,
            self.twist_blocks,
        )

    def _twists(self, state: BodyState) -> Array:
        """Relative twists (L, 3), with 0 for the root's, which does not change the body's form."""
        twists = self.model.relative_twists(state.rotations)
        twists[0] = 0.0
        return twists

    def arms(self, state: BodyState, joints: Sequence[int]) -> tuple[Array32, Array32]:
        """B_p(X) (n, L, 3) and its derivative (n, L, 3, J, 3) by the relative twists of J parts."""
        components = self.model.beta_count
        twists = self.model.relative_twists(state.rotations).astype(np.float32)
        coefficients = np.concatenate([[1.0], state.beta, twists[1:].ravel()]).astype(np.float32)
        found = (self.shared @ coefficients)[self.groups]
        shared = self.shared[..., 1 + components :].reshape(*self.shared.shape[:3], -1, 3)
        change = shared[:, :, :, np.array(joints, int) - 1][self.groups]
        sample, block = _expanded(self.starts)
        own = self.mean[block] + self.shape[block] @ coefficients[1 : 1 + components]
        found[sample, self.parts[block]] += own
        sample, block = _expanded(self.twist_starts)
        part, joint, fields = (
            self.twist_parts[block], self.twist_joints[block], self.twist_blocks[block]
        )  # fmt: skip
        np.add.at(found, (sample, part), np.einsum("kij,kj->ki", fields, twists[joint]))
        for index, wanted in enumerate(joints):
            mine = joint == wanted
            change[sample[mine], part[mine], :, index] += fields[mine]
        return found, change

    def _of_groups(
        self, state: BodyState, twists: Array, shapes: int
    ) -> tuple[Array, NDArray[np.float32]]:
        """Positions (L, 3) and derivatives (L, 3, D) of the shared constants."""
        rotations = state.rotations
        parts = len(rotations)
        coefficients = np.concatenate([[1.0], state.beta, twists[1:].ravel()])
        arms = np.einsum("pij,gpj->gpi", rotations, self.shared @ coefficients)
        side_by_side = rotations.transpose(1, 0, 2).reshape(3, -1).astype(np.float32)
        fields = side_by_side @ self.shared.reshape(parts, 3 * parts, -1)
        derivative = np.zeros((parts, 3, 3 * parts + shapes + 3), np.float32)
        turning = derivative[:, :, : 3 * parts].reshape(parts, 3, parts, 3)
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            turning[:, i, :, j] = arms[:, :, k]
            turning[:, i, :, k] = -arms[:, :, j]
        chain = twist_chain(self.model, rotations)
        derivative[:, :, : 3 * parts] = turning.reshape(parts, 3, -1)
        derivative[:, :, : 3 * parts] += fields[:, :, -3 * (parts - 1) :] @ chain
        derivative[:, :, 3 * parts : -3] = fields[:, :, 1 : 1 + shapes]
        derivative[:, :, -3:] = np.eye(3, dtype=np.float32)
        return arms.sum(axis=1) + state.translation, derivative


def _used(state: BodyState) -> int:
    """Number of components up to the last that is not 0."""
    return 1 + int(np.flatnonzero(state.beta).max(initial=-1))


def _expanded(starts: Index) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Sample and block indices (m,) of all blocks in the ranges (n, 2)."""
    counts = starts[:, 1] - starts[:, 0]
    sample = np.repeat(np.arange(len(starts)), counts)
    before = np.cumsum(counts) - counts
    return sample, np.repeat(starts[:, 0] - before, counts) + np.arange(counts.sum())


def twist_chain(model: BodyModel, rotations: Array) -> Array:
    """Derivative (3 (L - 1), 3 L) of the relative twists by the parts' rotation increments."""
    parts = model.part_count
    change = np.zeros((3 * (parts - 1), 3 * parts))
    for part, parent in enumerate(model.part_parents):
        if parent >= 0:
            back = rotations[parent].T
            row = slice(3 * (part - 1), 3 * part)
            change[row, 3 * part : 3 * part + 3] = back
            change[row, 3 * parent : 3 * parent + 3] = -back
    return change


def _blocks(model: BodyModel, indices: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Arrays of SampledBody that depend only on the model and the samples."""
    parts, components = model.part_count, model.beta_count
    fields = np.concatenate([model.mean[None].astype(np.float32), model.directions])
    columns = np.concatenate([fields, model.pose_fields]).transpose(1, 2, 0)
    columns = np.ascontiguousarray(columns).reshape(model.vertex_count, -1)
    forces = []
    for member in range(parts):
        laplacian = model.part_laplacian(member).astype(np.float32)
        rows = np.flatnonzero(np.diff(laplacian.indptr))
        forces.append((rows, laplacian[rows] @ columns))
    field_count = columns.shape[1] // 3
    del columns
    groups = model.part_of_vertex[indices]
    shared = np.zeros((parts, parts, 3, field_count), np.float32)
    starts, twist_starts = np.zeros((2, len(indices), 2), np.int32)
    found: dict[str, list[NDArray[Any]]] = {
        key: [] for key in ("parts", "mean", "shape", "twist_parts", "twist_joints", "twist_blocks")
    }
    done, twists_done = 0, 0
    for group in range(parts):
        mine = np.flatnonzero(groups == group)
        if not len(mine):
            continue
        basis = _basis(model, indices[mine], forces)
        shared[group] = basis.mean(axis=0)
        basis -= shared[group]
        spread = basis[..., 1 : 1 + components]
        size = np.sqrt(np.einsum("npcf,npcf->np", spread, spread))
        size = np.maximum(size, np.abs(basis[..., 0]).max(axis=2))
        sample, part = np.nonzero(size > _SHAPE_FLOOR_M)
        starts[mine] = _bounds(sample, len(mine), done)
        done += len(sample)
        found["parts"].append(part.astype(np.int32))
        found["mean"].append(basis[sample, part, :, 0])
        found["shape"].append(spread[sample, part])
        twisted = basis[..., 1 + components :].reshape(len(mine), parts, 3, parts - 1, 3)
        sample, part, turned = np.nonzero(np.abs(twisted).max(axis=(2, 4)) > _TWIST_FLOOR_M)
        twist_starts[mine] = _bounds(sample, len(mine), twists_done)
        twists_done += len(sample)
        found["twist_parts"].append(part.astype(np.int32))
        found["twist_joints"].append((turned + 1).astype(np.int32))
        found["twist_blocks"].append(twisted[sample, part, :, turned])
    return {
        "shared": shared,
        "starts": starts,
        "twist_starts": twist_starts,
        **{key: np.concatenate(pieces) for key, pieces in found.items()},
    }


def _bounds(sample: NDArray[np.intp], count: int, offset: int) -> Index:
    """Range (count, 2) of each sample's entries in a sorted list of samples."""
    border = np.searchsorted(sample, np.arange(count + 1)) + offset
    return np.stack([border[:-1], border[1:]], axis=1).astype(np.int32)


def _basis(
    model: BodyModel, indices: NDArray[np.int64], forces: list[tuple[NDArray[np.intp], Array32]]
) -> Array32:
    """B (n, L, 3, F) by adjoint solutions, one column per sample."""
    basis = np.empty((len(indices), len(forces), 3, forces[0][1].shape[1] // 3), np.float32)
    for start in range(0, len(indices), _SOLVED_AT_ONCE):
        chosen = indices[start : start + _SOLVED_AT_ONCE]
        unit = np.zeros((model.vertex_count, len(chosen)))
        unit[chosen, np.arange(len(chosen))] = 1.0
        # The value at a vertex minus that at the pelvis' centroid.
        unit -= model.anchor[:, None]
        green = model.solver.solve(unit).astype(np.float32).T
        for part, (rows, force) in enumerate(forces):
            found = (green[:, rows] @ force).reshape(len(chosen), 3, -1)
            basis[start : start + len(chosen), part] = found
    return basis
