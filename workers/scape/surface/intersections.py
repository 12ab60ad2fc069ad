"""A surface that neither crosses itself nor turns a triangle over, by the least motion.

Where the surface left the model's too abruptly (lips, ears, between fingers) it is the offset from
the model that relaxes, so that the model's own shape stands there, carried by its surroundings.
Where the model itself overlaps (an arm on the trunk, thighs) the surface relaxes instead: both
sides of a contact flatten until they part. Patches grow only while they have to.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces, area_vectors, vertex_normals
from workers.scape.surface.crossings import crossing_pairs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MOST_ROUNDS = 45
_STUBBORN_ROUNDS = 3
"""Rounds after which a place no longer counts on the model's own shape."""
_ROUNDS_A_RING = 4
_HOPELESS = 120
"""Triangles of one place that still cross by then: no flattening parts them."""
_SWEEPS = 8
_DEEPEST_M = 0.030
"""No two limbs of a body are farther inside each other than flesh gives way."""
_FLATTENING = 0.75
"""Share of the way to the neighbours' mean that a stubborn vertex goes in one round."""


def self_intersections(vertices: Array, faces: Faces) -> int:
    """How many pairs of triangles cross."""
    return len(crossing_pairs(vertices, faces))


def turned_over(vertices: Array, reference: Array, faces: Faces) -> Mask:
    """(K,): triangles that look away from where they look on a reference surface (P, 3), and from
    where their surroundings look."""
    here, there = area_vectors(vertices, faces), area_vectors(reference, faces)
    turned = np.einsum("ki,ki->k", here, there) <= 0.0
    around = vertex_normals(vertices, faces)[faces[turned]].sum(axis=1)
    turned[turned] = np.einsum("ki,ki->k", here[turned], around) <= 0.0
    return np.asarray(turned)


def untangled(model: BodyModel, vertices: Array, reference: Array) -> Array:
    """The surface (P, 3) without crossings and turned triangles.

    Parts that are pushed centimetres into each other, as no body can be, stay so: to flatten them
    until they part would spoil them.

    Args:
        vertices: (P, 3), fitted.
        reference: (P, 3): the model's own surface in the same pose and shape.
    """
    faces = model.faces
    mean = _neighbour_mean(model)
    current = gentle = vertices
    trouble = np.zeros(len(vertices), np.int64)
    asking: Mask = np.ones(len(faces), bool)
    given_up: Mask = np.zeros(len(faces), bool)
    for round_ in range(_MOST_ROUNDS):
        bad = _bad(current, reference, faces, asking) & ~given_up
        if round_ == _STUBBORN_ROUNDS:
            gentle = current
            given_up = bad & _in_large_places(faces, bad, mean)
            bad &= ~given_up
        if not bad.any():
            break
        corners = np.zeros(len(vertices), bool)
        corners[faces[bad]] = True
        marked = _grown(corners, mean, 1)
        trouble += marked
        patch = np.flatnonzero(_grown(marked, mean, 1 + round_ // _ROUNDS_A_RING))
        current = _relaxed(current, reference, patch, trouble[patch] > _STUBBORN_ROUNDS, mean)
        moved = np.zeros(len(vertices), bool)
        moved[patch] = True
        asking = np.asarray(moved[faces].any(axis=1))
    else:
        bad = _bad(current, reference, faces, asking)
    spoiled = np.linalg.norm(current - gentle, axis=1) > _DEEPEST_M
    spoiled[faces[bad | given_up]] = True
    return _restored(current, gentle, np.flatnonzero(spoiled), mean)


def _bad(vertices: Array, reference: Array, faces: Faces, asking: Mask) -> Mask:
    """(K,): triangles that are turned over, or cross another where one of the two asks."""
    bad = turned_over(vertices, reference, faces)
    bad[crossing_pairs(vertices, faces, asking).ravel()] = True
    return bad


def _in_large_places(faces: Faces, bad: Mask, mean: sp.csr_matrix) -> Mask:
    """(K,): triangles of places where many bad ones hang together."""
    corners = np.zeros(mean.shape[0], bool)
    corners[faces[bad]] = True
    around = np.flatnonzero(_grown(corners, mean, 1))
    _, place = connected_components(mean[around][:, around], directed=False)
    of_vertex = np.full(len(corners), -1)
    of_vertex[around] = place
    of_face = of_vertex[faces[:, 0]]
    large = np.bincount(of_face[bad], minlength=place.max(initial=0) + 1) > _HOPELESS
    return np.asarray((of_face >= 0) & large[of_face])


def _restored(
    vertices: Array, before: Array, corners: NDArray[np.intp], mean: sp.csr_matrix
) -> Array:
    """The surface with those moved places as before that hold one of the corners."""
    moved = np.flatnonzero((vertices != before).any(axis=1))
    _, place = connected_components(mean[moved][:, moved], directed=False)
    back = moved[np.isin(place, place[np.isin(moved, corners)])]
    restored = vertices.copy()
    restored[back] = before[back]
    return restored


def _relaxed(
    vertices: Array, reference: Array, patch: NDArray[np.intp], stubborn: Mask, mean: sp.csr_matrix
) -> Array:
    """The surface with a patch' offsets smoothed, and its stubborn vertices flattened."""
    offset = vertices - reference
    rows = mean[patch]
    for _ in range(_SWEEPS):
        offset[patch] = rows @ offset
    relaxed = reference + offset
    flat = patch[stubborn]
    relaxed[flat] = vertices[flat] + _FLATTENING * (mean[flat] @ vertices - vertices[flat])
    return relaxed


def _grown(mask: Mask, mean: sp.csr_matrix, rings: int) -> Mask:
    for _ in range(rings):
        mask = mask | (mean @ mask.astype(np.float64) > 0.0)
    return mask


@lru_cache(maxsize=2)
def _neighbour_mean(model: BodyModel) -> sp.csr_matrix:
    """(P, P): takes values to the means of their neighbours'."""
    linked = model.adjacency
    return (sp.diags(1.0 / np.asarray(linked.sum(axis=1)).ravel()) @ linked).tocsr()
