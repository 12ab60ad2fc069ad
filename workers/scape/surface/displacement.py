"""Displacement of the fitted model's surface onto the cloud (the paper's E(Y'), with weights from
the measured noise).

Every round minimises over the displacements s (P,) along the vertex normals n

    sum_v w_v (s_v - r_v)^2 + mu s^T (L + epsilon I) s,          Y' = Y + s n,

where w_v and r_v sum up all points that belong to vertex v (information and mean distance), L is
the graph Laplacian of the template and mu = 0.01 stiffness / (1 mm)^2. The field is smooth and
fades where no camera saw the body. Each round starts from the surface of the one before, with a
narrower gate and less stiffness.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from workers.cloud.observed import PointCloud
from workers.scape.evidence.correspondence import TrackedPoints
from workers.scape.evidence.floor import stand_on_floor
from workers.scape.evidence.rows import Rows
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import area_vectors, vertex_normals
from workers.scape.model.kernels import conjugate_gradients

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class _Round:
    gate_m: float
    """Largest distance between a vertex and a point of it."""
    angle_rad: float
    """Largest angle between their normals."""
    stiffness: float
    """mu in units of _BENDING_UNIT / _STIFFNESS_SIGMA_M^2."""
    tolerance: float
    """Relative residual at which the solver stops."""


_ROUNDS = (
    _Round(0.030, np.radians(50), 240.0, 1e-2),
    _Round(0.020, np.radians(45), 48.0, 1e-2),
    _Round(0.012, np.radians(40), 12.0, 1e-3),
)
_STIFFNESS_SIGMA_M = 0.001
"""Data noise at which a stiffness is stated, metres."""
_BENDING_UNIT = 1e-2
"""Factor of the Laplacian term for a stiffness of 1 at that noise."""
_FADE = 2.5e-5
"""epsilon: weak pull towards the model, so that the field cannot drift where there are no data."""
_MOST_SOLVER_STEPS = 250
"""Conjugate gradient steps of a round, where the tolerance is not met before."""
_INDEPENDENT = 0.25
"""Share of a vertex's readings that count as independent: the sensor's matching windows overlap."""
_LEAST_SIGMA_M = 3e-4
"""Floor of a reading's standard deviation: quantisation and calibration do not average out."""
_MOST_POINTS = 50_000
"""Points used at most: more add nothing beyond what neighbouring readings share."""
_FLIP_LIMIT = 0.1
"""A triangle counts as flipped when less than this share of its area vector is left."""
_FLIP_TRIES, _FLIP_FACTOR = 4, 0.4
"""How often, and by what factor, steps at flipped triangles are shortened."""
_LEAST_MODEL_SIGMA_M = 5e-4
"""Floor of the model's own standard deviation at a vertex, for the posterior."""
_POSTERIOR_RINGS = 4
"""Edges along which a vertex's information reaches its neighbours ..."""
_POSTERIOR_DECAY = 0.5
"""... and the share that is left after each."""


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """A surface fitted to a cloud. P vertices."""

    vertices: Array
    sigma_m: Array
    """(P,): posterior standard deviation along the normal."""
    seen: NDArray[np.bool_]
    """(P,): points lie on the vertex or on a neighbour of it."""
    residual_m: Array
    """(P,): mean signed distance of the vertex's points after the fit; NaN where it has none."""


def fit_surface(
    model: BodyModel,
    vertices: Array,
    cloud: PointCloud,
    rims: PointCloud,
    crown: Callable[[Array], Rows],
) -> SurfaceFit:
    """Fit the model's surface to a cloud, to the rims of the hands and to the top of the head.

    Args:
        vertices: (P, 3), the model's surface.
        rims: outlines of the hands, where the cloud ends.
        crown: rows for the top of the head, a function of the current vertices. There are no points
            there, so the smooth field alone would carry on the trend of the points around it.
    """
    every = slice(None, None, -(-len(cloud.points) // _MOST_POINTS))
    points = np.concatenate([cloud.points[every], rims.points])
    directions = np.concatenate([cloud.normals[every], rims.normals])
    tracked = TrackedPoints(model.neighbours, points, directions, dense=True)
    noise = np.concatenate([cloud.sigma_m[every], rims.sigma_m])
    laplacian = _graph_laplacian(model)
    identity = sp.identity(len(vertices), format="csr")
    current = vertices
    for round_ in _ROUNDS:
        normals = vertex_normals(current, model.faces)
        residual, weight = _point_rows(current, normals, tracked, noise, round_)
        residual, weight = _combined(residual, weight, *crown(current).along(normals))
        bending = round_.stiffness / _STIFFNESS_SIGMA_M**2 * _BENDING_UNIT
        matrix = (sp.diags(weight) + bending * (laplacian + _FADE * identity)).tocsr()
        step = conjugate_gradients(
            matrix.indptr,
            matrix.indices,
            matrix.data,
            weight * residual,
            round_.tolerance,
            _MOST_SOLVER_STEPS,
        )
        step *= _step_factor(model, current, normals, step)
        current = current + step[:, None] * normals
    current = stand_on_floor(model, current)
    normals = vertex_normals(current, model.faces)
    # A rim says where the skin ends, not that a camera saw it.
    noise[len(noise) - len(rims) :] = np.inf
    residual, weight = _point_rows(current, normals, tracked, noise, _ROUNDS[-1])
    # The template is finer than the pixels: a vertex between others that have points is seen too.
    seen = (abs(laplacian) @ weight) > 0
    return SurfaceFit(
        current, _posterior_sigma(model, weight), seen, np.where(weight > 0, residual, np.nan)
    )


@lru_cache(maxsize=2)
def _graph_laplacian(model: BodyModel) -> sp.csr_matrix:
    """L (P, P) of the template's edges, without lengths.

    In two dimensions such a membrane is as stiff in small triangles as in large ones, so that ears
    and lips, which have small ones, do not follow the noise.
    """
    degree = np.asarray(model.adjacency.sum(axis=1)).ravel()
    return (sp.diags(degree) - model.adjacency).tocsr()


def _point_rows(
    vertices: Array, normals: Array, tracked: TrackedPoints, sigma_m: Array, round_: _Round
) -> tuple[Array, Array]:
    """Mean distance (P,) of each vertex to its points along their normals, and its information.

    The skin is curved and the template coarse: the points around a vertex lie below its tangent
    plane by half the square of their distance over the radius, and the vertex lies below theirs by
    as much. Along the vertex's normal, the mean would draw a limb's vertices inwards, where the
    polygon through them is too short already. Along the points' own normals it moves them outwards
    by as much as the polygon needs to have the girth of the curve, to second order.
    """
    used, vertex = tracked.pairs(
        vertices, normals, max_distance_m=round_.gate_m, max_angle_rad=round_.angle_rad
    )
    points, directions = tracked.points, tracked.normals
    distance = np.einsum("ni,ni->n", directions[used], points[used] - vertices[vertex])
    information = _INDEPENDENT / np.maximum(sigma_m[used], _LEAST_SIGMA_M) ** 2
    count = len(vertices)
    weight: Array = np.bincount(vertex, information, count).astype(np.float64)
    total: Array = np.bincount(vertex, information * distance, count).astype(np.float64)
    return total / np.maximum(weight, 1e-12), weight


def _combined(
    residual: Array, weight: Array, more_weight: Array, more_total: Array
) -> tuple[Array, Array]:
    """Weighted mean distance (P,) and information (P,) of two sets of rows.

    Args:
        residual, weight: (P,), mean and information of the first set.
        more_weight, more_total: (P,), information and weighted sum of the second.
    """
    total = weight + more_weight
    return (weight * residual + more_total) / np.maximum(total, 1e-12), total


def _step_factor(model: BodyModel, vertices: Array, normals: Array, step: Array) -> Array:
    """Factors (P,) of a step: 1 where it flips no triangle, less where it would."""
    faces = model.faces
    before = area_vectors(vertices, faces)
    factor = np.ones(len(vertices))
    for _ in range(_FLIP_TRIES):
        after = area_vectors(vertices + (factor * step)[:, None] * normals, faces)
        flipped = np.einsum("ki,ki->k", before, after) <= _FLIP_LIMIT * np.einsum(
            "ki,ki->k", before, before
        )
        if not flipped.any():
            break
        factor[np.unique(faces[flipped])] *= _FLIP_FACTOR
    return factor


def _posterior_sigma(model: BodyModel, weight: Array) -> Array:
    """Standard deviation (P,) from the data, spread to the neighbours, and the model's own."""
    prior = 1.0 / np.maximum(model.vertex_sigma_m, _LEAST_MODEL_SIGMA_M) ** 2
    laplacian = model.solver.laplacian
    degree = laplacian.diagonal()
    spread = weight.copy()
    for _ in range(_POSTERIOR_RINGS):
        spread = np.maximum(weight, _POSTERIOR_DECAY * (spread - (laplacian @ spread) / degree))
    return np.asarray(1.0 / np.sqrt(prior + spread))
