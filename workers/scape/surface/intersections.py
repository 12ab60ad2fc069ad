"""Removal of self-intersections and flipped triangles from a fitted surface, by small motions.

Where the surface leaves the model's too abruptly (lips, ears, between fingers), the offset from the
model is smoothed, so that the model's shape is restored there. Where the model itself overlaps (an
arm on the trunk, thighs), the surface is smoothed instead: both sides of a contact are flattened
until they separate. Patches grow only as long as they still cross.

Most crossings lie in skin that no camera saw, and so does the error that they show: skin with
readings on it stays where it is as long as the rest can give way.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces, area_vectors, vertex_normals
from workers.scape.surface.contacts import grown, neighbour_mean, parted
from workers.scape.surface.crossings import Pairs, at_vertices, crossing_pairs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MAX_ROUNDS = 60
_HOLDING_ROUNDS = 25
"""Rounds in which measured skin is held."""
_YIELDING = 0.3
"""Share of the way to the neighbours' mean that a held corner of a bad triangle moves in one of
these rounds."""
_OFFSET_ROUNDS = 3
"""Rounds in which offsets are smoothed; vertices that still cross after them are flattened."""
_ROUNDS_PER_RING = 4
"""Rounds after which patches grow by one ring of vertices."""
_MAX_TRIANGLES = 120
"""Triangles of a connected patch that still cross after the first rounds: a larger patch is left
alone, since flattening does not separate it."""
_SWEEPS = 8
"""Times that offsets are replaced by their neighbours' mean in one round."""
_DEEPEST_M = 0.030
"""Depth to which flesh yields: limbs that are deeper inside each other are left alone."""
_MEASURED_YIELDS_M = 0.010
"""Farthest motion of measured skin: a contact that takes more, as of fingers in a fist, stays."""
_FLATTENING = 0.75
"""Share of the way to the neighbours' mean that a flattened vertex moves in one round."""


def self_intersections(vertices: Array, faces: Faces) -> int:
    """Number of pairs of triangles that cross."""
    return len(crossing_pairs(vertices, faces))


def turned_over(vertices: Array, reference: Array, faces: Faces) -> Mask:
    """Mask (K,) of triangles whose normal is opposite to the one on a reference surface (P, 3) and
    to that of their surroundings."""
    here, there = area_vectors(vertices, faces), area_vectors(reference, faces)
    turned = np.einsum("ki,ki->k", here, there) <= 0.0
    around = vertex_normals(vertices, faces)[faces[turned]].sum(axis=1)
    turned[turned] = np.einsum("ki,ki->k", here[turned], around) <= 0.0
    return np.asarray(turned)


def untangled(
    model: BodyModel,
    vertices: Array,
    reference: Array,
    measured: Mask,
    crossing: Pairs | None = None,
) -> Array:
    """Surface (P, 3) without crossings and flipped triangles.

    Parts that are centimetres inside each other, as on no real body, stay as they are: flattening
    them until they separate would deform them.

    Args:
        vertices: (P, 3), the fitted surface.
        reference: (P, 3), the model's surface in the same pose and shape.
        measured: (P,), vertices of triangles with readings on them. They are moved only where
            crossings remain otherwise.
        crossing: (m, 2), pairs of the fitted surface's triangles that cross, if they are known.
    """
    faces = model.faces
    mean = neighbour_mean(model)
    if crossing is None:
        crossing = crossing_pairs(vertices, faces)
    current = first = parted(model, vertices, measured, crossing)
    if current is not vertices:
        crossing = crossing_pairs(current, faces)
    # What was parted keeps its offset from a model that was parted as well.
    relaxed_to = reference + (current - vertices)
    trouble = np.zeros(len(vertices), np.int64)
    given_up: Mask = np.zeros(len(faces), bool)
    held = measured
    for round_ in range(_MAX_ROUNDS):
        if round_ == _HOLDING_ROUNDS:
            held, trouble = np.zeros_like(measured), np.zeros_like(trouble)
        bad = _bad(current, reference, faces, crossing) & ~given_up
        if round_ == _OFFSET_ROUNDS:
            given_up = bad & _in_large_patches(faces, bad, mean)
            bad &= ~given_up
        if not bad.any():
            break
        corners = np.zeros(len(vertices), bool)
        corners[faces[bad]] = True
        marked = grown(corners, mean, 1)
        trouble += marked
        around = grown(marked, mean, 1 + round_ // _ROUNDS_PER_RING)
        patch, yielding = np.flatnonzero(around & ~held), np.flatnonzero(corners & held)
        relaxed = _relaxed(current, relaxed_to, patch, trouble[patch] > _OFFSET_ROUNDS, mean)
        relaxed[yielding] += _YIELDING * (mean[yielding] @ current - current[yielding])
        current = relaxed
        changed = np.zeros(len(vertices), bool)
        changed[patch] = changed[yielding] = True
        crossing = crossing_pairs(current, faces, at_vertices(changed, faces))
    else:
        bad = _bad(current, reference, faces, crossing)
    farthest_m = np.where(measured, _MEASURED_YIELDS_M, _DEEPEST_M)
    spoiled = np.linalg.norm(current - first, axis=1) > farthest_m
    spoiled[faces[bad | given_up]] = True
    return _restored(current, first, np.flatnonzero(spoiled), mean)


def _bad(vertices: Array, reference: Array, faces: Faces, crossing: Pairs) -> Mask:
    """Mask (K,) of flipped triangles, and of those in pairs (m, 2) that cross."""
    bad = turned_over(vertices, reference, faces)
    bad[crossing.ravel()] = True
    return bad


def _in_large_patches(faces: Faces, bad: Mask, mean: sp.csr_matrix) -> Mask:
    """Mask (K,) of triangles in connected patches with many bad ones."""
    corners = np.zeros(mean.shape[0], bool)
    corners[faces[bad]] = True
    around = np.flatnonzero(grown(corners, mean, 1))
    _, place = connected_components(mean[around][:, around], directed=False)
    of_vertex = np.full(len(corners), -1)
    of_vertex[around] = place
    of_face = of_vertex[faces[:, 0]]
    large = np.bincount(of_face[bad], minlength=place.max(initial=0) + 1) > _MAX_TRIANGLES
    return np.asarray((of_face >= 0) & large[of_face])


def _restored(
    vertices: Array, before: Array, corners: NDArray[np.intp], mean: sp.csr_matrix
) -> Array:
    """Surface in which changed patches that contain one of the corners are as they were before."""
    changed = np.flatnonzero((vertices != before).any(axis=1))
    _, patch = connected_components(mean[changed][:, changed], directed=False)
    back = changed[np.isin(patch, patch[np.isin(changed, corners)])]
    restored = vertices.copy()
    restored[back] = before[back]
    return restored


def _relaxed(
    vertices: Array, reference: Array, patch: NDArray[np.intp], flat: Mask, mean: sp.csr_matrix
) -> Array:
    """Surface with the offsets of a patch smoothed, and some of its vertices (mask) flattened."""
    offset = vertices - reference
    rows = mean[patch]
    for _ in range(_SWEEPS):
        offset[patch] = rows @ offset
    relaxed = reference + offset
    chosen = patch[flat]
    relaxed[chosen] = vertices[chosen] + _FLATTENING * (mean[chosen] @ vertices - vertices[chosen])
    return relaxed
