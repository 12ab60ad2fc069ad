"""Parts of a fitted surface that lie inside another one: a limb that the fit did not find."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals

Array = NDArray[np.float64]

_DEEP_M = 0.004
_EVERY = 3
"""Every so many vertices of a group are looked at."""
_AROUND = ("pelvis", "abdomen", "chest", "neck", "head", "thigh_left", "thigh_right")


def shares_inside(
    model: BodyModel, vertices: Array, groups: Sequence[Sequence[str]]
) -> list[float]:
    """Shares of groups of parts that lie 4 mm or more below the skin of trunk, head and thighs.

    Args:
        vertices: (P, 3), metres, before crossings are mended.
    """
    around = model.of_parts(_AROUND)
    skin, normals = vertices[around], vertex_normals(vertices, model.faces)[around]
    tree = cKDTree(skin, balanced_tree=False)
    shares = []
    for parts in groups:
        places = vertices[model.of_parts(parts)][::_EVERY]
        nearest = tree.query(places)[1]
        depth = -np.einsum("ij,ij->i", places - skin[nearest], normals[nearest])
        shares.append(float(np.mean(depth > _DEEP_M)))
    return shares
