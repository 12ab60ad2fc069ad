"""Reading a bare cloud: the same points each time, and the way back to the scanner's frame."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from station.core.errors import InputError
from workers.cloud import bare
from workers.cloud.bare import read_cloud


def _written(path: Path, points: np.ndarray) -> Path:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    o3d.io.write_point_cloud(str(path), cloud)
    return path


def test_a_cloud_goes_back_to_where_it_was(tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform((1.0, 5.0, -3.0), (2.0, 6.0, -1.0), (2000, 3))
    cloud = read_cloud(_written(tmp_path / "a.ply", points), "z")
    assert np.allclose(cloud.points + cloud.origin_m, points, atol=1e-6)
    assert cloud.points[:, 2].min() == 0.0
    turned = read_cloud(_written(tmp_path / "b.ply", points[:, [0, 2, 1]] * (1, 1, -1)), "y")
    assert np.allclose(turned.points + turned.origin_m, points, atol=1e-6)


def test_a_large_cloud_is_thinned_the_same_way_each_time(tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform(0.0, 1.0, (260_000, 3))
    path = _written(tmp_path / "large.ply", points)
    first, again = read_cloud(path, "z"), read_cloud(path, "z")
    assert len(first) == bare._MOST_POINTS
    assert np.array_equal(first.points, again.points)


@pytest.mark.parametrize(("low_m", "floor_m"), [(0.011, 0.0), (0.4, 0.4), (-0.9, -0.9)])
def test_soles_that_no_camera_saw_are_not_the_floor(
    tmp_path: Path, low_m: float, floor_m: float
) -> None:
    """Our own cloud.ply begins a centimetre above the floor it stands on."""
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.0), (0.3, 0.2, 1.7), (2000, 3))
    points[:, 2] += low_m - points[:, 2].min()
    cloud = read_cloud(_written(tmp_path / "cloud.ply", points), "z")
    assert cloud.origin_m[2] == pytest.approx(floor_m, abs=1e-6)


@pytest.mark.parametrize(
    ("count", "depth_m", "words"), [(3, 0.3, "a body needs"), (3000, 0.0, "is flat")]
)
def test_what_can_be_no_body_is_refused(
    tmp_path: Path, count: int, depth_m: float, words: str
) -> None:
    points = np.random.default_rng(0).uniform(0.0, (0.5, depth_m, 1.7), (count, 3))
    path = tmp_path / "odd.ply"
    o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    with pytest.raises(InputError, match=words):
        read_cloud(path, "z")
