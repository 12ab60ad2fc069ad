"""PCD files as scanners write them, and torn ones."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from station.core.errors import InputError
from workers.cloud.cloud_file import read_cloud
from workers.cloud.pcd import check_pcd

_FIELDS = "FIELDS x y z label\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 2\n"


def _head(kind: str, points: int = 3, fields: str = _FIELDS) -> str:
    return (
        f"# .PCD v.7\nVERSION .7\n{fields}WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {points}\nDATA {kind}\n"
    )


@pytest.mark.parametrize(("text", "packed"), [(True, False), (False, False), (False, True)])
def test_what_open3d_writes_is_read_and_a_torn_one_is_refused(
    tmp_path: Path, text: bool, packed: bool
) -> None:
    """Open3D gives the points that a torn text lacks, at 0, 0, 0 or wherever memory says."""
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.0), (0.3, 0.2, 1.7), (3000, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    path = tmp_path / "a.pcd"
    o3d.io.write_point_cloud(path, cloud, write_ascii=text, compressed=packed)
    assert len(read_cloud(path, "z")) == 3000
    whole = path.read_bytes()
    for share in (0.6, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=r"a\.pcd cannot be read \(it is torn"):
            read_cloud(path, "z")


@pytest.mark.parametrize("body", ["0 0 0 7 7\n1 nan 0 7 7\n\n1 1e-3 -2 7 7\n", "1 2 3 4 5\n" * 4])
def test_other_values_and_empty_lines_are_passed_over(tmp_path: Path, body: str) -> None:
    path = tmp_path / "a.pcd"
    path.write_text(_head("ascii") + body)
    check_pcd(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_head("ascii"), "3 points were promised, 0 came"),
        (_head("ascii") + "1 2 3 4 5\n" * 2, "3 points were promised, 2 came"),
        (_head("ascii") + "1 2 3 4\n" * 3, "do not have the 5 values"),
        (_head("ascii") + "1 2 3 4 5\n" * 2 + "1 2\n", "no cloud: the number of columns"),
        (_head("ascii") + "a b c d e\n" * 3, "could not convert"),
        (_head("ascii", 10**9) + "1 2 3 4 5\n" * 3, "1000000000 points were promised, 3 came"),
        (_head("binary", 10**9) + 42 * "x", "14000000000 bytes of points were promised, 42 came"),
        (_head("binary_compressed"), "no packed points follow"),
        (_head("binary_compressed", 9) + struct.pack("<II", 100, 999).decode("latin1"), "999 byt"),
        (_head("binary_compressed", 900) + struct.pack("<II", 9, 12600).decode("latin1"), "into 9"),
        (_head("base64"), "its data are 'base64'"),
        (_head("ascii", -5), "that cannot be"),
        (_head("ascii", fields=_FIELDS.replace("1 1 1 2", "1 1 1 -2")), "that cannot be"),
        (_head("ascii", fields=_FIELDS.replace("4 4 4 1", "3 4 4 1")), "unknown SIZE and TYPE"),
        (_head("binary", fields=_FIELDS.replace("4 4 4 1", "4 8 4 1")) + 99 * "x", "of 8 bytes"),
        (_head("ascii", fields=_FIELDS.replace("4 4 4 1", "4 4 4")), "lacks one of SIZE"),
        (_head("ascii", fields=_FIELDS.replace("x y z", "x x z")), "have no x, y, z"),
        ("VERSION .7\n", "not a PCD file"),
        ("".join(f"{k} 1\n" for k in range(100)), "not a PCD file"),
    ],
)
def test_a_head_that_the_data_do_not_bear_out_is_refused(
    tmp_path: Path, content: str, words: str
) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(content.encode("latin1"))
    with pytest.raises(ValueError, match=words):
        check_pcd(path)


def test_text_of_double_precision_is_read(tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.0), (0.3, 0.2, 1.7), (3000, 3))
    rows = "".join(f"{x:.17g} {y:.17g} {z:.17g} 7 7\n" for x, y, z in points)
    path = tmp_path / "a.pcd"
    path.write_text(_head("ascii", 3000, _FIELDS.replace("4 4 4 1", "8 8 8 1")) + rows)
    cloud = read_cloud(path, "z")
    assert np.allclose(cloud.points + cloud.origin_m, points)


def test_other_kinds_of_files_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.pts"
    path.write_text("5000\n" + "1 2 3\n" * 50)
    with pytest.raises(InputError, match=r"'\.pts' are not read\); give a point cloud, \.ply or"):
        read_cloud(path, "z")
