"""Meshes and clouds as PLY and OBJ: world frame, metres, z up."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numba
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
    ]
    return b"".join(
        [
            "".join(lines).encode(),
            _lines(b"v", vertices, 6),
            _lines(b"vn", normals, 4),
            _obj_faces(model),
        ]
    )


_LARGEST = 1e15
"""Numbers below it are exact as integers."""


def _lines(keyword: bytes, rows: Array, decimals: int) -> bytes:
    """A line of text for each row (n, 3): a keyword and three numbers.

    Raises:
        ValueError: a number is not finite, or has more digits than are written.
    """
    if not (np.abs(rows) * 10.0**decimals < _LARGEST).all():
        raise ValueError("a vertex is not finite, or kilometres away")
    letters = np.frombuffer(keyword, np.uint8)
    return bytes(_written(letters, rows, 10**decimals, decimals))


@numba.njit(cache=True, nogil=True)
def _written(keyword, rows, scale, decimals):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Text of rows (n, 3), which Python's own formatting takes six times as long for."""
    out = np.empty(len(rows) * (len(keyword) + 3 * (decimals + 22) + 1), np.uint8)
    digits = np.empty(20, np.uint8)
    at = 0
    for row in rows:
        for letter in keyword:
            out[at] = letter
            at += 1
        for value in row:
            out[at] = 32  # " "
            at += 1
            if value < 0.0:
                out[at] = 45  # "-"
                at += 1
            left = np.int64(np.rint(abs(value) * scale))
            count = 0
            while left > 0 or count <= decimals:
                digits[count] = 48 + left % 10  # "0"
                left //= 10
                count += 1
            for place in range(count - 1, -1, -1):
                out[at] = digits[place]
                at += 1
                if place == decimals:
                    out[at] = 46  # "."
                    at += 1
        out[at] = 10  # end of the line
        at += 1
    return out[:at]


@lru_cache(maxsize=2)
def _obj_faces(model: BodyModel) -> bytes:
    """Lines of the faces, which are the same for every body."""
    corners = np.repeat(model.faces.ravel() + 1, 2)
    return (("f %d//%d %d//%d %d//%d\n" * len(model.faces)) % tuple(corners)).encode()
