"""Derivatives, paths and covariances that the calibration's solution rests upon."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from station.calibration.adjust.ball_shape import SHAPE, shape_terms, shape_turn
from station.calibration.adjust.equations import ROUNDNESS, TREMOR_M, BallEquations
from station.calibration.adjust.sensor_model import BALL, FIELD, FULL, LENS, POLYNOMIAL
from station.calibration.adjust.trajectory import KNOT_S, TimeGrid, path_points
from station.calibration.detect.ball_image import ball_inverse_depth
from station.calibration.solve.pairwise import Track, estimate_pair
from station.calibration.solve.world import WorldPoses, relative_poses
from station.core.geometry import invert, se3_exp, transform, twist_between
from station.core.lens import pixel_rays
from station.simulation.scene import default_rig

SEEDS = st.integers(0, 10_000)


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_a_balls_inverse_depth_and_its_derivative(seed: int) -> None:
    rng = np.random.default_rng(seed)
    center = np.array([[*rng.uniform(-0.4, 0.4, 2), rng.uniform(0.8, 3.0)]])
    ray = (center[:, None, :2] + rng.uniform(-0.05, 0.05, (1, 9, 2))) / center[:, None, 2:]
    w, gradient = ball_inverse_depth(center, ray, 0.1)
    points = np.concatenate([ray, np.ones((1, 9, 1))], axis=-1) / w[..., None]
    assert np.allclose(np.linalg.norm(points - center[:, None], axis=-1), 0.1, atol=1e-9)
    assert (points[..., 2] < center[0, 2]).all()
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        ends = [ball_inverse_depth(center + s * step, ray, 0.1)[0] for s in (1.0, -1.0)]
        assert np.allclose((ends[0] - ends[1]) / 2e-6, gradient[..., axis], rtol=1e-4, atol=1e-4)


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_nuisance_of_a_detection_widens_its_covariance_and_moves_nothing(seed: int) -> None:
    """A tremor of the hand and a ball that is not quite round must not pull the centre."""
    rng = np.random.default_rng(seed)
    size = 4 + SHAPE
    rows = rng.normal(0, 1e3, (2, 20, size))
    matrix, gradient = np.swapaxes(rows, 1, 2) @ rows, rng.normal(0, 1e3, (2, size))
    firm = BallEquations(matrix, gradient, np.zeros((2, size, 0)), np.zeros((0, 0)), np.zeros(0))
    loose = firm.marginalised(0.1, np.ones(2))
    before, after = (np.linalg.inv(balls.matrix) for balls in (firm, loose))
    prior = np.diag([TREMOR_M**2] * 3 + [(0.1 * ROUNDNESS) ** 2] + [0.0] * SHAPE)
    assert np.allclose(after, before + prior, rtol=1e-6)
    best, still = (
        np.linalg.solve(balls.matrix, balls.gradient[..., None]) for balls in (firm, loose)
    )
    assert np.allclose(best, still, rtol=1e-6)


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_the_shape_of_a_ball_turns_with_its_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, shape = se3_exp(rng.normal(0, 1, 6))[:3, :3], rng.normal(0, 1, SHAPE)
    normals = rng.normal(0, 1, (7, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.allclose(
        shape_terms(normals @ turn.T) @ (shape_turn(turn) @ shape), shape_terms(normals) @ shape
    )


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_the_correction_is_the_one_that_was_solved_for(seed: int) -> None:
    """Polynomial, gradient and field act on whole images as they did on single patches."""
    rng = np.random.default_rng(seed)
    parameters = np.concatenate(
        [
            rng.normal(0, [5e-3, 1e-3, 3e-3, 2e-3, 2e-3, 1.0]),
            np.zeros(LENS + BALL),
            rng.normal(0, 1e-3, FIELD),
        ]
    )
    depth = rng.uniform(0.8, 3.0, (6, 8))
    y, x = np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-1, 1, 8), indexing="ij")
    place = np.stack([x.ravel(), y.ravel()], axis=-1)
    inverse = 1.0 / depth.ravel()
    expected = inverse + FULL.change(parameters, inverse, place)
    correction = FULL.correction(parameters)
    assert np.allclose(1.0 / correction.apply(depth).ravel(), expected, atol=1e-6)
    assert np.allclose(correction.inverse_at(inverse, *place.T), expected, atol=1e-9)


@given(SEEDS)
@settings(max_examples=10, deadline=None)
def test_rays_change_with_the_lens_as_the_solution_assumes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = default_rig().cameras["front-upper"]
    pixels = rng.uniform((20, 20), (620, 460), (7, 2))
    parameters = np.zeros(FULL.size)
    parameters[POLYNOMIAL : POLYNOMIAL + LENS] = rng.normal(0, [1e-3, 1.0, 1.0, 0.005])
    moved = FULL.camera(camera, parameters)
    design = FULL.lens_design(camera, pixel_rays(camera, pixels))
    expected = design @ parameters[POLYNOMIAL : POLYNOMIAL + LENS]
    change = pixel_rays(moved, pixels) - pixel_rays(camera, pixels)
    assert np.allclose(change, expected, atol=2e-4)


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_a_path_follows_a_motion_and_bridges_gaps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, 4.0, 120))
    times = times[(times < 1.5) | (times > 1.9)]
    motion = rng.normal(0, [[0.3], [0.2], [0.05]], (3, 3))
    points = np.vander(times, 3, increasing=True) @ motion
    grid = TimeGrid.over(times)
    controls = grid.fit(times, points, np.full(len(times), 1e6))
    ask = np.linspace(0.2, 3.8, 50)
    first, value, rate = grid.basis(ask)
    away = np.abs(path_points(controls, first, value) - np.vander(ask, 3, increasing=True) @ motion)
    gap = (ask > 1.4) & (ask < 2.0)
    assert away[~gap].max() < 2e-3
    assert away[gap].max() < 1e-2
    later = path_points(controls, *grid.basis(ask + 1e-5)[:2])
    assert np.allclose(
        (later - path_points(controls, first, value)) / 1e-5,
        path_points(controls, first, rate),
        atol=1e-3,
    )
    assert grid.count >= 4.0 / KNOT_S - 4


@given(SEEDS)
@settings(max_examples=8, deadline=None)
def test_two_cameras_are_related_in_spite_of_false_detections(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a_from_b = se3_exp(np.concatenate([rng.uniform(-2, 2, 3), rng.uniform(-2, 2, 3)]))
    times = np.arange(0.0, 20.0, 0.1)
    path = np.stack([np.sin(0.7 * times), np.cos(0.9 * times), np.sin(0.4 * times)], axis=1)
    wrong = rng.random(len(times)) < 0.2
    in_b = transform(invert(a_from_b), path) + rng.normal(0, 2e-3, path.shape)
    in_b[wrong] += rng.normal(0, 0.5, (wrong.sum(), 3))
    pair = estimate_pair(Track(times, path), Track(times, in_b))
    assert pair is not None
    assert np.linalg.norm(twist_between(a_from_b, pair.a_from_b)[3:]) < 5e-3
    assert pair.agree[wrong].mean() < 0.2


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_covariances_between_cameras_are_carried_by_their_geometry(seed: int) -> None:
    """The covariance of a relative pose against small errors put into both poses."""
    rng = np.random.default_rng(seed)
    poses = {name: se3_exp(rng.uniform(-1.5, 1.5, 6)) for name in "abc"}
    root = rng.normal(0, 1e-4, (18, 18))
    world_poses = WorldPoses(poses, root @ root.T, 0.1, 0.0)
    found, covariance = relative_poses(world_poses, "b", ["a", "c"])
    columns = []
    for column in root.T:
        moved = {
            name: pose @ se3_exp(column[6 * i : 6 * i + 6])
            for i, (name, pose) in enumerate(poses.items())
        }
        columns.append(
            np.concatenate(
                [
                    twist_between(pose, invert(moved["b"]) @ moved[name])
                    for name, pose in zip("ac", found, strict=True)
                ]
            )
        )
    expected = np.array(columns).T @ np.array(columns)
    assert np.allclose(covariance, expected, rtol=0.02, atol=0.02 * np.abs(expected).max())
