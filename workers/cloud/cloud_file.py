"""Point clouds and meshes from files, oriented and placed as the fit needs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from station.core.errors import InputError
from workers.cloud.bare import lowest_m, scatter_m
from workers.cloud.floor import UNITS_M, Z_UP, check_units, standing_on
from workers.cloud.observed import MIN_POINTS, POSSIBLE_HEIGHTS_M, PointCloud
from workers.cloud.outwards import outward_normals
from workers.cloud.pcd import check_pcd
from workers.cloud.ply import read_points, read_triangles

Array = NDArray[np.float64]
Faces = NDArray[np.int32]

_MAX_POINTS = 250_000
_FLAT_M = 0.005
"""Least standard deviation of a body's points across its thinnest direction."""
_SIGMA_M = 0.001
"""Standard deviation that is assumed for the points of a file."""
_UNSEEN_SOLES_M = 0.03
"""A cloud that begins this little above its z = 0 stands on it: cameras do not see soles."""
_MAX_EXTENT_M = 12.0
"""Size of a room: a cell of the search for the person's surroundings takes memory."""
_FAR_M = 100.0
"""Coordinates, as surveyors have, from which a cloud is brought nearer first: squares of a thousand
kilometres are known to 0.1 mm2, and the thickness of skin is not."""
_OFF_FLOOR_M = 0.05
"""Largest distance of a mesh's soles from the floor, which heights are measured from."""


def read_cloud(path: Path, up: str, unit: str = "m") -> PointCloud:
    """Read a cloud and move its middle to the mark and its lowest points, or its floor, to z = 0.

    A floor that was scanned too is taken away, and what stands apart on it. Single points below
    the soles are not taken for these. A cloud whose lowest points are slightly above z = 0, as
    where no camera saw the soles, keeps its heights. Points without a reading (NaN) are left out.
    `origin_m` of the cloud is the new origin in the file's frame, in metres, after `up`. The same
    file gives the same points.

    Args:
        up: the axis that points up, a key of `Z_UP`.
        unit: of the file, a key of `UNITS_M`.

    Raises:
        InputError: the file is missing, is not a cloud, has infinite values, or looks like
            another unit or axis than was said.
    """
    cloud, blank = _points_of(path)
    cloud.scale(UNITS_M[unit], np.zeros(3))
    cloud.rotate(Z_UP[up], np.zeros(3))
    check_units(np.asarray(cloud.points), unit, up)
    extent_m = float(np.ptp(np.asarray(cloud.points), axis=0).max())
    if not extent_m < _MAX_EXTENT_M:
        raise InputError(
            f"{path} has points {extent_m:.4g} m apart; cut the person out, or name its --unit"
        )
    _check_solid(np.asarray(cloud.points), path)
    far = np.median(np.asarray(cloud.points), axis=0)
    far[np.abs(far) < _FAR_M] = 0.0
    cloud.translate(-far)
    person = standing_on(np.asarray(cloud.points))
    if person is not None:
        cloud = cloud.select_by_index(np.flatnonzero(person[0]))
    points, normals = np.asarray(cloud.points), outward_normals(cloud)
    tree = cKDTree(points)
    middle = np.median(points, axis=0)
    if person is None:
        low_m = lowest_m(tree)
        middle[2] = 0.0 if 0.0 <= low_m < _UNSEEN_SOLES_M else low_m
    else:
        middle[2] = person[1]
    x, y, z = (float(value) for value in far + middle)
    return PointCloud(
        points=points - middle,
        normals=normals,
        sigma_m=np.full(len(points), _SIGMA_M),
        camera=np.zeros(len(points), np.int16),
        camera_names=("cloud",),
        origin_m=(x, y, z),
        scatter_m=scatter_m(tree),
        blank=blank,
    )


def _points_of(path: Path) -> tuple[o3d.geometry.PointCloud, int]:
    """Points of a file, thinned to what the fit can use, and how many have no reading."""
    if not path.is_file():
        raise InputError(f"{path} is not a file; give a point cloud, .ply or .pcd")
    cloud = _read(path)
    points = np.asarray(cloud.points)
    if not len(points):
        raise InputError(f"{path} holds no points; give a point cloud, .ply or .pcd")
    if broken := int(np.isinf(points).any(axis=1).sum()):
        raise InputError(
            f"{broken} of the {len(points)} points of {path} are infinite; remove these and try "
            "again"
        )
    # Clouds of a depth image's pixels are NaN where it has no reading.
    blank = np.isnan(points).any(axis=1)
    if blank.any():
        cloud = cloud.select_by_index(np.flatnonzero(~blank))
        points = np.asarray(cloud.points)
    if len(points) > _MAX_POINTS:
        kept = np.random.default_rng(len(points)).permutation(len(points))[:_MAX_POINTS]
        cloud = cloud.select_by_index(np.sort(kept))
    # The search for a point's neighbours takes as long as there are points where it lies.
    cloud = cloud.remove_duplicated_points()
    if len(cloud.points) < MIN_POINTS:
        raise InputError(
            f"{path} has {len(cloud.points)} different points; a body needs {MIN_POINTS}"
        )
    return cloud, int(blank.sum())


def _read(path: Path) -> o3d.geometry.PointCloud:
    """The cloud of a file as it stands there; an empty one where there is none."""
    try:
        if path.suffix.lower() == ".pcd":
            check_pcd(path)
            # Open3D's warnings would repeat the error that is raised.
            with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
                return o3d.io.read_point_cloud(path)
        # No other format: Open3D fills what a torn .pts lacks with whatever memory holds.
        if path.suffix.lower() != ".ply":
            raise ValueError(f"files that end in {path.suffix!a:.20} are not read")
        points, normals = read_points(path)
    except (OSError, ValueError) as cause:
        raise InputError(
            f"{path} cannot be read ({cause}); give a point cloud, .ply or .pcd"
        ) from None
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = o3d.utility.Vector3dVector(normals)
    return cloud


def _check_solid(points: Array, path: Path) -> None:
    if np.linalg.matrix_rank(points - points.mean(axis=0), _FLAT_M * np.sqrt(len(points))) < 3:
        raise InputError(f"{path} is flat; a body has a front and a back")


def read_template_mesh(path: Path, faces: Faces, up: str) -> Array:
    """Vertices (P, 3), z up, of a mesh file with the template's triangles (K, 3).

    Args:
        up: the axis that points up in the file, a key of `Z_UP`.

    Raises:
        InputError: the file is missing, is not a mesh, has values that are not finite or other
            triangles, or is not an adult in metres who stands on the floor.
    """
    if not path.is_file():
        raise InputError(f"{path} is not a file; give a result folder or a mesh")
    vertices, corners = _obj(path) if path.suffix.lower() == ".obj" else _ply(path)
    if not len(corners) or not np.isfinite(vertices).all():
        raise InputError(f"{path} holds no usable mesh; give a .ply or .obj of triangles")
    if not np.array_equal(corners, faces) or len(vertices) != faces.max() + 1:
        raise InputError(
            f"{path} has {len(vertices)} vertices and {len(corners)} triangles that are not the "
            f"template's {faces.max() + 1} and {len(faces)}; fit it first: "
            f"reconstruct fit --cloud {path} --up {up} --out result"
        )
    vertices = vertices @ Z_UP[up].T
    low_m, high_m = float(vertices[:, 2].min()), float(vertices[:, 2].max())
    if not POSSIBLE_HEIGHTS_M[0] < high_m - low_m < POSSIBLE_HEIGHTS_M[1]:
        raise InputError(
            f"{path} is {high_m - low_m:.4g} high with {up} up; metres were expected, or is "
            "another axis up? see --up"
        )
    if abs(low_m) > _OFF_FLOOR_M:
        raise InputError(f"{path} has its soles at {low_m:.3f} m; move them to the floor at 0")
    return vertices


def _ply(path: Path) -> tuple[Array, Faces]:
    if path.suffix.lower() != ".ply":
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    try:
        return read_triangles(path)
    except (OSError, ValueError) as cause:
        raise InputError(
            f"{path} cannot be read ({cause}); give a .ply or .obj of triangles"
        ) from None


def _obj(path: Path) -> tuple[Array, Faces]:
    """Vertices and triangles in the order of the file, which open3d's reader does not keep."""
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        vertices = [words[1:4] for words in lines if words[:1] == ["v"]]
        corners = [
            [word.split("/")[0] for word in words[1:4]] for words in lines if words[:1] == ["f"]
        ]
        return np.array(vertices, float).reshape(-1, 3), np.array(corners, np.int32) - 1
    except (OSError, ValueError, OverflowError):
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
