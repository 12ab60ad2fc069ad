import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.core import geometry

_components = st.floats(-1.0, 1.0, allow_nan=False)
_vectors = st.tuples(_components, _components, _components).map(np.array)


@given(axis=_vectors, angle=st.floats(0.0, np.pi - 1e-7))
def test_log_inverts_exp_up_to_half_a_turn(axis: np.ndarray, angle: float) -> None:
    """The trace formula loses all digits near pi, where a person has simply turned around."""
    length = np.linalg.norm(axis)
    if length < 1e-3:
        return
    vector = axis / length * angle
    assert np.allclose(geometry.so3_log(geometry.so3_exp(vector)), vector, atol=1e-7)


@given(vector=_vectors, point=_vectors)
def test_exp_turns_about_its_axis(vector: np.ndarray, point: np.ndarray) -> None:
    rotation = geometry.so3_exp(vector)
    assert np.allclose(rotation @ vector, vector)
    assert np.isclose(np.linalg.norm(rotation @ point), np.linalg.norm(point))


def test_half_a_turn() -> None:
    rotation = np.diag([-1.0, -1.0, 1.0])
    assert np.allclose(np.abs(geometry.so3_log(rotation)), [0.0, 0.0, np.pi])


def test_small_rotations_keep_their_digits() -> None:
    vector = np.array([1e-9, -2e-9, 3e-9])
    assert np.allclose(geometry.so3_log(geometry.so3_exp(vector)), vector, rtol=1e-6, atol=0.0)


def test_skew_is_the_cross_product() -> None:
    a, b = np.array([1.0, 2.0, 3.0]), np.array([-0.5, 0.25, 4.0])
    assert np.allclose(geometry.skew(a) @ b, np.cross(a, b))


def test_invert_undoes_a_transform() -> None:
    world_from_camera = geometry.se3_exp([0.3, -0.2, 1.1, 0.5, -1.0, 2.0])
    points = np.random.default_rng(1).normal(size=(20, 3))
    there = geometry.transform(world_from_camera, points)
    assert np.allclose(geometry.transform(geometry.invert(world_from_camera), there), points)
    assert np.allclose(
        geometry.rotate(world_from_camera, points),
        there - world_from_camera[:3, 3],
    )


@pytest.mark.parametrize("weighted", [False, True])
def test_rigid_fit_finds_the_transform(weighted: bool) -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(30, 3))
    expected = geometry.se3_exp([2.0, -1.0, 0.4, 1.0, 2.0, 3.0])
    target = geometry.transform(expected, source)
    weights = None
    if weighted:
        weights = rng.uniform(0.5, 1.0, 30)
        target[0] += 5.0
        weights[0] = 0.0
    assert np.allclose(geometry.rigid_fit(target, source, weights), expected)


def test_rigid_fit_never_mirrors() -> None:
    """Points in a plane fit a reflection as well as a rotation; a camera is never mirrored."""
    source = np.random.default_rng(3).normal(size=(10, 3)) * (1.0, 1.0, 0.0)
    found = geometry.rigid_fit(source * (-1.0, 1.0, 1.0), source)
    assert np.isclose(np.linalg.det(found[:3, :3]), 1.0)
