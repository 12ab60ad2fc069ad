"""Point clouds and meshes from files, oriented and placed as the fit needs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from station.core.errors import InputError
from workers.cloud.bare import lowest_m, scatter_m
from workers.cloud.floor import UNITS_M, Z_UP, check_units, standing_on
from workers.cloud.observed import MIN_POINTS, POSSIBLE_HEIGHTS_M, PointCloud
from workers.cloud.pcd import check_pcd
from workers.cloud.ply import read_points, read_triangles

Array = NDArray[np.float64]
Faces = NDArray[np.int32]

_MAX_POINTS = 250_000
_NORMAL_NEIGHBOURS = 24
"""Neighbours that a normal is estimated from."""
_UNIT = 0.01
"""Deviation from 1 of a normal's length in a file: formats round to a few digits."""
_ORIENTED = 25_000
"""Points whose normals are oriented; the others follow the nearest of them."""
_DIRECTIONS = 40
"""Directions, evenly around, from which a cloud is looked at."""
_PIXEL_M = 0.015
"""Pixels of these pictures: points are 5 to 8 mm apart."""
_HIDDEN_M = 0.02
"""Depth behind the nearest of the pixels around it from which a point is hidden: that of slanted
skin, and less than a hand is thick."""
_FLAT_M = 0.005
"""Least standard deviation of a body's points across its thinnest direction."""
_FOOT_M = 0.12
"""Height of a foot."""
_LINKS, _SPREAD_ROUNDS = 8, 150
"""Neighbours that evidence is shared with, and how often: points are 5 to 8 mm apart, so that it
comes 10 cm far."""
_SAME_SKIN = 0.6
"""Largest sine of the slope from a point to a neighbour on the same skin, and the least cosine of
their normals."""
_SIGMA_M = 0.001
"""Standard deviation that is assumed for the points of a file."""
_UNSEEN_SOLES_M = 0.03
"""A cloud that begins this little above its z = 0 stands on it: cameras do not see soles."""
_MAX_EXTENT_M = 12.0
"""Size of a room: a cell of the search for the person's surroundings takes memory."""
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
    person = standing_on(np.asarray(cloud.points))
    if person is not None:
        cloud = cloud.select_by_index(np.flatnonzero(person[0]))
    if not _has_unit_normals(cloud):
        _estimate_normals(cloud)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    tree = cKDTree(points)
    middle = np.median(points, axis=0)
    if np.einsum("ni,ni->n", points - middle, normals).mean() < 0:
        normals = -normals
    if person is None:
        low_m = lowest_m(tree)
        middle[2] = 0.0 if 0.0 <= low_m < _UNSEEN_SOLES_M else low_m
    else:
        middle[2] = person[1]
    x, y, z = (float(value) for value in middle)
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


def _has_unit_normals(cloud: o3d.geometry.PointCloud) -> bool:
    """Whether every point has a direction: programs that know none write zeros."""
    lengths = np.linalg.norm(np.asarray(cloud.normals), axis=1)
    return cloud.has_normals() and bool((np.abs(lengths - 1.0) < _UNIT).all())


def _check_solid(points: Array, path: Path) -> None:
    if np.linalg.matrix_rank(points - points.mean(axis=0), _FLAT_M * np.sqrt(len(points))) < 3:
        raise InputError(f"{path} is flat; a body has a front and a back")


def _estimate_normals(cloud: o3d.geometry.PointCloud) -> None:
    """Give a cloud normals that point out of the body or into it."""
    points = np.asarray(cloud.points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
    cloud.normals = o3d.utility.Vector3dVector(_outwards(points, np.asarray(cloud.normals)))


def _outwards(points: Array, normals: Array) -> Array:
    """Normals (n, 3) of a body's points (n, 3), each oriented to where the skin around it is seen
    from.
    """
    chosen = slice(None, None, max(1, len(points) // _ORIENTED))
    places, directions = points[chosen], normals[chosen]
    tree = cKDTree(places)
    evidence = _spread(tree, directions, _evidence(points, places, directions))
    mine = np.where(evidence < 0.0, -1.0, 1.0)[:, None] * directions
    mine = mine[tree.query(points, workers=-1)[1]]
    agrees = np.einsum("ni,ni->n", mine, normals) >= 0.0
    return np.where(agrees[:, None], normals, -normals)


def _spread(tree: cKDTree, directions: Array, evidence: Array) -> Array:
    """Evidence (n,) of a tree's points, spread along the skin: neighbours whose directions are
    alike share it, and where they are opposite it changes its sign.
    """
    neighbours = tree.query(tree.data, _LINKS + 1, workers=-1)[1][:, 1:]
    offsets = tree.data[neighbours] - tree.data[:, None]
    across = np.abs(np.einsum("ni,nki->nk", directions, offsets))
    cosine = np.einsum("ni,nki->nk", directions, directions[neighbours])
    # Skin that touches other skin lies along the normal from it.
    one_skin = across < _SAME_SKIN * np.linalg.norm(offsets, axis=2)
    link = np.where(one_skin & (np.abs(cosine) > _SAME_SKIN), cosine, 0.0)
    tail = np.repeat(np.arange(tree.n), _LINKS)
    graph = csr_matrix((link.ravel() / _LINKS, (tail, neighbours.ravel())), shape=(tree.n, tree.n))
    found = evidence
    for _ in range(_SPREAD_ROUNDS):
        found = evidence + graph @ found
    return np.asarray(found)


def _evidence(points: Array, places: Array, directions: Array) -> Array:
    """Evidence (n,) that directions (n, 3) at places (n, 3) of a cloud point out of the body;
    negative where they point into it.

    Whoever sees a place looks at the skin's outside. A foot stands on a floor, which hides its
    inside from below.
    """
    low_m = float(points[:, 2].min())
    floor = points[points[:, 2] < low_m + _FOOT_M] * (1.0, 1.0, 0.0) + (0.0, 0.0, low_m)
    seen = np.concatenate([points, floor])
    found = np.zeros(len(places))
    for towards in _evenly_around(_DIRECTIONS):
        across = np.linalg.svd(towards[None])[2][1:].T
        corner = (seen @ across).min(axis=0) - _PIXEL_M
        pixel = ((seen @ across - corner) / _PIXEL_M).astype(np.int64)
        nearest = np.full(pixel.max(axis=0) + 2, -np.inf)
        np.maximum.at(nearest, tuple(pixel.T), seen @ towards)
        nearest = ndimage.maximum_filter(nearest, 3)
        mine = ((places @ across - corner) / _PIXEL_M).astype(np.int64)
        visible = places @ towards > nearest[tuple(mine.T)] - _HIDDEN_M
        found += visible * (directions @ towards)
    return found


def _evenly_around(count: int) -> Array:
    """Unit vectors (count, 3) on a spiral of equal steps in height (Fibonacci's lattice)."""
    step = np.arange(count) + 0.5
    turn, height = np.pi * (3.0 - np.sqrt(5.0)) * step, 1.0 - 2.0 * step / count
    level = np.sqrt(1.0 - height**2)
    return np.column_stack([level * np.cos(turn), level * np.sin(turn), height])


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
