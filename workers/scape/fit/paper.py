"""The algorithm of the paper (Zhou et al. 2013), for comparison with the joint fit.

Iterate until Y' stops changing: (a) correspondences and rigid alignment until the pairs settle,
(b) pose and shape by SCAPE's quadratic energies in turn, (c) the mesh that minimises
E(Y') = sum_p |M(p) - Y'(p)|^2 + w sum_i |Y'(p_i) - T(q_i)|^2 with w = 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from station.core.errors import InputError
from station.core.geometry import rigid_fit, transform
from workers.scape.evidence.correspondence import compatible
from workers.scape.fit.normal_equations import Target
from workers.scape.fit.observer import Observer, unobserved
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.displacement import SurfaceFit

Array = NDArray[np.float64]

MAX_CORRESPONDENCE_DISTANCE_M = 0.05
MAX_NORMAL_ANGLE_RAD = np.radians(15.0)
SURFACE_WEIGHT = 1.0
_MAX_ITERATIONS = 10
"""Iterations of the whole loop; the paper uses ten."""
_MAX_ALIGNMENTS = 20
"""Repetitions of step (a)."""
_SETTLED_M = 5e-4
"""Rms change of the mesh below which the loop ends."""
_MIN_PAIRS = 50
_UNPAIRED_WEIGHT = 0.05
"""Weight of a vertex without a pair in step (b), where one with a pair has 1."""
_MIN_PAIRED = 0.2
"""Share of a part's vertices with pairs from which its own rotation is solved."""
_SHAPE_RIDGE = 1e-3
"""Ridge of the shape's energy, as a share of its mean diagonal."""

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Vertices and the points that they belong to."""


def fit_like_the_paper(
    model: BodyModel,
    target: Target,
    state: BodyState,
    progress: Callable[[float], None] = lambda share: None,  # noqa: ARG005
    observer: Observer = unobserved,
) -> tuple[SurfaceFit, BodyState, int]:
    """The paper's loop; returns the surface, the last state and the number of iterations."""
    mesh = model.vertices(state)
    iteration = 0
    for iteration in range(1, _MAX_ITERATIONS + 1):
        mesh, pairs = align_rigidly(model, target, mesh)
        on_body, on_cloud = mesh[pairs[0]], target.tree.points[pairs[1]]
        drawn = {"on_body": on_body, "on_cloud": on_cloud}
        drawn["gate_m"] = np.array(MAX_CORRESPONDENCE_DISTANCE_M)
        observer("correspondences", {"vertices": mesh, **drawn})
        state = solve_pose_and_shape(model, mesh, state, pairs, target)
        solved = solve_mesh(model.vertices(state), pairs, target)
        change_m = float(np.sqrt(np.mean(np.sum((solved - mesh) ** 2, axis=1))))
        mesh = solved
        progress(iteration / _MAX_ITERATIONS)
        if change_m < _SETTLED_M:
            break
    seen = np.zeros(len(mesh), bool)
    vertex, point = find_pairs(model, target, mesh)
    seen[vertex] = True
    normals = vertex_normals(mesh, model.faces)
    residual = np.full(len(mesh), np.nan)
    residual[vertex] = np.einsum(
        "ni,ni->n", normals[vertex], target.tree.points[point] - mesh[vertex]
    )
    surface = SurfaceFit(
        vertices=mesh,
        sigma_m=model.vertex_sigma_m.copy(),
        seen=seen,
        residual_m=residual,
        measured=seen,
    )
    return surface, state, iteration


def find_pairs(model: BodyModel, target: Target, mesh: Array) -> Pairs:
    """Step (a): nearest point of each vertex, closer than 5 cm and within 15 degrees."""
    normals = vertex_normals(mesh, model.faces)
    point = target.tree.nearest(mesh, normals)
    kept = compatible(
        target.tree.points[point] - mesh,
        normals,
        target.tree.normals[point],
        max_distance_m=MAX_CORRESPONDENCE_DISTANCE_M,
        max_angle_rad=MAX_NORMAL_ANGLE_RAD,
    )
    return np.flatnonzero(kept), point[kept]


def align_rigidly(model: BodyModel, target: Target, mesh: Array) -> tuple[Array, Pairs]:
    """Step (a), repeated: rigid motion of the mesh until its pairs no longer change."""
    pairs = find_pairs(model, target, mesh)
    for _ in range(_MAX_ALIGNMENTS):
        if len(pairs[0]) < _MIN_PAIRS:
            raise InputError(
                "the paper's method finds no match with this cloud; use --method joint"
            )
        mesh = transform(rigid_fit(target.tree.points[pairs[1]], mesh[pairs[0]]), mesh)
        found = find_pairs(model, target, mesh)
        settled = len(found[0]) == len(pairs[0]) and np.array_equal(found[1], pairs[1])
        pairs = found
        if settled:
            break
    return mesh, pairs


def solve_pose_and_shape(
    model: BodyModel, mesh: Array, state: BodyState, pairs: Pairs, target: Target
) -> BodyState:
    """Step (b): theta, then beta, each by its own energy, for the mesh moved to its pairs."""
    goal = mesh.copy()
    goal[pairs[0]] = target.tree.points[pairs[1]]
    weight = np.full(len(mesh), _UNPAIRED_WEIGHT)
    weight[pairs[0]] = 1.0
    found = model.project(goal, iterations=2, ridge=_SHAPE_RIDGE, weight=weight)
    return _followed(model, state, found, weight)


def _followed(model: BodyModel, before: BodyState, found: BodyState, weight: Array) -> BodyState:
    """A state in which parts with few pairs turn with their parents: an arm that is farther away
    than pairs reach comes nearer with its shoulder."""
    rotations = found.rotations.copy()
    paired = model.vertex_weights.T @ weight / model.vertex_weights.sum(axis=0)
    for part, parent in enumerate(model.part_parents):
        if parent >= 0 and paired[part] < _MIN_PAIRED:
            rotations[part] = (
                rotations[parent] @ before.rotations[parent].T @ before.rotations[part]
            )
    return replace(found, rotations=rotations)


def solve_mesh(model_mesh: Array, pairs: Pairs, target: Target) -> Array:
    """Step (c): E(Y') does not couple vertices, so its minimum is a weighted mean at each."""
    mesh = model_mesh.copy()
    vertex, point = pairs
    mesh[vertex] = (mesh[vertex] + SURFACE_WEIGHT * target.tree.points[point]) / (
        1.0 + SURFACE_WEIGHT
    )
    return mesh
