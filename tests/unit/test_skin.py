import numpy as np

from workers.scape.learn.skin import outer_skin, separated
from workers.scape.model.body_model import load_model
from workers.scape.model.deformation import signed_volume
from workers.scape.surface.crossings import crossing_pairs


def _turned(profile: np.ndarray, around: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface of revolution about z from (radius, z) pairs with poles at both ends."""
    angles = 2.0 * np.pi * np.arange(around) / around
    rings = [
        np.stack([r * np.cos(angles), r * np.sin(angles), np.full(around, z)], axis=1)
        for r, z in profile[1:-1]
    ]
    vertices = np.concatenate([[(0.0, 0.0, profile[0, 1])], *rings, [(0.0, 0.0, profile[-1, 1])]])
    faces = []
    last = len(vertices) - 1
    for k in range(around):
        n = (k + 1) % around
        faces.append((0, 1 + n, 1 + k))
        for ring in range(len(rings) - 1):
            a, b = 1 + ring * around, 1 + (ring + 1) * around
            faces += [(a + k, a + n, b + n), (a + k, b + n, b + k)]
        top = 1 + (len(rings) - 1) * around
        faces.append((top + k, top + n, last))
    return vertices, np.array(faces, np.int32)


def _is_closed(faces: np.ndarray) -> bool:
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def test_a_cavity_behind_a_narrow_mouth_is_cut_off_and_closed() -> None:
    """A ball with a hull inside, joined through a hole at the top, as lips join face and mouth."""
    outside = np.linspace(-np.pi / 2, np.radians(86), 30)
    inside = np.linspace(np.radians(84), -np.pi / 2, 20)
    profile = np.concatenate(
        [
            np.stack([np.cos(outside), np.sin(outside)], axis=1),
            0.6 * np.stack([np.cos(inside), np.sin(inside)], axis=1),
        ]
    )
    vertices, faces = _turned(profile, 24)
    mirror = np.linalg.norm(vertices[:, None] - vertices * (-1.0, 1.0, 1.0), axis=2).argmin(axis=0)
    assert _is_closed(faces)
    kept, skin = outer_skin(vertices, faces, mirror.astype(np.int32))
    assert _is_closed(skin)
    assert np.linalg.norm(vertices[kept], axis=1).min() > 0.9
    assert abs(signed_volume(vertices[kept], skin) - 4.0 / 3.0 * np.pi) < 0.1


def test_what_runs_through_itself_is_drawn_apart() -> None:
    """Two toes that overlap by a quarter of a millimetre."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 16)
    profile = 0.01 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    toe, faces = _turned(profile, 24)
    both = np.concatenate([toe - (0.009875, 0.0, 0.0), toe * (-1, 1, 1) + (0.009875, 0.0, 0.0)])
    both_faces = np.concatenate([faces, faces[:, ::-1] + len(toe)])
    mirror = np.roll(np.arange(2 * len(toe)), len(toe)).astype(np.int32)
    assert len(crossing_pairs(both, both_faces))
    apart = separated(both, both_faces, mirror)
    assert not len(crossing_pairs(apart, both_faces))
    assert np.abs(apart - both).max() < 6e-4
    assert np.allclose(apart[mirror] * (-1, 1, 1), apart)


def test_the_template_is_one_closed_skin() -> None:
    model = load_model()
    assert _is_closed(model.faces)
    edges = 3 * len(model.faces) // 2
    assert model.vertex_count - edges + len(model.faces) == 2
    assert 0.04 < signed_volume(model.mean, model.faces) < 0.15
    assert not len(crossing_pairs(model.mean, model.faces))
    assert np.array_equal(model.symmetry[model.symmetry], np.arange(model.vertex_count))
    mirrored = model.mean[model.symmetry] * (-1.0, 1.0, 1.0)
    assert np.abs(mirrored - model.mean).max() < 1e-4
