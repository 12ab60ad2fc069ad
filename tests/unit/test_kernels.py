"""Compiled loops do what a line of numpy says, and tracking finds what a search finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from station.simulation.scene import sphere
from workers.scape.evidence.correspondence import OrientedTree, TrackedPoints
from workers.scape.fit.initial import RoughPose, rotations_of, starting_states
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import (
    EdgeSolver,
    area_vectors,
    edges,
    neighbours,
    vertex_normals,
)
from workers.scape.model.halves import WORTH_A_THREAD, in_halves
from workers.scape.model.kernels import descend, interpolated, side_by_side, trimmed_costs
from workers.scape.model.sampled import SampledBody

LIMITS = {"max_distance_m": 0.03, "max_angle_rad": float(np.radians(50.0))}
BALL = sphere((0.1, 0.2, 1.0), 0.3)


def test_normals_are_sums_of_cross_products() -> None:
    a, b, c = (BALL.vertices[BALL.faces[:, i]] for i in range(3))
    expected = np.cross(b - a, c - a)
    assert np.allclose(area_vectors(BALL.vertices, BALL.faces), expected, atol=1e-15)
    summed = np.zeros_like(BALL.vertices)
    for corner in range(3):
        np.add.at(summed, BALL.faces[:, corner], expected)
    summed /= np.linalg.norm(summed, axis=1, keepdims=True)
    assert np.allclose(vertex_normals(BALL.vertices, BALL.faces), summed, atol=1e-12)


def test_triangles_without_their_vertices_are_an_error() -> None:
    with pytest.raises(IndexError, match="triangles name vertex"):
        vertex_normals(BALL.vertices[:-1], BALL.faces)


def test_a_surface_is_carried_by_its_turned_edges() -> None:
    rng = np.random.default_rng(0)
    matrices = rng.standard_normal((len(BALL.faces), 3, 3))
    solver = EdgeSolver.build(BALL.vertices, BALL.faces)
    surface = BALL.vertices + 0.01 * rng.standard_normal(BALL.vertices.shape)
    expected = solver.vertices(edges(surface, BALL.faces) @ np.swapaxes(matrices, 1, 2))
    assert np.allclose(solver.carried(surface, matrices), expected, atol=1e-10)


@pytest.mark.parametrize("size", [3, 6])
def test_trimmed_costs_are_trimmed_means_both_ways(size: int) -> None:
    rng = np.random.default_rng(size)
    tried = rng.uniform(0.0, 1.0, (4, size, 30)).astype(np.float32)
    cloud = rng.uniform(0.0, 1.0, (50, size)).astype(np.float32)
    found = trimmed_costs(tried, cloud, 0.2, 0.3, 0.5)
    for points, cost in zip(tried, found, strict=True):
        away = np.linalg.norm(cloud[:, None] - points.T[None], axis=2)
        there = np.minimum(away.min(axis=1), 0.2).mean()
        back = np.minimum(away.min(axis=0), 0.3).mean()
        assert cost == pytest.approx(there + 0.5 * back, rel=1e-5)


def test_downhill_ends_where_no_neighbour_is_nearer() -> None:
    rng = np.random.default_rng(2)
    graph = neighbours(BALL.faces)
    first, joined = graph
    normals = vertex_normals(BALL.vertices, BALL.faces)
    nodes = np.concatenate([BALL.vertices, 0.1 * normals], axis=1)
    points = nodes.mean(axis=0) + 0.4 * rng.standard_normal((300, 6))
    start = rng.integers(0, len(nodes), 300)
    found, _ = descend(points, nodes, *graph, start, np.inf, -np.inf)

    def away(index: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - nodes[index], axis=1)

    assert (away(found) <= away(start)).all()
    for point, vertex in zip(points, found, strict=True):
        around = nodes[joined[first[vertex] : first[vertex + 1]]]
        least = np.linalg.norm(point - nodes[vertex])
        assert (np.linalg.norm(around - point, axis=1) >= least - 1e-12).all()
    # A ball has no hollow in which to stop short.
    outside = nodes[start] + np.concatenate([0.01 * normals[start], np.zeros((300, 3))], axis=1)
    found, _ = descend(outside, nodes, *graph, rng.permutation(start), np.inf, -np.inf)
    assert np.array_equal(found, start)


def test_followers_are_held_to_the_limits_and_may_have_no_start() -> None:
    normals = vertex_normals(BALL.vertices, BALL.faces)
    nodes = np.concatenate([BALL.vertices, normals], axis=1)
    start = np.array([5, 5, 5, -1])
    points = nodes[[5, 5, 5, 5]]
    points[1, :3] += 0.011 * normals[5]
    points[2, 3:] *= -0.01
    found, kept = descend(points, nodes, *neighbours(BALL.faces), start, 0.01**2, 0.9)
    assert found[0] == 5
    assert found[3] == -1
    assert kept.tolist() == [True, False, False, False]


def _skin_points(
    model: BodyModel, vertices: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a body, 3 mm off it, in no order, and their normals."""
    rng = np.random.default_rng(3)
    size = np.linalg.norm(area_vectors(vertices, model.faces), axis=1)
    corners = model.faces[rng.choice(len(size), count, p=size / size.sum())]
    weight = rng.dirichlet((1.0, 1.0, 1.0), count)
    normals = vertex_normals(vertices, model.faces)[corners]
    direction = np.einsum("nc,nci->ni", weight, normals)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.einsum("nc,nci->ni", weight, vertices[corners]) + 0.003 * direction, direction


@pytest.mark.parametrize("dense", [False, True])
def test_tracking_finds_what_a_search_finds(model: BodyModel, dense: bool) -> None:
    """At once, and after the surface has moved a little; far points find nothing."""
    normals = vertex_normals(model.mean, model.faces)
    points, directions = _skin_points(model, model.mean, 6000)
    points[:10] += 0.5
    tracked = TrackedPoints(model.neighbours, points, directions, dense=dense)
    for shift_m in (0.0, 0.003):
        moved = model.mean + np.array([shift_m, -shift_m, 0.0])
        used, vertex = tracked.pairs(moved, normals, **LIMITS)
        asked, nearest = OrientedTree.build(moved, normals).pairs(points, directions, **LIMITS)
        assert used.min() >= 10
        assert abs(len(used) - len(asked)) < 0.005 * len(asked)
        _, mine, theirs = np.intersect1d(used, asked, return_indices=True)
        same = vertex[mine] == nearest[theirs]
        # A fold can hold back who comes from beside it: lips, ears, toes, fingers.
        assert same.all() if shift_m == 0.0 and not dense else same.mean() > 0.97


def test_points_misled_by_the_coarse_search_are_matched(model: BodyModel) -> None:
    """One point of four is searched for; what cannot be reached from it is matched individually."""
    normals = vertex_normals(model.mean, model.faces)
    points, directions = _skin_points(model, model.mean, 400)
    points[::4] += 0.5
    used, _ = TrackedPoints(model.neighbours, points, directions, dense=True).pairs(
        model.mean, normals, **LIMITS
    )
    asked, _ = OrientedTree.build(model.mean, normals).pairs(points, directions, **LIMITS)
    assert np.array_equal(used, asked)


@pytest.mark.parametrize("dense", [False, True])
def test_no_points_have_no_pairs(dense: bool) -> None:
    normals = vertex_normals(BALL.vertices, BALL.faces)
    tracked = TrackedPoints(neighbours(BALL.faces), np.empty((0, 3)), np.empty((0, 3)), dense=dense)
    for _ in range(2):
        used, vertex = tracked.pairs(BALL.vertices, normals, **LIMITS)
        assert len(used) == len(vertex) == 0


def test_positions_alone_are_those_of_the_derivative(model: BodyModel) -> None:
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, 211))
    rng = np.random.default_rng(4)
    beta = rng.standard_normal(model.beta_count)
    beta[40:] = 0.0
    twists = 0.2 * rng.standard_normal((model.part_count, 3))
    state = replace(model.neutral_state(), rotations=model.absolute_rotations(twists), beta=beta)
    for shapes in (None, 6, 40):
        positions, derivative = samples.jacobian(state, shapes)
        assert derivative.shape[2] == 3 * model.part_count + (shapes or model.beta_count) + 3
        assert np.allclose(positions, samples.evaluate(state), atol=2e-6)


def _standing(model: BodyModel, pose: RoughPose) -> NDArray[np.float64]:
    """Mean body (P, 3) in a pose, with its soles on the floor."""
    rotations = rotations_of(model, [pose])[0]
    vertices = model.vertices(replace(model.neutral_state(), rotations=rotations))
    return vertices - (0.0, 0.0, vertices[:, 2].min())


@pytest.mark.parametrize(
    ("arms_deg", "heading_deg"),
    [((12.0, 12.0), 0.0), ((84.0, 84.0), 0.0), ((20.0, 75.0), -12.0)],
)
def test_the_start_has_the_arms_where_the_cloud_has_them(
    model: BodyModel, arms_deg: tuple[float, float], heading_deg: float
) -> None:
    vertices = _standing(model, (arms_deg, (0.0, 0.0), heading_deg))
    scout = SampledBody.build(model, np.arange(0, model.vertex_count, 53))
    cloud, _ = _skin_points(model, vertices, 800)
    best = model.vertices(starting_states(model, scout, cloud, cloud)[0])
    for side in ("left", "right"):
        hand = model.part_of_vertex == model.part_names.index(f"hand_{side}")
        assert np.linalg.norm((best - vertices)[hand].mean(axis=0)) < 0.2


def test_a_start_faces_the_other_way_for_toes_that_show_the_wrong_way(model: BodyModel) -> None:
    """A body half a metre off the mark, of whose feet little was seen, was fitted from behind."""
    vertices = _standing(model, ((20.0, 75.0), (0.0, 0.0), 10.0))
    scout = SampledBody.build(model, np.arange(0, model.vertex_count, 53))
    cloud, _ = _skin_points(model, vertices, 800)
    toes_behind = cloud * (1.0, -1.0, 1.0)
    best = model.vertices(starting_states(model, scout, cloud, toes_behind)[1])
    for side in ("left", "right"):
        hand = model.part_of_vertex == model.part_names.index(f"hand_{side}")
        assert np.linalg.norm((best - vertices)[hand].mean(axis=0)) < 0.3


@pytest.mark.parametrize("count", [0, 7, WORTH_A_THREAD, 2 * WORTH_A_THREAD + 1])
def test_halves_give_each_item_once_and_in_order(count: int) -> None:
    items = np.arange(count)
    same, twice = in_halves(lambda part: (items[part], 2 * items[part]), count)
    assert np.array_equal(same, items)
    assert np.array_equal(twice, 2 * items)


def test_places_are_interpolated_and_directions_scaled() -> None:
    rng = np.random.default_rng(1)
    triangle, weights = rng.integers(0, len(BALL.faces), 50), rng.random((50, 3))
    found = interpolated(BALL.vertices, BALL.faces, triangle, weights)
    corners = BALL.vertices[BALL.faces[triangle]]
    assert np.allclose(found, np.einsum("nc,nci->ni", weights, corners), rtol=1e-14)
    joined = side_by_side(found, weights, 0.04)
    assert np.array_equal(joined, np.concatenate([found, 0.04 * weights], axis=1))
