"""PLY files as scanners write them, and torn ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from station.archive.surfaces import read_mesh
from station.core.errors import FormatError
from workers.cloud.ply import read_points, read_triangles

_HEAD = (
    "ply\nformat ascii 1.0\ncomment of a scanner\nelement vertex 3\nproperty float x\n"
    "property float y\nproperty double z\nproperty uchar red\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n"
)
_BODY = "0 0 0 9\n1 0 0 9\n0 1.5 0 9\n3 0 1 2\n"


@pytest.mark.parametrize("text", [True, False])
def test_what_open3d_writes_is_read(tmp_path: Path, text: bool) -> None:
    path = tmp_path / "mesh.ply"
    mesh = o3d.geometry.TriangleMesh.create_sphere(0.3)
    mesh.compute_vertex_normals()
    o3d.io.write_triangle_mesh(str(path), mesh, write_ascii=text)
    vertices, faces = read_triangles(path)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(faces, mesh.triangles)
    points, normals = read_points(path)
    assert normals is not None
    np.testing.assert_allclose(points, mesh.vertices, atol=1e-5)
    np.testing.assert_allclose(normals, mesh.vertex_normals, atol=1e-5)


def test_other_values_of_a_vertex_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_text(_HEAD + _BODY)
    vertices, faces = read_triangles(path)
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1.5, 0]]
    assert faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("faces", [0, 1])
def test_of_a_torn_binary_one_is_told_how_much_is_missing(tmp_path: Path, faces: int) -> None:
    path = tmp_path / "mesh.ply"
    mesh = o3d.geometry.TriangleMesh.create_sphere(0.3)
    o3d.io.write_triangle_mesh(str(path), mesh)
    whole = path.read_bytes()
    path.write_bytes(whole[: -5 if faces else len(whole) // 4])
    with pytest.raises(
        ValueError, match=r"it is torn: \d+ bytes of values were promised, \d+ came"
    ):
        (read_triangles if faces else read_points)(path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("vertex 3", "vertex 4000000000"),
        ("face 1", "face 99999999999999999999"),
        ("face 1", "face 2"),
        ("property float y", "property"),
        ("property float y", "property float x"),
        ("3 0 1 2", "3 0 1 7"),
        ("3 0 1 2", "4 0 1 2"),
        ("1.5 0 9", "1.5 0"),
        ("1.5", "x"),
        ("end_header\n", ""),
    ],
)
def test_a_torn_one_is_refused(tmp_path: Path, old: str, new: str) -> None:
    """Open3D's reader ended the process for some of these, and made up coordinates for others."""
    path = tmp_path / "mesh.ply"
    path.write_text((_HEAD + _BODY).replace(old, new))
    with pytest.raises(ValueError, match=r"."):
        read_triangles(path)
    with pytest.raises(FormatError, match="not a mesh"):
        read_mesh(path)


def test_a_file_without_a_head_is_no_ply_file(tmp_path: Path) -> None:
    """A file that began with the last line was called empty."""
    path = tmp_path / "mesh.ply"
    path.write_text("end_header\n1 2 3\n")
    with pytest.raises(ValueError, match="it is not a PLY file"):
        read_points(path)
    path.write_text("")
    with pytest.raises(ValueError, match="the file is empty"):
        read_points(path)
    path.write_text(_HEAD.replace("ply\n", "ply\ncomment end_header\n", 1) + _BODY)
    assert len(read_points(path)[0]) == 3
