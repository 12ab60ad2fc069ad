"""A bare point cloud from any scanner as the fit wants it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d

from station.depth import PointCloud
from station.errors import InputError

_MOST_POINTS = 250_000
_NORMAL_NEIGHBOURS = 24
_SIGMA_M = 0.001


def read_cloud(path: Path, up: str) -> PointCloud:
    """Read a cloud in metres; its lowest points become the floor, its middle the mark.

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
    if not np.isfinite(points).all():
        raise InputError(f"{path} holds points that are not numbers; repair it")
    if len(points) > _MOST_POINTS:
        cloud = cloud.random_down_sample(_MOST_POINTS / len(points))
    if not cloud.has_normals():
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
        cloud.orient_normals_consistent_tangent_plane(_NORMAL_NEIGHBOURS)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    if up == "y":
        points, normals = points[:, [0, 2, 1]] * (1, -1, 1), normals[:, [0, 2, 1]] * (1, -1, 1)
    middle = np.median(points, axis=0)
    if np.einsum("ni,ni->n", points - middle, normals).mean() < 0:
        normals = -normals
    middle[2] = points[:, 2].min()
    return PointCloud(
        points=points - middle,
        normals=normals,
        sigma_m=np.full(len(points), _SIGMA_M),
        camera=np.zeros(len(points), np.int16),
        camera_names=("cloud",),
    )


def read_mesh_vertices(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """The vertices (n, 3) of a mesh file.

    Raises:
        InputError: the file is missing, is no mesh, or holds no numbers.
    """
    if not path.is_file():
        raise InputError(f"{path} is not a file; give a result folder or a mesh")
    vertices = np.asarray(o3d.io.read_triangle_mesh(path).vertices)
    if not len(vertices) or not np.isfinite(vertices).all():
        raise InputError(f"{path} holds no usable mesh")
    return vertices
