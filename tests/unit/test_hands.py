"""The search for hands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from workers.scape.evidence.correspondence import OrientedTree
from workers.scape.fit.hands import hands_of, place_hands
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import vertex_normals


def _with_fingers(model: BodyModel, curl_sd: float, turn_sd: float) -> BodyState:
    """Both hands closed and turned by so many standard deviations of the training poses."""
    state = model.neutral_state()
    twists = np.zeros((model.part_count, 3))
    for hand in hands_of(model):
        for part, amount in (("hand", turn_sd), ("fingers", curl_sd)):
            index = model.part_names.index(f"{part}_{hand.side}")
            rows = slice(3 * (index - 1), 3 * index)
            values, vectors = np.linalg.eigh(model.twist_covariance[rows, rows])
            axis = vectors[:, -1] * np.sign(vectors[:, -1] @ model.twist_mean[rows] + 1e-9)
            twists[index] = model.twist_mean[rows] + amount * np.sqrt(values[-1]) * axis
    return replace(state, rotations=model.absolute_rotations(twists))


def _found(model: BodyModel, truth: BodyState) -> tuple[float, float]:
    """Errors of half-closed fingers before and after the search, rms in metres."""
    vertices = model.vertices(truth)
    cloud = OrientedTree.build(vertices, vertex_normals(vertices, model.faces))
    start = _with_fingers(model, 0.6, 0.0)
    body = model.vertices(start)
    found = place_hands(
        model, hands_of(model), cloud, start, body, vertex_normals(body, model.faces)
    )
    fingers = np.isin(
        model.part_of_vertex, [model.part_names.index(f"fingers_{s}") for s in ("left", "right")]
    )
    away = (
        np.linalg.norm(model.vertices(state) - vertices, axis=1)[fingers]
        for state in (start, found)
    )
    before, after = (float(np.sqrt(np.mean(one**2))) for one in away)
    return before, after


@pytest.mark.parametrize(("curl_sd", "turn_sd"), [(-0.8, 1.0), (1.5, -1.0), (-0.5, 0.0)])
def test_an_open_hand_is_not_taken_for_a_fist(
    model: BodyModel, curl_sd: float, turn_sd: float
) -> None:
    """One hand in three was lost: its open fingers were met by curled ones and never let go."""
    before, after = _found(model, _with_fingers(model, curl_sd, turn_sd))
    assert before > 0.02
    assert after < 0.009


@pytest.mark.parametrize("curl_sd", [3.0, 3.5])
def test_a_fist_is_not_taken_for_an_open_hand(model: BodyModel, curl_sd: float) -> None:
    """No training pose closes the fingers so far."""
    before, after = _found(model, _with_fingers(model, curl_sd, 0.0))
    assert before > 0.03
    assert after < 0.009


def test_a_hand_that_nobody_saw_stays_as_it_is(model: BodyModel) -> None:
    state = _with_fingers(model, 0.6, 0.0)
    vertices = model.vertices(state)
    normals = vertex_normals(vertices, model.faces)
    trunk = model.part_of_vertex < 3
    cloud = OrientedTree.build(vertices[trunk], normals[trunk])
    found = place_hands(model, hands_of(model), cloud, state, vertices, normals)
    assert np.array_equal(found.rotations, state.rotations)
