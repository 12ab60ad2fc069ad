"""glTF binaries: the measured body with its lines, and an avatar that a program can pose.

glTF is y up and metric; the world is z up, so (x, y, z) becomes (x, z, -y).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.measure.body import Measurement
from workers.scape.deformation import Faces, vertex_normals
from workers.scape.model import BodyModel, BodyState
from workers.scape.skeleton import joint_positions

Array = NDArray[np.float64]

_Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_SKIN_COLOR = [0.80, 0.68, 0.60, 1.0]
_LINE_COLOR = [0.72, 0.08, 0.10, 1.0]
_INFLUENCES = 4
"""Joints that move a vertex: as many as every glTF reader takes."""
_LINES = 1
_VERTEX_DATA, _INDEX_DATA = 34962, 34963
_COMPONENTS = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"


def mesh_glb(vertices: Array, faces: Faces, measurements: Sequence[Measurement]) -> bytes:
    """The body, and each measurement's line under its name.

    The default scene "body" shows the surface alone; the scene "measurements" has the lines too.
    A line's value and standard are extras of its node.
    """
    file = _File()
    file.scene("body", [file.node(name="body", mesh=file.body(vertices, faces))])
    lines = []
    material = file.material("line", _LINE_COLOR)
    for row in measurements:
        path = np.concatenate([row.path, row.path[:1]]) if row.closed else row.path
        # Pairs of points, since not every reader knows strips and loops.
        pairs = np.repeat(path, 2, axis=0)[1:-1]
        attributes = {"POSITION": file.positions(pairs)}
        primitive = {"attributes": attributes, "mode": _LINES, "material": material}
        extras = {"value_m": round(row.value_m, 5), "standard": row.standard}
        mesh = file.mesh(row.name, primitive)
        lines.append(file.node(name=row.name, mesh=mesh, extras=extras))
    file.scene("measurements", [0, *lines])
    return file.content()


def avatar_glb(model: BodyModel, vertices: Array, state: BodyState) -> bytes:
    """The body with a skeleton: it rests as it was scanned.

    A joint's rotation is that of result.json's pose, so rotations of identity stand the body in the
    model's neutral pose.
    """
    file = _File()
    joints = joint_positions(model, vertices, state.rotations)
    skin = file.add_skin(model, joints, state)
    strongest, weights = file.influences(model.vertex_weights)
    mesh = file.body(vertices, model.faces, {"JOINTS_0": strongest, "WEIGHTS_0": weights})
    body = file.node(name="body", mesh=mesh, skin=0)
    file.scene("avatar", [skin, body])
    return file.content()


class _File:
    """A glTF file as it grows: arrays go into one buffer, each with its accessor.

    Names of fields and numbers of kinds are those of Khronos' glTF 2.0 specification.
    """

    def __init__(self) -> None:
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._blob = bytearray()

    def content(self) -> bytes:
        """The whole file as GLB."""
        document = {
            "asset": {"version": "2.0", "generator": "body-booth"},
            "scene": 0,
            **self._lists,
            "buffers": [{"byteLength": len(self._blob)}],
        }
        text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
        chunks = _chunk(_JSON, text, b" ") + _chunk(_BINARY, bytes(self._blob), b"\0")
        return _MAGIC + _whole(2) + _whole(12 + len(chunks)) + chunks

    def _add(self, kind: str, **fields: Any) -> int:
        """Its index among those of its kind."""
        items = self._lists.setdefault(kind, [])
        items.append(fields)
        return len(items) - 1

    def scene(self, name: str, roots: list[int]) -> None:
        self._add("scenes", name=name, nodes=roots)

    def node(self, **fields: Any) -> int:
        return self._add("nodes", **fields)

    def mesh(self, name: str, primitive: dict[str, Any]) -> int:
        return self._add("meshes", name=name, primitives=[primitive])

    def material(self, name: str, color: list[float]) -> int:
        surface = {"baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": 0.8}
        return self._add("materials", name=name, pbrMetallicRoughness=surface)

    def body(self, vertices: Array, faces: Faces, others: Mapping[str, int] | None = None) -> int:
        """A mesh of a closed surface in the world frame; others are attributes that it also has."""
        normals = vertex_normals(vertices, faces) @ _Y_UP_FROM_Z_UP.T
        attributes = {
            "POSITION": self.positions(vertices),
            "NORMAL": self._array(normals.astype(np.float32), "VEC3", _VERTEX_DATA),
            **(others or {}),
        }
        corners = faces.ravel().astype(np.uint32 if len(vertices) >= 0xFFFF else np.uint16)
        indices = self._array(corners, "SCALAR", _INDEX_DATA)
        material = self.material("skin", _SKIN_COLOR)
        primitive = {"attributes": attributes, "indices": indices, "material": material}
        return self.mesh("body", primitive)

    def positions(self, points: Array) -> int:
        """Points of the z-up world."""
        found = (points @ _Y_UP_FROM_Z_UP.T).astype(np.float32)
        low, high = found.min(axis=0).tolist(), found.max(axis=0).tolist()
        return self._array(found, "VEC3", _VERTEX_DATA, min=low, max=high)

    def influences(self, weights: Array) -> tuple[int, int]:
        """Each vertex' strongest joints and their weights, which add up to 1."""
        strongest = np.argsort(-weights, axis=1, kind="stable")[:, :_INFLUENCES]
        kept = np.take_along_axis(weights, strongest, axis=1)
        kept = (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32)
        strongest = np.where(kept > 0.0, strongest, 0).astype(np.uint8)
        return (
            self._array(strongest, "VEC4", _VERTEX_DATA),
            self._array(kept, "VEC4", _VERTEX_DATA),
        )

    def add_skin(self, model: BodyModel, joints: Array, state: BodyState) -> int:
        """The skeleton as it rests; returns the root joint's node."""
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
                above = self._lists["nodes"][nodes[parent]]
                above.setdefault("children", []).append(nodes[part])
        matrices = np.swapaxes(inverse, 1, 2).reshape(-1, 16).astype(np.float32)
        self._add(
            "skins",
            name="skeleton",
            joints=nodes,
            skeleton=nodes[0],
            inverseBindMatrices=self._array(matrices, "MAT4"),
        )
        return nodes[0]

    def _array(
        self, array: NDArray[np.generic], kind: str, target: int | None = None, **fields: Any
    ) -> int:
        data = np.ascontiguousarray(array).tobytes()
        self._blob += bytes(-len(self._blob) % 4)
        view: dict[str, int] = {} if target is None else {"target": target}
        view |= {"buffer": 0, "byteOffset": len(self._blob), "byteLength": len(data)}
        self._blob += data
        return self._add(
            "accessors",
            bufferView=self._add("bufferViews", **view),
            componentType=_COMPONENTS[array.dtype.name],
            count=len(array),
            type=kind,
            **fields,
        )


def _chunk(kind: bytes, data: bytes, filler: bytes) -> bytes:
    """A chunk of a GLB file, filled up to whole words."""
    data += filler * (-len(data) % 4)
    return _whole(len(data)) + kind + data


def _whole(number: int) -> bytes:
    return number.to_bytes(4, "little")


def _quaternion(twist: Array) -> Array:
    """Unit quaternion (x, y, z, w) of a rotation vector."""
    angle = float(np.linalg.norm(twist))
    half = 0.5 * angle
    # sin(a/2)/a, finite at 0.
    return np.array([*(0.5 * np.sinc(half / np.pi) * twist), np.cos(half)])
