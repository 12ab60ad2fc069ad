import numpy as np
import pytest
from scipy.spatial import ConvexHull

from station.simulation.scene import sphere
from workers.measure.sections import (
    EdgeNet,
    EdgePoints,
    hull_order,
    loop_length,
    plane_axes,
    surface_order,
)
from workers.scape.model.deformation import signed_volume

TILTED = np.array([0.6, 0.0, 0.8])
UP = np.array([0.0, 0.0, 1.0])


def test_a_spheres_girth() -> None:
    center = np.array([0.1, 0.2, 1.0])
    ball = sphere(tuple(center), 0.1)
    net = EdgeNet.build(ball.faces)
    found, crossing = net.cut(ball.vertices, center, TILTED)
    piece = net.pieces(crossing)
    points = found.on(ball.vertices)
    assert np.abs((points - center) @ TILTED).max() < 1e-12
    assert len(np.unique(piece)) == 1
    tape = points[hull_order(points, TILTED)]
    assert loop_length(tape, closed=True) == pytest.approx(2 * np.pi * 0.1, rel=0.01)


def test_two_legs_are_two_pieces() -> None:
    """A thigh's girth once took the other thigh in, where both came near each other."""
    left, right = sphere((-0.1, 0.0, 0.0), 0.099), sphere((0.1, 0.0, 0.0), 0.099)
    vertices = np.concatenate([left.vertices, right.vertices])
    faces = np.concatenate([left.faces, right.faces + len(left.vertices)]).astype(np.int32)
    net = EdgeNet.build(faces)
    found, crossing = net.cut(vertices, np.zeros(3), UP)
    piece = net.pieces(crossing)
    x = found.on(vertices)[:, 0]
    assert len(np.unique(piece)) == 2
    assert len(np.unique(piece[x < 0])) == len(np.unique(piece[x > 0])) == 1


def test_a_tape_spans_hollows() -> None:
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    radius = 0.1 - 0.03 * np.exp(-(((angle - np.pi) / 0.3) ** 2))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    tape = points[hull_order(points, UP)]
    assert loop_length(tape, closed=True) < loop_length(points, closed=True) - 0.005
    assert loop_length(tape, closed=True) == pytest.approx(2 * np.pi * 0.1, rel=0.02)


@pytest.mark.parametrize("digits", [1, 9])
def test_a_tape_is_as_long_as_the_convex_hull(digits: int) -> None:
    """Many points on one line or in one place, as a mesh's sections have them, change nothing."""
    rng = np.random.default_rng(digits)
    for count in range(4, 60):
        points = np.zeros((count, 3))
        points[:, :2] = rng.standard_normal((count, 2)).round(digits)
        tape = points[hull_order(points, UP)]
        assert loop_length(tape, closed=True) == pytest.approx(ConvexHull(points[:, :2]).area)


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.ones((5, 3)), np.arange(12.0).reshape(4, 3)]
)
def test_a_tape_around_nothing_is_refused(points: np.ndarray) -> None:
    with pytest.raises(ValueError, match="does not cut"):
        hull_order(points, UP)


def test_a_tape_over_a_sphere() -> None:
    ball = sphere((0.0, 0.0, 0.0), 0.1)
    start, end = np.array([-0.06, 0.0, 0.08]), np.array([0.06, 0.0, 0.08])
    net = EdgeNet.build(ball.faces)
    found, crossing = net.cut(ball.vertices, start, np.array([0.0, 1.0, 0.0]))
    points = found.on(ball.vertices)
    order = surface_order(points, net.segments(crossing), (start, end), UP, taut=True, bulge=0.45)
    path = np.concatenate([start[None], points[order], end[None]])
    assert loop_length(path, closed=False) == pytest.approx(0.1 * 2 * np.arcsin(0.6), rel=0.02)


def test_skin_follows_a_hollow_that_a_tape_spans() -> None:
    x = np.linspace(0.01, 0.29, 60)
    points = np.stack([x, 0 * x, 0.012 * np.cos(2 * np.pi * x / 0.15)], axis=1)
    ends = np.array([0.0, 0.0, 0.012]), np.array([0.3, 0.0, 0.012])
    links = np.arange(59), np.arange(1, 60)
    tape = surface_order(points, links, ends, UP, taut=True, bulge=0.45)
    skin = surface_order(points, links, ends, UP, taut=False, bulge=0.45)
    assert len(skin) == 60
    assert len(tape) < 3


def test_skin_that_folds_back_is_followed_on_its_outside() -> None:
    """A roll of skin hangs over the next: the line passes outside and never goes back."""
    x = np.array([0.05, 0.15, 0.14, 0.10, 0.11, 0.20, 0.25])
    y = np.array([0.01, 0.03, 0.02, 0.01, 0.00, 0.01, 0.00])
    points = np.stack([x, 0 * x, y], axis=1)
    links = np.arange(6), np.arange(1, 7)
    ends = np.zeros(3), np.array([0.3, 0.0, 0.0])
    skin = surface_order(points, links, ends, UP, taut=False, bulge=0.45)
    assert skin.tolist() == [0, 1, 5, 6]


def test_skin_that_bulges_too_far_is_another_part() -> None:
    points = np.array([[0.1, 0.0, 0.01], [0.15, 0.0, 0.05], [0.2, 0.0, 0.01]])
    links = np.arange(2), np.arange(1, 3)
    ends = np.zeros(3), np.array([0.3, 0.0, 0.0])
    assert len(surface_order(points, links, ends, UP, taut=True, bulge=0.45)) == 1
    assert len(surface_order(points, links, ends, UP, taut=True, bulge=0.12)) == 2


def test_a_point_on_an_edge_goes_with_the_mesh() -> None:
    found = EdgePoints(np.array([0]), np.array([1]), np.array([0.25]))
    moved = np.array([[0.0, 0.0, 1.0], [0.0, 0.4, 1.0]])
    assert found.on(moved).tolist() == [[0.0, 0.1, 1.0]]


def test_a_plane_beside_the_body_is_an_error() -> None:
    with pytest.raises(ValueError, match="does not cut"):
        hull_order(np.empty((0, 3)), UP)


def test_axes_of_a_plane_are_square_to_it() -> None:
    for along in (None, np.array([1.0, 2.0, 3.0])):
        x, y = plane_axes(TILTED, along)
        np.testing.assert_allclose(np.array([x, y, TILTED]) @ np.array([x, y, TILTED]).T, np.eye(3),
                                   atol=1e-12)  # fmt: skip


def test_a_spheres_volume() -> None:
    ball = sphere((0.3, -0.2, 1.0), 0.1)
    assert signed_volume(ball.vertices, ball.faces) == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.02)
