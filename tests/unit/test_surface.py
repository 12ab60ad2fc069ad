"""The surface's offsets: where points are attached, what the prior says, what is solved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from workers.cloud.observed import PointCloud
from workers.scape.model.body_model import HAND, BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.attachment import attached
from workers.scape.surface.displacement import fit_surface
from workers.scape.surface.offset_equations import OffsetRows, solved
from workers.scape.surface.offset_prior import RANGE_M, OffsetPrior, offset_prior
from workers.scape.surface.uncertainty import hidden_head_sigma, surface_sigma

Array = NDArray[np.float64]


def _grid(side: int, size_m: float) -> tuple[Array, NDArray[np.int32]]:
    """A flat square of so many vertices a side."""
    x, y = np.meshgrid(*[np.linspace(0.0, size_m, side)] * 2, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    lower = np.stack([a, a + side, a + side + 1], axis=1)
    upper = np.stack([a, a + side + 1, a + 1], axis=1)
    return vertices, np.concatenate([lower, upper]).astype(np.int32)


def _precision(prior: OffsetPrior, sigma_m: Array) -> sp.csr_matrix:
    """Q (P, P) of the prior, which the solver applies without forming it."""
    between = sp.diags(prior.tau_square(sigma_m) / prior.area_m2)
    return sp.csr_matrix(prior.operator @ between @ prior.operator)


def test_points_are_attached_to_the_nearest_place(model: BodyModel) -> None:
    rng = np.random.default_rng(3)
    normals = vertex_normals(model.mean, model.faces)
    chosen = np.flatnonzero(model.part_of_vertex == model.part_names.index("abdomen"))
    points = model.mean[chosen] + 0.001 * rng.standard_normal((len(chosen), 3))
    points += 0.003 * normals[chosen]
    _, near = cKDTree(model.mean).query(points)
    places = attached(model, model.mean, points, near).of(model.mean, model.faces)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(model.mean.astype(np.float32)),
        o3d.core.Tensor(model.faces.astype(np.uint32)),
    )
    nearest = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    assert np.abs(np.linalg.norm(points - places, axis=1) - nearest).max() < 1e-4


def test_the_prior_is_a_field_of_unit_deviation_and_the_stated_range() -> None:
    """Far from the border the variance is 1 and the Matern correlation at the range 0.14."""
    vertices, faces = _grid(61, 0.6)
    prior = OffsetPrior.build(vertices, faces)
    middle = int(np.argmin(np.linalg.norm(vertices[:, :2] - 0.3, axis=1)))
    column = spsolve(
        _precision(prior, np.ones(len(vertices))).tocsc(), np.eye(len(vertices))[middle]
    )
    assert column[middle] == pytest.approx(1.0, abs=0.05)
    away = int(np.argmin(np.linalg.norm(vertices[:, :2] - (0.3 + RANGE_M, 0.3), axis=1)))
    assert column[away] / column[middle] == pytest.approx(0.14, abs=0.03)


def test_means_around_a_vertex_keep_a_constant() -> None:
    vertices, faces = _grid(61, 0.6)
    prior = OffsetPrior.build(vertices, faces)
    assert np.allclose(prior.share_around(np.ones(len(vertices))), 1.0, atol=1e-9)


def test_the_offsets_solve_their_normal_equations(model: BodyModel) -> None:
    rng = np.random.default_rng(5)
    chosen = rng.choice(model.vertex_count, 3000, replace=False)
    normals = vertex_normals(model.mean, model.faces)
    points = model.mean[chosen] + 0.003 * normals[chosen]
    places = attached(model, model.mean, points, chosen)
    weight = rng.uniform(1e5, 1e6, len(points))
    residual = 0.003 + 0.001 * rng.standard_normal(len(points))
    rows = OffsetRows(places, normals[chosen], residual, weight)
    prior = offset_prior(model)
    sigma_m = np.where(model.mean[:, 2] > 1.0, 0.004, 0.009)
    found = solved(model, prior, sigma_m, rows, np.zeros_like(model.mean), 1e-3)
    corners = model.faces[places.triangle]
    entries = (places.weights[:, :, None] * rows.direction[:, None, :]).ravel()
    columns = (3 * corners[:, :, None] + np.arange(3)).ravel()
    matrix = sp.csr_matrix((entries, (np.repeat(np.arange(len(points)), 9), columns)))
    matrix.resize(len(points), 3 * model.vertex_count)
    prior_part = sp.kron(_precision(prior, sigma_m), sp.identity(3))
    normal = (prior_part + matrix.T @ sp.diags(weight) @ matrix).tocsr()
    right = matrix.T @ (weight * residual)
    scale = 1.0 / np.sqrt(normal.diagonal())
    left = scale * (normal @ found.ravel() - right)
    assert np.linalg.norm(left) < 0.01 * np.linalg.norm(scale * right)
    on_points = np.einsum("ni,ni->n", rows.direction, places.of(found, model.faces))
    assert on_points.mean() == pytest.approx(0.003, abs=3e-4)


def test_a_hand_unlike_the_model_is_followed(model: BodyModel) -> None:
    """Fingers bent by 15 degrees from where the model has them: with the whole scan's prior half
    of the hand's error was left, 9 mm rms."""
    twists = np.zeros((model.part_count, 3))
    twists[model.part_names.index("fingers_right"), 0] = np.radians(15.0)
    neutral = model.neutral_state()
    body = model.vertices(replace(neutral, rotations=model.absolute_rotations(twists)))
    count = len(body)
    cloud = PointCloud(
        body,
        vertex_normals(body, model.faces),
        np.full(count, 1e-3),
        np.zeros(count, np.int16),
        ("front-upper",),
    )
    fitted = fit_surface(model, model.vertices(neutral), cloud, [], [])
    near = cKDTree(fitted.vertices).query(body)[1]
    places = attached(model, fitted.vertices, body, near).of(fitted.vertices, model.faces)
    away = np.linalg.norm(places - body, axis=1)
    hands = [model.part_names.index(f"{part}_right") for part in HAND]
    hand = np.isin(model.part_of_vertex, hands)
    assert np.sqrt(np.mean(away[hand] ** 2)) < 0.006
    assert np.sqrt(np.mean(away[~hand] ** 2)) < 0.0005


def test_skin_is_the_less_known_the_farther_it_is_from_readings(model: BodyModel) -> None:
    prior = offset_prior(model)
    seen = model.mean[:, 1] < 0.0
    rng = np.random.default_rng(7)
    mismatch = 0.003 * rng.standard_normal(model.vertex_count)
    sigma = surface_sigma(model, seen, mismatch, seen)
    away = prior.distance_m(seen)
    near, far = sigma[seen].mean(), sigma[away > 0.06].mean()
    assert 0.0005 < near < 0.5 * far < 0.002
    like = surface_sigma(model, seen, 0.4 * mismatch, seen)
    assert like[seen].mean() < 0.1 * near


def test_noisy_readings_are_no_mismatch(model: BodyModel) -> None:
    """Vertices are off by 1.7 mm by noise alone, and by 2.6 on bodies that the model lacks."""
    seen = np.ones(model.vertex_count, bool)
    away = np.random.default_rng(7).standard_normal(model.vertex_count)
    sigma = {
        (mismatch_m, noise_m): surface_sigma(model, seen, mismatch_m * away, seen, noise_m).mean()
        for mismatch_m in (1.7e-3, 2.6e-3)
        for noise_m in (0.0, 1.0e-3)
    }
    assert sigma[1.7e-3, 1.0e-3] < 0.5 * sigma[1.7e-3, 0.0]
    assert sigma[2.6e-3, 1.0e-3] > 0.8 * sigma[2.6e-3, 0.0]


def test_a_noisy_cloud_is_followed_less(model: BodyModel) -> None:
    """A body that is 2 mm thicker than the model, or seen through noise of as much."""
    normals = vertex_normals(model.mean, model.faces)
    rough = (
        model.mean + 0.002 * np.random.default_rng(7).standard_normal((len(normals), 1)) * normals
    )
    count = len(rough)
    cloud = PointCloud(rough, normals, np.full(count, 1e-3), np.zeros(count, np.int16), ("all",))
    usual = fit_surface(model, model.mean, cloud, (), ())
    noisy = fit_surface(model, model.mean, replace(cloud, excess_noise_m=4e-3), (), ())
    moved = [np.abs(found.vertices - model.mean).mean() for found in (usual, noisy)]
    assert moved[1] < 0.8 * moved[0]
    assert noisy.sigma_m.mean() < 0.8 * usual.sigma_m.mean()


def test_a_missing_limb_is_known_the_less_the_farther_it_reaches(model: BodyModel) -> None:
    seen = model.mean[:, 2] > 0.9
    sigma = surface_sigma(model, seen, np.full(model.vertex_count, 0.001), seen)
    assert sigma[model.mean[:, 2] < 0.1].min() > 0.005


def test_hair_hides_the_skin_below_the_top_as_well(model: BodyModel) -> None:
    """Chin and girths of the head were stated as if only the top were doubtful."""
    head = model.part_of_vertex == model.part_names.index("head")
    face = model.mean[:, 1] < np.median(model.mean[head, 1])
    seen = ~head | face
    sigma_m = hidden_head_sigma(model, seen, 0.011)
    assert not sigma_m[~head | seen].any()
    low = model.mean[:, 2] < model.mean[head, 2].max() - 0.1
    assert 1e-4 < sigma_m[head & ~seen & low].max() < 2.0 * 0.011
    assert not hidden_head_sigma(model, seen, 0.0).any()
