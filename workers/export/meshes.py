"""Meshes and clouds as PLY and OBJ: the world frame, metres, z up."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces, vertex_normals

Array = NDArray[np.float64]


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


def obj_mesh(vertices: Array, model: BodyModel) -> bytes:
    """Wavefront OBJ with normals, world frame, metres.

    Without texture coordinates: common readers split the surface along their seams, and it would be
    neither closed nor in the template's topology any more.
    """
    normals = vertex_normals(vertices, model.faces)
    lines = [
        "# metres, z up\n",
        ("v %.6f %.6f %.6f\n" * len(vertices)) % tuple(vertices.ravel()),
        ("vn %.4f %.4f %.4f\n" * len(normals)) % tuple(normals.ravel()),
        _obj_faces(model),
    ]
    return "".join(lines).encode()


@lru_cache(maxsize=2)
def _obj_faces(model: BodyModel) -> str:
    """The faces' lines, which are the same for every body."""
    corners = np.repeat(model.faces.ravel() + 1, 2)
    return ("f %d//%d %d//%d %d//%d\n" * len(model.faces)) % tuple(corners)
