"""Normals of files: kept where they are the skin's, and out of the body whatever wrote them."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from workers.cloud.cloud_file import read_cloud
from workers.cloud.observed import PointCloud

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def _skin(count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Points of a body's skin, and its normals there."""
    body = np.load(BODIES / "ann.npz")
    corners = body["vertices"].astype(float)[body["faces"]]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    rng = np.random.default_rng(5)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    return np.einsum("nk,nki->ni", weights, corners[chosen]), (across / area[:, None])[chosen]


def _read(path: Path, points: np.ndarray, normals: np.ndarray | None = None) -> PointCloud:
    """A cloud that was written as numbers of 8 bytes."""
    columns = points if normals is None else np.column_stack([points, normals])
    names = ("x", "y", "z", "nx", "ny", "nz")[: columns.shape[1]]
    head = "".join(f"property double {name}\n" for name in names)
    path.write_bytes(
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{head}end_header\n"
        "".encode()
        + columns.astype("<f8").tobytes()
    )
    return read_cloud(path, "z")


def _estimated(points: np.ndarray) -> o3d.geometry.PointCloud:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals()
    return cloud


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_normals_of_the_skin_are_kept(tmp_path: Path, sign: float) -> None:
    points, normals = _skin()
    found = _read(tmp_path / "a.ply", points, sign * normals).normals
    assert np.array_equal(found, normals)


@pytest.mark.parametrize("kind", ["as they came", "towards one camera", "by chance"])
def test_normals_that_no_program_oriented_are(tmp_path: Path, kind: str) -> None:
    """Half of them were inside out: "the cloud shows only 67 % of the person's left side"."""
    points, normals = _skin()
    cloud = _estimated(points)
    if kind == "towards one camera":
        cloud.orient_normals_towards_camera_location(np.array([0.0, -3.0, 1.0]))
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (len(points), 1))
    written = signs * normals if kind == "by chance" else np.asarray(cloud.normals)
    found = _read(tmp_path / "a.ply", points, written).normals
    assert np.allclose(np.abs(np.einsum("ni,ni->n", found, written)), 1.0)
    assert np.mean(np.einsum("ni,ni->n", found, normals) > 0.0) > 0.95


@pytest.mark.parametrize("kind", ["not turned", "random", "up"])
def test_normals_of_something_else_are_not_used(tmp_path: Path, kind: str) -> None:
    """Random ones made a waist 9 mm larger, with "ok"; some programs turn points alone."""
    points, normals = _skin()
    written = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    if kind == "random":
        written = np.random.default_rng(1).standard_normal(points.shape)
        written /= np.linalg.norm(written, axis=1, keepdims=True)
    elif kind == "not turned":
        written = normals[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    found = _read(tmp_path / "a.ply", points, written).normals
    assert np.array_equal(found, _read(tmp_path / "b.ply", points).normals)


def test_a_mesh_with_many_vertices_in_its_hands_is_not_inside_out(tmp_path: Path) -> None:
    """The middle of its vertices is not the body's; all of it was turned inside out."""
    body = np.load(BODIES / "ann.npz")
    vertices = body["vertices"].astype(float)
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(body["faces"])
    )
    normals = np.asarray(surface.compute_vertex_normals().vertex_normals)
    found = _read(tmp_path / "a.ply", vertices).normals
    assert np.mean(np.einsum("ni,ni->n", found, normals) > 0.0) > 0.9


def test_a_cloud_in_a_surveyors_coordinates_loses_nothing(tmp_path: Path) -> None:
    """Estimated normals were off, 2,000 km from the origin: a waist lost 2 mm."""
    points = _skin()[0]
    far = np.array([4.5e5, 2e6, 300.0])
    near, cloud = (_read(tmp_path / "a.ply", points + shift) for shift in (0.0 * far, far))
    assert np.mean(np.einsum("ni,ni->n", cloud.normals, near.normals) > 0.999) > 0.99
    assert np.allclose(cloud.points + cloud.origin_m, points + far, atol=1e-8)
