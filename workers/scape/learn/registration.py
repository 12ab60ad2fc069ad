"""The model's best fit to a whole surface in another topology: how far its shapes reach.

Gauss-Newton on pose, shape and place. Every step pairs sample vertices with the surface's nearest
points, and the surface's points with the nearest vertices; residuals count along the surface's
normals, and a little across, so that nothing slides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
import scipy.linalg
from numpy.typing import NDArray

from workers.scape.evidence.correspondence import OrientedTree, compatible
from workers.scape.fit.gauss_newton import (
    DAMPING,
    TwistPrior,
    add_shape_prior,
    shape_parameters,
    updated,
)
from workers.scape.fit.hands import Hand, place_hands
from workers.scape.fit.initial import starting_states
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import Faces, vertex_areas, vertex_normals
from workers.scape.model.sampled import SampledBody

Array = NDArray[np.float64]

_SCOUT_SAMPLES = 250
_SCOUT_POINTS = 800
_MAX_ANGLE_RAD = np.radians(60.0)
_ACROSS = 0.05
"""Weight of a residual across the normal, against one along it."""
_NOISE_M = 0.002
_SCHEDULE = (
    # components, gate and robust scale in metres, steps
    (6, 0.25, 0.060, 6),
    (20, 0.15, 0.030, 6),
    (60, 0.10, 0.020, 6),
    (1 << 20, 0.06, 0.010, 14),
)


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances from a surface to the fitted one, and back."""

    to_model_m: Array
    """(n,): of the surface's vertices."""
    to_surface_m: Array
    """(P,): of the model's vertices."""
    nearest_vertex: NDArray[np.intp]
    """(n,): the model's vertex that comes nearest to each of the surface's."""


def register(
    model: BodyModel,
    samples: SampledBody,
    hands: tuple[Hand, ...],
    vertices: Array,
    faces: Faces,
) -> BodyState:
    """The state that comes nearest to a standing body's closed surface.

    Args:
        samples: vertices of the model, in an order whose first ones are spread evenly.
        vertices: (n, 3), z up, facing -y, metres.
        faces: (m, 3), counter-clockwise seen from outside.
    """
    surface = _Surface.build(vertices, faces)
    scouts = samples.first(_SCOUT_SAMPLES)
    every = max(1, len(vertices) // _SCOUT_POINTS)
    state = starting_states(model, scouts, vertices[::every], vertices)[0]
    share = _share_of_samples(model, samples)
    owner = _nearest_sample(model, samples)
    prior = TwistPrior.build(model)
    cloud = OrientedTree.build(surface.points, surface.normals)
    for components, gate_m, scale_m, steps in _SCHEDULE:
        if components > model.beta_count:
            body = model.vertices(state)
            state = place_hands(model, hands, cloud, state, body, vertex_normals(body, model.faces))
        for _ in range(steps):
            weight, weighted = _pairs(model, state, samples, surface, share, owner, gate_m, scale_m)
            state = _step(model, samples, state, weight, weighted, components, prior)
    return state


def distances(model: BodyModel, state: BodyState, vertices: Array, faces: Faces) -> Distances:
    """Surface to surface, both ways."""
    body = model.vertices(state)
    own = _Surface.build(body, model.faces)
    other = _Surface.build(vertices, faces)
    to_model, _ = own.nearest(vertices)
    to_surface, _ = other.nearest(body)
    tree = OrientedTree.build(body, vertex_normals(body, model.faces))
    return Distances(
        np.linalg.norm(to_model - vertices, axis=1),
        np.linalg.norm(to_surface - body, axis=1),
        tree.nearest(vertices, vertex_normals(vertices, faces)),
    )


@dataclass(frozen=True, slots=True)
class _Surface:
    points: Array
    normals: Array
    areas: Array
    scene: o3d.t.geometry.RaycastingScene

    @classmethod
    def build(cls, vertices: Array, faces: Faces) -> _Surface:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
        )
        normals = vertex_normals(vertices, faces)
        return cls(vertices, normals, vertex_areas(vertices, faces), scene)

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Nearest points of the surface (n, 3) and its normals there (n, 3)."""
        found = self.scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
        return (
            found["points"].numpy().astype(np.float64),
            found["primitive_normals"].numpy().astype(np.float64),
        )


def _share_of_samples(model: BodyModel, samples: SampledBody) -> Array:
    """(n,): the area that each sample stands for, mean 1."""
    owner = _nearest_sample(model, samples)
    areas = vertex_areas(model.mean, model.faces)
    share = np.bincount(owner, areas, minlength=len(samples.indices))
    return np.asarray(share / share.mean())


def _nearest_sample(model: BodyModel, samples: SampledBody) -> NDArray[np.intp]:
    """(P,): the sample that stands for each vertex."""
    normals = vertex_normals(model.mean, model.faces)
    tree = OrientedTree.build(model.mean[samples.indices], normals[samples.indices])
    return tree.nearest(model.mean, normals)


def _pairs(
    model: BodyModel,
    state: BodyState,
    samples: SampledBody,
    surface: _Surface,
    share: Array,
    owner: NDArray[np.intp],
    gate_m: float,
    scale_m: float,
) -> tuple[Array, Array]:
    """Information (n, 3, 3) of each sample, and its product with the residual (n, 3)."""
    body = model.vertices(state)
    normals = vertex_normals(body, model.faces)
    mine = samples.indices
    found, directions = surface.nearest(body[mine])
    back = OrientedTree.build(body, normals).nearest(surface.points, surface.normals)
    sample = np.concatenate([np.arange(len(mine)), owner[back]])
    offsets = np.concatenate([found - body[mine], surface.points - body[back]])
    along = np.concatenate([directions, surface.normals])
    area = np.concatenate([share, surface.areas * len(mine) / surface.areas.sum()])
    kept = compatible(
        offsets,
        np.concatenate([normals[mine], normals[back]]),
        along,
        max_distance_m=gate_m,
        max_angle_rad=_MAX_ANGLE_RAD,
    )
    sample, offsets, along, area = sample[kept], offsets[kept], along[kept], area[kept]
    residual = np.einsum("ni,ni->n", along, offsets)
    robust = area / (1.0 + (residual / scale_m) ** 2) ** 2 / _NOISE_M**2
    metric = along[:, :, None] * along[:, None, :] * (1.0 - _ACROSS) + _ACROSS * np.eye(3)
    weights = robust[:, None, None] * metric
    weighted = np.einsum("nij,nj->ni", weights, offsets)
    total = np.zeros((len(mine), 12))
    rows = np.concatenate([weights.reshape(-1, 9), weighted], axis=1)
    for column in range(12):
        total[:, column] = np.bincount(sample, rows[:, column], len(mine))
    return total[:, :9].reshape(-1, 3, 3), total[:, 9:]


def _step(
    model: BodyModel,
    samples: SampledBody,
    state: BodyState,
    weight: Array,
    weighted: Array,
    components: int,
    prior: TwistPrior,
) -> BodyState:
    active = min(components, model.beta_count)
    _, rows = samples.jacobian(state, active)
    size = rows.shape[2]
    flat = rows.reshape(-1, size)
    normal = (flat.T @ (weight.astype(np.float32) @ rows).reshape(-1, size)).astype(np.float64)
    gradient = (flat.T @ weighted.ravel().astype(np.float32)).astype(np.float64)
    shape = shape_parameters(model, active)
    add_shape_prior(state, normal, gradient, shape)
    prior.add(model, state, normal, gradient)
    normal[np.diag_indices(size)] += DAMPING * np.trace(normal) / size
    return updated(state, scipy.linalg.solve(normal, gradient, assume_a="pos"), shape)
