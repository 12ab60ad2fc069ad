"""Hair on bodies in the model's topology, as sensors see it that it gives readings to."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from station.simulation.scene import Mesh, sphere
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals

Array = NDArray[np.float64]
Hair = Literal["bun", "beard", "thick", "ponytail"]

VERDICTS: dict[Hair, str] = {"bun": "ok", "beard": "ok", "thick": "ok", "ponytail": "rescan"}
"""Verdicts as they should be: a second scan helps where hair can be taken off the neck."""
THICK_M = 0.02
_BACK = np.array([0.0, 1.0, 0.0])


def with_hair(model: BodyModel, body: Mesh, kind: Hair) -> Mesh:
    """A body that faces -y, with hair."""
    vertices = body.vertices
    head = vertices[model.of_parts(("head",))]
    low, high = head.min(axis=0), head.max(axis=0)
    back_of_head = np.array([0.5 * (low[0] + high[0]), high[1], high[2] - 0.10])
    if kind == "thick":
        return Mesh(
            vertices + _scalp(model, vertices)[:, None] * THICK_M * _outwards(body), body.faces
        )
    if kind == "bun":
        return joined([body, sphere(back_of_head + 0.02 * _BACK, 0.045)])
    if kind == "beard":
        chin = vertices[model.landmarks["chin"]]
        return joined([body, *(sphere(chin - (0.0, 0.0, down), 0.04) for down in (0.02, 0.06))])
    nape = vertices[model.landmarks["cervicale"]]
    end = nape + np.array([0.0, 0.06, -0.15])
    shares = np.linspace(0.0, 1.0, 12)[:, None]
    return joined(
        [body, *(sphere(at, 0.03) for at in back_of_head + shares * (end - back_of_head))]
    )


def _scalp(model: BodyModel, vertices: Array) -> Array:
    """Share (P,) of the hair's thickness: all of it on top and behind, none on face and neck."""
    head = model.of_parts(("head",))
    low, high = vertices[head].min(axis=0), vertices[head].max(axis=0)
    level = (vertices[:, 2] - low[2]) / (high[2] - low[2])
    ahead = (high[1] - vertices[:, 1]) / (high[1] - low[1])
    behind = np.clip((0.65 - ahead) / 0.15, 0.0, 1.0) * np.clip((level - 0.25) / 0.2, 0.0, 1.0)
    return np.where(head, np.maximum(behind, np.clip((level - 0.72) / 0.1, 0.0, 1.0)), 0.0)


def _outwards(body: Mesh) -> Array:
    return vertex_normals(body.vertices, body.faces)


def joined(meshes: list[Mesh]) -> Mesh:
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.faces + first for mesh, first in zip(meshes, before, strict=True)]
        ).astype(np.int32),
    )
