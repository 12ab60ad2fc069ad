"""Joints of a body, derived from the model: no bones are learned, and none have to be stored.

The body is a sum of one field a part, Y = sum_p V_p. Where everything beyond a joint turns by D,
the other fields add up to one vector c there, so that Y' = c + D (Y - c): c is the joint. The
pose-dependent deformation moves it by 1/2 sum_m e_m x u_m, with u_m its effect for a radian about
axis m. Derivation: docs/mathematics.md, "Joints".
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import edges, vertex_areas

Array = NDArray[np.float64]

_OWNED = 0.98
"""Skin weight above which a vertex moves only with its part."""


def joint_positions(model: BodyModel, vertices: Array, rotations: Array) -> Array:
    """Joints (L, 3) of a posed body, metres; the root's is the pelvis' centroid.

    Args:
        vertices: (P, 3) in the template's topology.
        rotations: (L, 3, 3) of its parts, absolute.
    """
    pulls, shifts = _template_terms(model)
    joints = model.anchor @ vertices + pulls @ edges(vertices, model.faces).reshape(-1, 3)
    before = rotations[model.part_parents]
    return np.asarray(joints + np.einsum("pij,pj->pi", before, shifts))


@lru_cache(maxsize=2)
def _template_terms(model: BodyModel) -> tuple[Array, Array]:
    """Matrix (L, 3K) from a body's edges (3K, 3) to its joints less the root's, by the adjoint
    solve, and how far the pose-dependent deformation moves them, (L, 3) in the parent's frame."""
    areas = vertex_areas(model.mean, model.faces)
    owners = np.zeros((model.vertex_count, model.part_count))
    for part in range(model.part_count):
        share = np.clip(model.vertex_weights[:, part] - _OWNED, 0.0, None) * areas
        if not share.any():
            share = model.vertex_weights[:, part] ** 4 * areas
        owners[:, part] = share / share.sum()
    green = model.solver.solve(owners - model.anchor[:, None])
    reach = model.solver.incidence.T @ green
    outside = 1.0 - model.triangle_part_weights @ _descends(model.part_parents).astype(float)
    pulls = np.ascontiguousarray((reach * np.repeat(outside, 3, axis=0)).T)
    pulls[0] = 0.0
    fields = model.pose_fields.reshape(model.part_count - 1, 3, model.vertex_count, 3)
    offsets = np.einsum("vp,pmvi->pmi", owners[:, 1:], fields)
    shifts = np.zeros((model.part_count, 3))
    shifts[1:] = 0.5 * np.cross(np.eye(3), offsets).sum(axis=1)
    return pulls, shifts


def _descends(parents: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Mask (L, L): whether the row's part is the column's part or a descendant of it."""
    found = np.eye(len(parents), dtype=bool)
    for part, parent in enumerate(parents):
        if parent >= 0:
            found[part] |= found[parent]
    return found
