"""Arms that press into the body, parted from it by the depth of the contact.

An arm that lies on the trunk is fitted some millimetres into it, as flesh yields. Each vertex
below the skin of the other side moves out along that skin's normal, by half its depth, or by
all of it where only the other side was measured; the skin around follows with decreasing shares.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from workers.scape.evidence.correspondence import OrientedTree
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.crossings import Pairs, at_vertices, crossing_pairs

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ARM = ("upper_arm", "forearm", *HAND)
_ROUNDS = 12
_REACH = 6
"""Rings of vertices around crossing triangles in which skin below other skin is looked for."""
_DEEPEST_M = 0.035
"""Depth to which flesh yields."""
_FARTHEST_M = 0.050
"""Distance of a vertex to the one that faces it."""
_VAIN = 0.2
"""Share of a contact's crossing corners from which it counts as not parted."""
_GAP_M = 0.0005
"""Distance by which crossing skins are parted beyond their depth, times the round: the depth at a
vertex says little of triangles that cross beside it."""
_HOLDING_ROUNDS = 3
"""Rounds in which measured skin is held; where that is in vain, it is not."""
_MEASURED_YIELDS = 0.15
"""Mobility of measured skin after them; that of other skin is 1."""
_FOLLOWING = 0.8
"""Share of its neighbours' mean motion with which skin around a contact follows."""
_SWEEPS = 8


def parted(model: BodyModel, vertices: Array, measured: Mask, crossing: Pairs) -> Array:
    """Surface (P, 3) whose arms lie beside the body instead of in it, where that can be done.

    Args:
        vertices: (P, 3), metres.
        measured: (P,), vertices of triangles with readings on them.
        crossing: pairs (m, 2) of triangles that cross.
    """
    once = _pushed(model, vertices, measured, crossing, _HOLDING_ROUNDS)
    if once is vertices:
        return vertices  # nothing crosses
    of_arms = np.asarray(_arms(model)[model.faces[:, 0]] > 0)
    left = crossing_pairs(once, model.faces, of_arms)
    return _pushed(model, once, measured, left, 0)


def _pushed(model: BodyModel, vertices: Array, measured: Mask, pairs: Pairs, holding: int) -> Array:
    """Surface (P, 3) without the contacts that can be parted if measured skin (P,) is held for so
    many rounds."""
    yields = np.where(measured, 0.0, 1.0)
    arm, linked = _arms(model), neighbour_mean(model)
    first = crossing = _contacts(model, pairs)
    current = vertices
    for round_ in range(_ROUNDS):
        if not crossing.any():
            return current
        if round_ == holding:
            yields[measured] = _MEASURED_YIELDS
        around = np.flatnonzero(grown(crossing, linked, _REACH))
        found, facing, direction, depth = _facing(model, current, around, arm, crossing)
        share = yields[found] / np.maximum(yields[found] + yields[facing], _MEASURED_YIELDS)
        motion = np.zeros_like(current)
        motion[found] = (share * (depth + (round_ + 1) * _GAP_M))[:, None] * direction
        follows = np.setdiff1d(around[yields[around] > 0.0], found)
        for _ in range(_SWEEPS):
            motion[follows] = _FOLLOWING * (linked[follows] @ motion)
        current = current + motion
        moved: Mask = np.asarray(motion.any(axis=1))
        tested = at_vertices(moved, model.faces)
        crossing = _contacts(model, crossing_pairs(current, model.faces, tested))
    return _without_vain(vertices, current, first, crossing, linked)


def _contacts(model: BodyModel, pairs: Pairs) -> Mask:
    """Mask (P,) of the corners of crossing triangles (m, 2) of both arms or of one and the rest."""
    arm = _arms(model)
    one, other = (arm[model.faces[pairs[:, side], 0]] for side in (0, 1))
    corners = np.zeros(model.vertex_count, bool)
    corners[model.faces[pairs[one != other]]] = True
    return corners


def _without_vain(
    before: Array, after: Array, first: Mask, last: Mask, linked: sp.csr_matrix
) -> Array:
    """Surface after a motion, without the contacts that it did not part.

    Args:
        first, last: (P,), corners that crossed before and after it.
    """
    changed = np.flatnonzero((after != before).any(axis=1))
    _, place = connected_components(linked[changed][:, changed], directed=False)
    vain = np.bincount(place, last[changed]) > _VAIN * np.bincount(place, first[changed])
    kept = after.copy()
    kept[changed[vain[place]]] = before[changed[vain[place]]]
    return kept


def _facing(
    model: BodyModel,
    vertices: Array,
    around: NDArray[np.intp],
    arm: NDArray[np.intp],
    crossing: Mask,
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """Vertices (n,) that cross the other side's skin or lie below it, the vertices there that face
    them (n,), the normals of these (n, 3), and the depths (n,), 0 above the skin."""
    normals = vertex_normals(vertices, model.faces)
    pieces = []
    for number in np.unique(arm[around]):
        mine, others = around[arm[around] == number], around[arm[around] != number]
        if not len(others):
            continue
        tree = OrientedTree.build(vertices[others], -normals[others])
        facing = others[tree.nearest(vertices[mine], normals[mine])]
        offset = vertices[facing] - vertices[mine]
        depth = np.einsum("ni,ni->n", offset, normals[facing])
        opposite = np.einsum("ni,ni->n", normals[mine], normals[facing]) < 0.0
        near = (np.linalg.norm(offset, axis=1) < _FARTHEST_M) & (depth < _DEEPEST_M)
        met = opposite & near & ((depth > 0.0) | crossing[mine])
        pieces.append((mine[met], facing[met], normals[facing[met]], np.maximum(depth[met], 0.0)))
    found, facing, direction, depth = (np.concatenate(one) for one in zip(*pieces, strict=True))
    return found, facing, direction, depth


@lru_cache(maxsize=2)
def _arms(model: BodyModel) -> NDArray[np.intp]:
    """Number (P,) of the arm that each vertex belongs to: 1 or 2, or 0 for the rest of the body."""
    sides = ("left", "right")
    of_part = []
    for name in model.part_names:
        stem, _, side = name.rpartition("_")
        of_part.append(1 + sides.index(side) if stem in _ARM else 0)
    return np.array(of_part, np.intp)[model.part_of_vertex]


def grown(mask: Mask, mean: sp.csr_matrix, rings: int) -> Mask:
    """Mask (P,) with so many rings of neighbours added."""
    for _ in range(rings):
        mask = mask | (mean @ mask.astype(np.float64) > 0.0)
    return mask


@lru_cache(maxsize=2)
def neighbour_mean(model: BodyModel) -> sp.csr_matrix:
    """Matrix (P, P) that replaces each value by the mean of its neighbours' values."""
    linked = model.adjacency
    return (sp.diags(1.0 / np.asarray(linked.sum(axis=1)).ravel()) @ linked).tocsr()
