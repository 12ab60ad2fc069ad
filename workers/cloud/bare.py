"""A bare point cloud from any scanner as the fit wants it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from station.core.errors import InputError
from workers.cloud.observed import LEAST_POINTS, POSSIBLE_HEIGHTS_M, PointCloud

Array = NDArray[np.float64]
Faces = NDArray[np.int32]

_MOST_POINTS = 250_000
_NORMAL_NEIGHBOURS = 24
_ASKED, _OTHERS = 25_000, 12_000
"""Points that look for a body's other side, and among which."""
_DEPTHS_M = (0.06, 0.09, 0.13, 0.18, 0.24, 0.30)
"""How thick a body is, from forearms to trunks."""
_WIDENING, _SPACING_M = 0.25, 0.01
"""How far beside a normal the other side may lie: it is slanted, and sampled."""
_NEARNESS_M = 0.15
"""What lies nearer counts more: farther away there may be another limb."""
_VOTERS, _ROUNDS = 30, 8
_AGREED = 0.8
_SIGMA_M = 0.001
_UNSEEN_SOLES_M = 0.03
"""A cloud that begins so little above its own z = 0 stands there: cameras see no soles."""
_OFF_FLOOR_M = 0.05
"""How far a mesh's soles may be from the floor: heights are counted from there."""


def read_cloud(path: Path, up: str) -> PointCloud:
    """Read a cloud in metres; its middle becomes the mark, and its lowest points the floor, unless
    they lie as little above z = 0 as soles that no camera saw.

    Where that was in the file, after `up`, is the cloud's origin_m. The same file gives the same
    points.

    Args:
        up: "z" or "y", the axis that points up.

    Raises:
        InputError: the file is missing, is no cloud, or holds no numbers.
    """
    if not path.is_file():
        raise InputError(f"{path} is not a file; give a point cloud, .ply or .pcd")
    cloud = o3d.io.read_point_cloud(path)
    points = np.asarray(cloud.points)
    if not len(points):
        raise InputError(f"{path} holds no points; give a point cloud, .ply or .pcd")
    if len(points) < LEAST_POINTS:
        raise InputError(f"{path} has {len(points)} points; a body needs {LEAST_POINTS}")
    if not np.isfinite(points).all():
        raise InputError(f"{path} holds points that are not numbers; repair it")
    if len(points) > _MOST_POINTS:
        kept = np.random.default_rng(len(points)).permutation(len(points))[:_MOST_POINTS]
        cloud = cloud.select_by_index(np.sort(kept))
    if not cloud.has_normals():
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
        try:
            cloud.orient_normals_consistent_tangent_plane(_NORMAL_NEIGHBOURS)
        except RuntimeError as error:
            raise InputError(f"{path} is flat; a body has a front and a back") from error
        normals = _consistent(np.asarray(cloud.points), np.asarray(cloud.normals))
        cloud.normals = o3d.utility.Vector3dVector(normals)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    if up == "y":
        points, normals = points[:, [0, 2, 1]] * (1, -1, 1), normals[:, [0, 2, 1]] * (1, -1, 1)
    middle = np.median(points, axis=0)
    if np.einsum("ni,ni->n", points - middle, normals).mean() < 0:
        normals = -normals
    low_m = float(points[:, 2].min())
    middle[2] = 0.0 if 0.0 <= low_m < _UNSEEN_SOLES_M else low_m
    x, y, z = (float(value) for value in middle)
    return PointCloud(
        points=points - middle,
        normals=normals,
        sigma_m=np.full(len(points), _SIGMA_M),
        camera=np.zeros(len(points), np.int16),
        camera_names=("cloud",),
        origin_m=(x, y, z),
    )


def _consistent(points: Array, normals: Array) -> Array:
    """Normals (n, 3) that all look out of a body or all into it, of some that agree with their
    neighbours.

    In the gaps between what two scanners saw such an agreement is lost: one side may then be turned
    in while the other looks out. Where that is so, each is turned by what lies behind it.
    """
    turned = _turned_outwards(points, normals)
    share = float(np.mean(np.einsum("ni,ni->n", turned, normals) > 0.0))
    return turned if 1.0 - _AGREED < share < _AGREED else normals


def _turned_outwards(points: Array, normals: Array) -> Array:
    """Normals (n, 3) of a body's points (n, 3), each turned out of it.

    Behind the skin lies the body's other side, before it nothing or another limb, farther away.
    Neighbours vote; between limbs and on hands it fails.
    """
    chosen = slice(None, None, max(1, len(points) // _ASKED))
    asked, directions = points[chosen], normals[chosen]
    others = cKDTree(points[:: max(1, len(points) // _OTHERS)])
    outside = np.zeros(len(asked))
    for depth_m in _DEPTHS_M:
        gap_m = _WIDENING * depth_m + _SPACING_M
        for side in (1.0, -1.0):
            place = asked + side * depth_m * directions
            away = others.query(place, distance_upper_bound=gap_m, workers=-1)[0]
            outside -= side * (away < gap_m) * np.exp(-depth_m / _NEARNESS_M)
    tree = cKDTree(asked)
    voters = tree.query(asked, _VOTERS, workers=-1)[1]
    outwards = np.sign(outside)[:, None] * directions
    for _ in range(_ROUNDS):
        agreed = np.einsum("ni,ni->n", outwards[voters].sum(axis=1), directions) >= 0.0
        outwards = np.where(agreed[:, None], directions, -directions)
    mine = outwards[tree.query(points, workers=-1)[1]]
    agrees = np.einsum("ni,ni->n", mine, normals) >= 0.0
    return np.where(agrees[:, None], normals, -normals)


def read_template_mesh(path: Path, faces: Faces, up: str) -> Array:
    """The vertices (P, 3) of a mesh file with the template's triangles (K, 3), z up.

    Args:
        up: "z" or "y", the axis that points up in the file.

    Raises:
        InputError: the file is missing, is no mesh, holds no numbers, has other triangles, or is no
            adult in metres who stands on the floor.
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
    if up == "y":
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    low_m, high_m = float(vertices[:, 2].min()), float(vertices[:, 2].max())
    if not POSSIBLE_HEIGHTS_M[0] < high_m - low_m < POSSIBLE_HEIGHTS_M[1]:
        raise InputError(
            f"{path} is {high_m - low_m:.4g} high with {up} up; metres were expected, or is "
            f"another axis up? see --up"
        )
    if abs(low_m) > _OFF_FLOOR_M:
        raise InputError(f"{path} has its soles at {low_m:.3f} m; move them to the floor at 0")
    return vertices


def _ply(path: Path) -> tuple[Array, Faces]:
    if path.suffix.lower() != ".ply":
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    # What is wrong with a file is said once, in our own words.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(path)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _obj(path: Path) -> tuple[Array, Faces]:
    """Vertices and triangles in the file's own order, which open3d's reader does not keep."""
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        vertices = [words[1:4] for words in lines if words[:1] == ["v"]]
        corners = [
            [word.split("/")[0] for word in words[1:4]] for words in lines if words[:1] == ["f"]
        ]
        return np.array(vertices, float).reshape(-1, 3), np.array(corners, np.int32) - 1
    except ValueError:
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
