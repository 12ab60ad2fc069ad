"""glTF binaries: the measured body with its lines, and an avatar that a program can pose.

glTF is y up and metric; the world is z up, so (x, y, z) becomes (x, z, -y).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pygltflib as gltf
from numpy.typing import NDArray

from workers.measure.body import Measurement
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import Faces, vertex_normals
from workers.scape.model.skeleton import joint_positions

Array = NDArray[np.float64]

_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SKIN_COLOR = [0.80, 0.68, 0.60, 1.0]
_LINE_COLOR = [0.72, 0.08, 0.10, 1.0]
_INFLUENCES = 4
"""Joints per vertex; every glTF reader takes four."""


def mesh_glb(
    vertices: Array,
    faces: Faces,
    measurements: Sequence[Measurement],
    about: Mapping[str, Any] | None = None,
) -> bytes:
    """The body, and each measurement's line under its name.

    The default scene "body" shows the surface alone; the scene "measurements" has the lines too.
    A line's value and standard are extras of its node; `about` are extras of the file.
    """
    file = _File(about)
    file.scene("body", [file.node(name="body", mesh=file.body(vertices, faces))])
    lines = []
    material = file.material("line", _LINE_COLOR)
    for row in measurements:
        path = np.concatenate([row.path, row.path[:1]]) if row.closed else row.path
        # Pairs of points, since not every reader knows strips and loops.
        pairs = np.repeat(path, 2, axis=0)[1:-1]
        primitive = gltf.Primitive(
            attributes=gltf.Attributes(POSITION=file.positions(pairs)),
            mode=gltf.LINES,
            material=material,
        )
        extras = {"value_m": round(row.value_m, 5), "standard": row.standard}
        mesh = file.mesh(row.name, primitive)
        lines.append(file.node(name=row.name, mesh=mesh, extras=extras))
    file.scene("measurements", [0, *lines])
    return file.content()


def avatar_glb(
    model: BodyModel, vertices: Array, state: BodyState, about: Mapping[str, Any] | None = None
) -> bytes:
    """Body with a skeleton, whose rest pose is the scanned one.

    A joint's rotation is that of result.json's pose, so rotations of identity stand the body in the
    model's neutral pose. `about` are extras of the file.
    """
    file = _File(about)
    joints = joint_positions(model, vertices, state.rotations)
    skin = file.add_skin(model, joints, state)
    attributes = gltf.Attributes()
    attributes.JOINTS_0, attributes.WEIGHTS_0 = file.influences(model)
    mesh = file.body(vertices, model.faces, attributes)
    body = file.node(name="body", mesh=mesh, skin=0)
    file.scene("avatar", [skin, body])
    return file.content()


class _Document(gltf.GLTF2):  # type: ignore[misc]
    """A document that is written without a copy of each of its values: in half of the time."""

    def to_json(self, **options: Any) -> str:
        """All fields that are set, with `json.dumps`' options."""
        return json.dumps(_set_fields(self), **options)


def _set_fields(value: Any) -> Any:
    if isinstance(value, list):
        return [_set_fields(item) for item in value]
    fields = getattr(value, "__dict__", None)
    if fields is None:
        return value
    return {
        name: found
        for name, field in fields.items()
        if field is not None and name[0] != "_" and (found := _set_fields(field)) not in ([], {})
    }


class _File:
    """Builder of a glTF file: arrays go into one buffer, each with its accessor."""

    def __init__(self, about: Mapping[str, Any] | None = None) -> None:
        asset = gltf.Asset(version="2.0", generator="body-booth", extras=dict(about or {}))
        self._gltf = _Document(asset=asset, scene=0)
        self._blob = bytearray()

    def content(self) -> bytes:
        """The whole file as GLB."""
        self._gltf.buffers = [gltf.Buffer(byteLength=len(self._blob))]
        self._gltf.set_binary_blob(bytes(self._blob))
        return b"".join(self._gltf.save_to_bytes())

    def scene(self, name: str, roots: list[int]) -> None:
        self._gltf.scenes.append(gltf.Scene(name=name, nodes=roots))

    def node(self, **fields: object) -> int:
        return _appended(self._gltf.nodes, gltf.Node(**fields))

    def mesh(self, name: str, primitive: gltf.Primitive) -> int:
        return _appended(self._gltf.meshes, gltf.Mesh(name=name, primitives=[primitive]))

    def material(self, name: str, color: list[float]) -> int:
        surface = gltf.PbrMetallicRoughness(
            baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.8
        )
        return _appended(
            self._gltf.materials,
            gltf.Material(
                name=name, pbrMetallicRoughness=surface, alphaMode=None, alphaCutoff=None
            ),
        )

    def body(self, vertices: Array, faces: Faces, attributes: gltf.Attributes | None = None) -> int:
        """A mesh of a closed surface in the world frame."""
        attributes = attributes or gltf.Attributes()
        attributes.POSITION = self.positions(vertices)
        normals = vertex_normals(vertices, faces) @ _Y_UP_FROM_Z_UP.T
        attributes.NORMAL = self._array(normals.astype(np.float32), gltf.VEC3, gltf.ARRAY_BUFFER)
        corners = faces.ravel().astype(np.uint32 if len(vertices) >= 0xFFFF else np.uint16)
        indices = self._array(corners, gltf.SCALAR, gltf.ELEMENT_ARRAY_BUFFER)
        material = self.material("skin", _SKIN_COLOR)
        primitive = gltf.Primitive(attributes=attributes, indices=indices, material=material)
        return self.mesh("body", primitive)

    def positions(self, points: Array) -> int:
        """Accessor of points in the z-up world."""
        found = (points @ _Y_UP_FROM_Z_UP.T).astype(np.float32)
        accessor = self._array(found, gltf.VEC3, gltf.ARRAY_BUFFER)
        self._gltf.accessors[accessor].min = found.min(axis=0).tolist()
        self._gltf.accessors[accessor].max = found.max(axis=0).tolist()
        return accessor

    def influences(self, model: BodyModel) -> tuple[int, int]:
        """Accessors of each vertex's strongest joints and of their weights, which sum to 1."""
        strongest, weights = _strongest(model)
        return (
            self._array(strongest, gltf.VEC4, gltf.ARRAY_BUFFER),
            self._array(weights, gltf.VEC4, gltf.ARRAY_BUFFER),
        )

    def add_skin(self, model: BodyModel, joints: Array, state: BodyState) -> int:
        """Add the skeleton in its rest pose; returns the node of the root joint."""
        turn = _Y_UP_FROM_Z_UP
        places = joints @ turn.T
        frames = turn @ state.rotations @ turn.T
        twists = model.relative_twists(state.rotations) @ turn.T
        inverse: Array = np.tile(np.eye(4), (len(joints), 1, 1))
        inverse[:, :3, :3] = np.swapaxes(frames, 1, 2)
        inverse[:, :3, 3] = -np.einsum("pji,pj->pi", frames, places)
        nodes = []
        for part, parent in enumerate(model.part_parents):
            place = places[part]
            if parent >= 0:
                place = frames[parent].T @ (place - places[parent])
            nodes.append(
                self.node(
                    name=model.part_names[part],
                    translation=place.tolist(),
                    rotation=_quaternion(twists[part]).tolist(),
                )
            )
            if parent >= 0:
                self._gltf.nodes[nodes[parent]].children.append(nodes[part])
        matrices = np.swapaxes(inverse, 1, 2).reshape(-1, 16).astype(np.float32)
        skin = gltf.Skin(
            name="skeleton",
            joints=nodes,
            skeleton=nodes[0],
            inverseBindMatrices=self._array(matrices, gltf.MAT4),
        )
        self._gltf.skins.append(skin)
        return nodes[0]

    def _array(self, array: NDArray[np.generic], kind: str, target: int | None = None) -> int:
        data = np.ascontiguousarray(array).tobytes()
        self._blob += bytes(-len(self._blob) % 4)
        view = gltf.BufferView(
            buffer=0, byteOffset=len(self._blob), byteLength=len(data), target=target
        )
        self._blob += data
        accessor = gltf.Accessor(
            bufferView=_appended(self._gltf.bufferViews, view),
            componentType=_COMPONENTS[array.dtype.name],
            count=len(array),
            type=kind,
        )
        return _appended(self._gltf.accessors, accessor)


@lru_cache(maxsize=2)
def _strongest(model: BodyModel) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The joints (P, 4) that each vertex follows most, and their weights; alike for every body."""
    strongest = np.argsort(-model.vertex_weights, axis=1, kind="stable")[:, :_INFLUENCES]
    kept = np.take_along_axis(model.vertex_weights, strongest, axis=1)
    kept = (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(kept > 0.0, strongest, 0).astype(np.uint8), kept


_COMPONENTS = {
    "float32": gltf.FLOAT,
    "uint8": gltf.UNSIGNED_BYTE,
    "uint16": gltf.UNSIGNED_SHORT,
    "uint32": gltf.UNSIGNED_INT,
}


def _appended(items: list[object], item: object) -> int:
    items.append(item)
    return len(items) - 1


def _quaternion(twist: Array) -> Array:
    """Unit quaternion (x, y, z, w) of a rotation vector."""
    angle = float(np.linalg.norm(twist))
    half = 0.5 * angle
    # sin(a/2)/a, finite at 0.
    return np.array([*(0.5 * np.sinc(half / np.pi) * twist), np.cos(half)])
