"""Distances of a result from the true surface, measured at the true surface's points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from station.simulation.scene import Mesh
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_areas

Array = NDArray[np.float64]

_EXTREMITIES = ("hand", "foot")
_SEEN_M = 0.008
"""A place of the true surface as near to a point of the cloud counts as seen."""
_EXPLAINED_M = 0.004
_PLACES = 20_000


@dataclass(frozen=True, slots=True)
class SurfaceErrors:
    """Millimetres, weighted by the true surface's area."""

    body_rms: float
    """Trunk, limbs and head."""
    extremity_rms: float
    """Hands and feet."""
    seen_median: float
    """Trunk, limbs and head where a camera saw the surface."""
    seen_extremity_median: float
    seen_rms: float
    """Trunk, limbs and head within 8 mm of a point of the cloud ..."""
    unseen_rms: float
    """... and beyond."""
    unexplained: float
    """Per cent of the cloud whose true places lie more than 4 mm from the result."""
    height: float
    """Signed."""
    by_part: dict[str, float]
    """rms; a hand with its fingers is one part, as in the verdict."""

    @property
    def worst_part(self) -> tuple[str, float]:
        return max(self.by_part.items(), key=lambda item: item[1])


def ray_scene(vertices: Array, faces: NDArray[np.int32]) -> o3d.t.geometry.RaycastingScene:
    """Surface to which rays and distances can be found."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    return scene


def distances_m(vertices: Array, faces: NDArray[np.int32], points: Array) -> Array:
    """(n,): from points to a surface."""
    scene = ray_scene(vertices, faces)
    found = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32)))
    return np.asarray(found.numpy(), np.float64)


def _nearest_places(truth: Mesh, points: Array) -> Array:
    """(n, 3): places of a true surface next to points."""
    scene = ray_scene(truth.vertices, truth.faces)
    found = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
    return np.asarray(found["points"].numpy(), np.float64)


def surface_errors(
    model: BodyModel,
    vertices: Array,
    seen: NDArray[np.bool_] | None,
    truth: Mesh,
    points: Array | None = None,
) -> SurfaceErrors:
    """Compare a result's vertices (P, 3), of which some were seen (P,), with the true surface."""
    away = 1e3 * distances_m(vertices, model.faces, truth.vertices)
    area = vertex_areas(truth.vertices, truth.faces)
    nearest = cKDTree(vertices).query(truth.vertices)[1]
    # A test body's own vertices say which part they are of, however far the result is away.
    same = np.array_equal(truth.faces, model.faces)
    part = model.part_of_vertex if same else model.part_of_vertex[nearest]
    names = np.array([_operators_name(name) for name in model.part_names])[part]
    extremity = np.char.startswith(names, _EXTREMITIES[0]) | np.char.startswith(
        names, _EXTREMITIES[1]
    )
    visible = np.ones(len(away), bool) if seen is None else seen[nearest]
    near, unexplained = np.ones(len(away), bool), float("nan")
    if points is not None:
        near = cKDTree(points).query(truth.vertices)[0] < _SEEN_M
        places = _nearest_places(truth, points[:: max(1, len(points) // _PLACES)])
        unexplained = 100.0 * float(
            np.mean(distances_m(vertices, model.faces, places) > _EXPLAINED_M)
        )
    return SurfaceErrors(
        body_rms=_rms(away, area, ~extremity),
        extremity_rms=_rms(away, area, extremity),
        seen_median=_median(away, area, ~extremity & visible),
        seen_extremity_median=_median(away, area, extremity & visible),
        seen_rms=_rms(away, area, ~extremity & near),
        unseen_rms=_rms(away, area, ~extremity & ~near),
        unexplained=unexplained,
        height=1e3 * float(np.ptp(vertices[:, 2]) - np.ptp(truth.vertices[:, 2])),
        by_part={str(name): _rms(away, area, names == name) for name in np.unique(names)},
    )


def _operators_name(part: str) -> str:
    stem, _, side = part.rpartition("_")
    return f"hand_{side}" if stem in HAND else part


def _rms(away: Array, area: Array, chosen: NDArray[np.bool_]) -> float:
    if not chosen.any():
        return float("nan")
    return float(np.sqrt(np.average(np.square(away[chosen]), weights=area[chosen])))


def _median(away: Array, area: Array, chosen: NDArray[np.bool_]) -> float:
    """Half of the chosen area lies nearer."""
    if not chosen.any():
        return float("nan")
    order = np.argsort(away[chosen])
    share = np.cumsum(area[chosen][order])
    return float(away[chosen][order][np.searchsorted(share, 0.5 * share[-1])])
