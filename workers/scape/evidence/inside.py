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
_AROUND = ("pelvis", "abdomen", "chest", "neck", "head", "thigh_left", "thigh_right")


def share_inside(model: BodyModel, vertices: Array, parts: Sequence[str]) -> float:
    """Share of some parts' vertices that lie 4 mm or more below the skin of trunk, head and thighs.

    Args:
        vertices: (P, 3), metres, before crossings are mended.
    """
    names = np.array(model.part_names)[model.part_of_vertex]
    around = np.isin(names, _AROUND)
    skin, normals = vertices[around], vertex_normals(vertices, model.faces)[around]
    places = vertices[np.isin(names, parts)]
    nearest = cKDTree(skin).query(places)[1]
    depth = -np.einsum("ij,ij->i", places - skin[nearest], normals[nearest])
    return float(np.mean(depth > _DEEP_M))
