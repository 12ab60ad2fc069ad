"""Meshes and clouds as PLY and OBJ: world frame, metres, z up."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import Faces, vertex_normals

Array = NDArray[np.float64]

_PLY_START = "ply\nformat binary_little_endian 1.0\ncomment metres, z up\n"


def ply_mesh(vertices: Array, faces: Faces, comments: Sequence[str] = ()) -> bytes:
    """Binary PLY of a mesh; comments are lines of ASCII."""
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    corners["count"], corners["vertices"] = 3, faces
    header = (
        f"{_PLY_START}{_ply_comments(comments)}"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices.astype("<f4").tobytes() + corners.tobytes()


def _ply_comments(lines: Sequence[str]) -> str:
    return "".join(f"comment {line}\n" for line in lines)


def ply_cloud(points: Array, normals: Array, comments: Sequence[str] = ()) -> bytes:
    """Binary PLY of oriented points; comments are lines of ASCII."""
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = (
        f"{_PLY_START}{_ply_comments(comments)}element vertex {len(points)}\n{names}end_header\n"
    )
    return header.encode() + np.concatenate([points, normals], axis=1).astype("<f4").tobytes()


def obj_mesh(vertices: Array, model: BodyModel, comments: Sequence[str] = ()) -> bytes:
    """Wavefront OBJ with normals; comments are lines of ASCII.

    It has no texture coordinates: common readers split the surface along texture seams, and it
    would no longer be closed nor in the template's topology.
    """
    normals = vertex_normals(vertices, model.faces)
    lines = [
        "# metres, z up\n",
        *(f"# {line}\n" for line in comments),
        ("v %.6f %.6f %.6f\n" * len(vertices)) % tuple(vertices.ravel()),
        ("vn %.4f %.4f %.4f\n" * len(normals)) % tuple(normals.ravel()),
        _obj_faces(model),
    ]
    return "".join(lines).encode()


@lru_cache(maxsize=2)
def _obj_faces(model: BodyModel) -> str:
    """Lines of the faces, which are the same for every body."""
    corners = np.repeat(model.faces.ravel() + 1, 2)
    return ("f %d//%d %d//%d %d//%d\n" * len(model.faces)) % tuple(corners)
