import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from station.core.errors import FormatError
from station.core.geometry import so3_exp
from workers.scape.model.body_model import SHIPPED, BodyModel, BodyState, load_model, save_model
from workers.scape.model.sampled import SampledBody


def _some_state(model: BodyModel) -> BodyState:
    rng = np.random.default_rng(0)
    twists = 0.15 * rng.standard_normal((model.part_count, 3))
    return BodyState(
        model.absolute_rotations(twists),
        rng.standard_normal(model.beta_count),
        np.array([0.1, -0.2, 0.9]),
    )


def test_the_neutral_state_is_the_mean_body(model: BodyModel) -> None:
    assert np.abs(model.vertices(model.neutral_state()) - model.mean).max() < 1e-6


def test_samples_agree_with_the_whole_body(model: BodyModel) -> None:
    state = _some_state(model)
    chosen = np.arange(0, model.vertex_count, 211)
    found = SampledBody.build(model, chosen).evaluate(state)
    away = np.abs(found - model.vertices(state)[chosen])
    assert away.max() < 1e-3
    assert np.sqrt(np.mean(away**2)) < 1e-4


def test_the_jacobian_is_the_derivative(model: BodyModel) -> None:
    state = _some_state(model)
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, 211))
    before, derivative = samples.jacobian(state)
    delta = np.full(derivative.shape[2], 1e-4)
    delta *= np.random.default_rng(1).standard_normal(len(delta))
    parts = 3 * model.part_count
    moved = BodyState(
        so3_exp(delta[:parts].reshape(-1, 3)) @ state.rotations,
        state.beta + delta[parts:-3],
        state.translation + delta[-3:],
    )
    change = model.vertices(moved)[samples.indices] - model.vertices(state)[samples.indices]
    assert np.abs(change - derivative @ delta).max() < 0.06 * np.abs(change).max()
    assert np.allclose(before, samples.evaluate(state), atol=1e-5)


def test_projection_finds_a_body_of_the_model(model: BodyModel) -> None:
    state = _some_state(model)
    body = model.vertices(state)
    again = model.vertices(model.project(body, iterations=12))
    assert np.sqrt(np.mean(np.sum((again - body) ** 2, axis=1))) < 0.006


def test_a_surface_survives_reposing(model: BodyModel) -> None:
    state, other = _some_state(model), model.neutral_state()
    state = replace(state, translation=model.anchor @ model.vertices(state))
    body = model.vertices(state)
    there = model.repose(body, state, replace(other, beta=state.beta))
    back = model.repose(there, replace(other, beta=state.beta), state)
    assert np.abs(back - body).max() < 2e-3
    assert np.abs(model.repose(body, state, state) - body).max() < 1e-6


def test_twists_and_rotations_are_inverse(model: BodyModel) -> None:
    rotations = _some_state(model).rotations
    assert np.allclose(model.absolute_rotations(model.relative_twists(rotations)), rotations)


def test_landmarks_lie_where_their_names_say(model: BodyModel) -> None:
    at = {name: model.mean[vertex] for name, vertex in model.landmarks.items()}
    assert at["crown"][2] > 0.99 * model.mean[:, 2].max()
    assert at["heel_left"][1] > at["toe_left"][1] + 0.2
    assert at["acromion_left"][0] > 0.12 > -0.12 > at["acromion_right"][0]
    assert at["crotch"][2] < at["waist_front"][2] < at["suprasternale"][2] < at["chin"][2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:5000], "torn or not a body model"),
        (lambda data: b"hello", "torn or not a body model"),  # noqa: ARG005
    ],
)
def test_a_torn_model_is_named(tmp_path: Path, change: object, words: str) -> None:
    shipped = Path(__file__).parents[2] / "workers/scape/model" / SHIPPED
    path = tmp_path / "model.npz"
    assert callable(change)
    path.write_bytes(change(shipped.read_bytes()))
    with pytest.raises(FormatError, match=words):
        load_model(path)


def test_other_versions_and_formats_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    save_model(path, {}, {"version": 7})
    with pytest.raises(FormatError, match="version 7; this program reads 1"):
        load_model(path)
    save_model(path, {}, {"format": "other"})
    with pytest.raises(FormatError, match="is not a booth-body-model"):
        load_model(path)
    save_model(path, {}, {})
    with pytest.raises(FormatError, match="not a complete body model"):
        load_model(path)
    with pytest.raises(FormatError, match="reconstruct train"):
        load_model(tmp_path / "nothing.npz")


def test_a_pickle_is_never_opened(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    buffer = io.BytesIO()
    np.savez(buffer, metadata=np.array(json.dumps({})), evil=np.array([{}], dtype=object))
    path.write_bytes(buffer.getvalue())
    with pytest.raises(FormatError):
        load_model(path)
