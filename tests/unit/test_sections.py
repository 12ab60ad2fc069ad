import numpy as np
import pytest

from station.drivers.virtual_scene import sphere
from workers.measure.definitions import DEFINITIONS
from workers.measure.sections import hull_loop, loop_length, section_points, surface_path
from workers.scape.model import load_model


def test_a_spheres_girth() -> None:
    ball = sphere((0.1, 0.2, 1.0), 0.1)
    points = section_points(
        ball.vertices, ball.faces, np.array([0.1, 0.2, 1.0]), np.array([0.6, 0.0, 0.8])
    )
    loop = hull_loop(points, np.array([0.6, 0.0, 0.8]))
    assert loop_length(loop, closed=True) == pytest.approx(2 * np.pi * 0.1, rel=0.01)


def test_a_tape_over_a_sphere() -> None:
    ball = sphere((0.0, 0.0, 0.0), 0.1)
    start, end = np.array([-0.06, 0.0, 0.08]), np.array([0.06, 0.0, 0.08])
    path = surface_path(ball.vertices, ball.faces, start, end, np.array([0.0, 0.0, 1.0]))
    assert loop_length(path, closed=False) == pytest.approx(0.1 * 2 * np.arcsin(0.6), rel=0.02)


def test_a_plane_beside_the_body_is_an_error() -> None:
    with pytest.raises(ValueError, match="does not cut"):
        hull_loop(np.empty((0, 3)), np.array([0.0, 0.0, 1.0]))


def test_the_table_names_only_what_the_model_has() -> None:
    model = load_model()
    assert len(DEFINITIONS) >= 30
    assert len({definition.name for definition in DEFINITIONS}) == len(DEFINITIONS)
    for definition in DEFINITIONS:
        assert set(definition.landmarks) <= set(model.landmarks)
        assert set(definition.parts) <= set(model.part_names)
