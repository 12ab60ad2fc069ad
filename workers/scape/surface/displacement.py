"""The last millimetres: a displacement along the normals that lies on dense data and follows the
model where nobody looked (the paper's E(Y'), with weights from the measured noise).

    min_s  sum_v w_v (s_v - r_v)^2 + stiffness s^T L s,      Y' = Y + s n

w_v and r_v gather all points that belong to vertex v; L is the template's graph Laplacian, so the
field is smooth and fades over what no camera saw. Every round sets out from the last one's surface,
with a narrower gate and less stiffness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from workers.cloud.observed import PointCloud
from workers.scape.evidence.correspondence import Followers
from workers.scape.evidence.crown import Reach
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import area_vectors, vertex_normals
from workers.scape.model.kernels import conjugate_gradients

Array = NDArray[np.float64]

_ROUNDS = (
    # gate, angle, stiffness, tolerance of the solve
    (0.030, np.radians(50), 240.0, 1e-2),
    (0.020, np.radians(45), 48.0, 1e-2),
    (0.012, np.radians(40), 12.0, 1e-3),
)
_SIGMA_OF_STIFFNESS_M = 0.001
_FADE = 2.5e-5
"""A weak pull towards the model, so that a field cannot drift where there are no data."""
_INDEPENDENT = 0.25
"""Share of a vertex' readings that count as independent: matching windows overlap."""
_LEAST_SIGMA_M = 3e-4
_SOLE_M = 0.03
_LIFTED_M = 0.02
_MOST_POINTS = 50_000
"""More add nothing beyond what neighbouring readings share."""


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """A surface on the data. P vertices."""

    vertices: Array
    sigma_m: Array
    """(P,): posterior standard deviation along the normal."""
    seen: NDArray[np.bool_]
    """(P,): points lie on the vertex or on a neighbour of it."""
    residual_m: Array
    """(P,): mean signed distance of its points after the fit; NaN where there are none."""


def fit_surface(
    model: BodyModel,
    vertices: Array,
    cloud: PointCloud,
    rims: PointCloud,
    crown: Callable[[Array], Reach],
) -> SurfaceFit:
    """Lay the model's surface (P, 3) on the cloud's points, and on rims where the cloud ends.

    Where a surface's crown is seen to end besides, a function of its vertices says: the field would
    carry there, where no point is, what the points around it ask for.
    """
    every = slice(None, None, -(-len(cloud.points) // _MOST_POINTS))
    points = np.concatenate([cloud.points[every], rims.points])
    directions = np.concatenate([cloud.normals[every], rims.normals])
    followers = Followers(model.neighbours, points, directions, dense=True)
    noise = np.concatenate([cloud.sigma_m[every], rims.sigma_m])
    laplacian = _membrane(model)
    identity = sp.identity(len(vertices), format="csr")
    current = vertices
    for gate_m, angle_rad, stiffness, tolerance in _ROUNDS:
        normals = vertex_normals(current, model.faces)
        residual, weight = _gathered(current, normals, followers, noise, gate_m, angle_rad)
        residual, weight = _with_crown(residual, weight, normals, crown(current))
        bending = stiffness / _SIGMA_OF_STIFFNESS_M**2 * 1e-2
        matrix = (sp.diags(weight) + bending * (laplacian + _FADE * identity)).tocsr()
        step = conjugate_gradients(
            matrix.indptr, matrix.indices, matrix.data, weight * residual, tolerance, 250
        )
        step *= _hold(model, current, normals, step)
        current = current + step[:, None] * normals
    current = _stood_on_floor(model, current)
    normals = vertex_normals(current, model.faces)
    # A rim says where the skin ends, not that a camera saw it.
    noise[len(noise) - len(rims) :] = np.inf
    residual, weight = _gathered(current, normals, followers, noise, *_ROUNDS[-1][:2])
    # A vertex between others that have points is seen as well: the template is finer than pixels.
    seen = (abs(laplacian) @ weight) > 0
    return SurfaceFit(
        current, _posterior_sigma(model, weight), seen, np.where(weight > 0, residual, np.nan)
    )


@lru_cache(maxsize=2)
def _membrane(model: BodyModel) -> sp.csr_matrix:
    """L (P, P), the graph's: in two dimensions a membrane is as stiff in small triangles as in
    large ones, so that ears and lips do not follow noise."""
    degree = np.asarray(model.adjacency.sum(axis=1)).ravel()
    return (sp.diags(degree) - model.adjacency).tocsr()


def _gathered(
    vertices: Array,
    normals: Array,
    followers: Followers,
    sigma_m: Array,
    gate_m: float,
    angle_rad: float,
) -> tuple[Array, Array]:
    """Each vertex' mean distance (P,) to its points along their normals, and its information.

    The skin is curved and the template coarse: the points around a vertex lie below its tangent
    plane by half the square of their distance over the radius, and the vertex lies below theirs by
    as much. Taken along the vertex' normal, the mean would draw a limb's vertices inwards, where
    the polygon through them is short already; along the points' own normals it puts them as far
    outside as the polygon's girth needs to be that of the curve, to second order.
    """
    used, vertex = followers.pairs(
        vertices, normals, max_distance_m=gate_m, max_angle_rad=angle_rad
    )
    points, directions = followers.points, followers.normals
    distance = np.einsum("ni,ni->n", directions[used], points[used] - vertices[vertex])
    information = _INDEPENDENT / np.maximum(sigma_m[used], _LEAST_SIGMA_M) ** 2
    count = len(vertices)
    weight: Array = np.bincount(vertex, information, count).astype(np.float64)
    total: Array = np.bincount(vertex, information * distance, count).astype(np.float64)
    return total / np.maximum(weight, 1e-12), weight


def _with_crown(
    residual: Array, weight: Array, normals: Array, crown: Reach
) -> tuple[Array, Array]:
    """Distances along the normals (P,) and their information, and what the outlines say of them."""
    count = len(weight)
    along = np.einsum("ni,ni->n", crown.direction, normals[crown.vertex])
    strength = crown.information * along
    total = weight + np.bincount(crown.vertex, strength * along, count)
    pull = weight * residual + np.bincount(crown.vertex, strength * crown.distance_m, count)
    return pull / np.maximum(total, 1e-12), total


def _stood_on_floor(model: BodyModel, vertices: Array) -> Array:
    """Both feet on z = 0, which calibration knows and no camera sees the soles of.

    The lowest centimetres of each foot are stretched or squeezed; a foot that is clearly lifted
    stays where it is.
    """
    standing = vertices.copy()
    for side in ("left", "right"):
        foot = model.part_of_vertex == model.part_names.index(f"foot_{side}")
        low = float(vertices[foot, 2].min())
        if abs(low) > _LIFTED_M:
            continue
        near = foot & (vertices[:, 2] < _SOLE_M)
        standing[near, 2] = (vertices[near, 2] - low) * _SOLE_M / (_SOLE_M - low)
    return standing


def _hold(model: BodyModel, vertices: Array, normals: Array, step: Array) -> Array:
    """1 where a step keeps every triangle's side, less where it would flip one."""
    faces = model.faces
    before = area_vectors(vertices, faces)
    factor = np.ones(len(vertices))
    for _ in range(4):
        after = area_vectors(vertices + (factor * step)[:, None] * normals, faces)
        flipped = np.einsum("ki,ki->k", before, after) <= 0.1 * np.einsum(
            "ki,ki->k", before, before
        )
        if not flipped.any():
            break
        factor[np.unique(faces[flipped])] *= 0.4
    return factor


def _posterior_sigma(model: BodyModel, weight: Array) -> Array:
    """Standard deviation (P,): data and the model's own spread, diffused to the neighbours."""
    prior = 1.0 / np.maximum(model.vertex_sigma_m, 5e-4) ** 2
    laplacian = model.solver.laplacian
    degree = laplacian.diagonal()
    spread = weight.copy()
    # What a vertex knows helps its neighbours within a few edges.
    for _ in range(4):
        spread = np.maximum(weight, 0.5 * (spread - (laplacian @ spread) / degree))
    return np.asarray(1.0 / np.sqrt(prior + spread))
