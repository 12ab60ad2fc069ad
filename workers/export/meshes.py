"""Meshes and clouds as files: PLY, OBJ and GLB."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from workers.measure.body import Measurement
from workers.scape.deformation import Faces, vertex_normals

Array = NDArray[np.float64]

_Y_UP_FROM_Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
_SKIN_COLOR = (0.80, 0.68, 0.60, 1.0)


def ply_mesh(vertices: Array, faces: Faces) -> bytes:
    """Binary PLY, world frame, metres."""
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    corners["count"], corners["vertices"] = 3, faces
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres, z up\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices.astype("<f4").tobytes() + corners.tobytes()


def ply_cloud(points: Array, normals: Array) -> bytes:
    """Binary PLY of oriented points, world frame, metres."""
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres, z up\n"
        f"element vertex {len(points)}\n{names}end_header\n"
    )
    return header.encode() + np.concatenate([points, normals], axis=1).astype("<f4").tobytes()


def obj_mesh(vertices: Array, faces: Faces) -> bytes:
    """Wavefront OBJ with normals, world frame, metres."""
    out = io.StringIO()
    out.write("# metres, z up\n")
    normals = vertex_normals(vertices, faces)
    out.write(("v %.5f %.5f %.5f\n" * len(vertices)) % tuple(vertices.ravel()))
    out.write(("vn %.4f %.4f %.4f\n" * len(normals)) % tuple(normals.ravel()))
    corners = np.repeat(faces.ravel() + 1, 2)
    out.write(("f %d//%d %d//%d %d//%d\n" * len(faces)) % tuple(corners))
    return out.getvalue().encode()


def glb_mesh(vertices: Array, faces: Faces, measurements: Sequence[Measurement]) -> bytes:
    """glTF binary, metres, y up: the body, and each measurement's line under its name."""
    material = trimesh.visual.material.PBRMaterial(
        name="skin", baseColorFactor=_SKIN_COLOR, metallicFactor=0.0, roughnessFactor=0.8
    )
    body = trimesh.Trimesh(
        vertices, faces, vertex_normals=vertex_normals(vertices, faces), process=False
    )
    body.visual = trimesh.visual.TextureVisuals(material=material)
    scene = trimesh.Scene()
    scene.add_geometry(body, node_name="body", geom_name="body")
    for row in measurements:
        points = np.concatenate([row.path, row.path[:1]]) if row.closed else row.path
        line = trimesh.load_path(points)
        scene.add_geometry(line, node_name=row.name, geom_name=row.name)
    scene.apply_transform(_Y_UP_FROM_Z_UP)
    exported: bytes = scene.export(file_type="glb", include_normals=True)
    return exported
