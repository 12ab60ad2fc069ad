from dataclasses import replace
from pathlib import Path

import numpy as np

from workers.scape.fit.sampling import Sampling
from workers.scape.learn.projection import PROJECTION_STRIDE, best_fit
from workers.scape.learn.registration import distances, register
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.sampled import SampledBody

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def _some_state(model: BodyModel) -> BodyState:
    rng = np.random.default_rng(3)
    twists = 0.12 * rng.standard_normal((model.part_count, 3))
    return BodyState(
        model.absolute_rotations(twists), rng.standard_normal(model.beta_count), np.zeros(3)
    )


def test_the_best_fit_finds_a_body_of_the_model(model: BodyModel) -> None:
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, PROJECTION_STRIDE))
    body = model.vertices(_some_state(model))
    found = model.vertices(best_fit(model, samples, body))
    assert np.sqrt(np.mean(np.sum((found - body) ** 2, axis=1))) < 3e-4


def test_fewer_components_fit_worse_and_leave_the_others_at_rest(model: BodyModel) -> None:
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, PROJECTION_STRIDE))
    body = model.vertices(_some_state(model))
    errors = []
    for components in (10, 40, model.beta_count):
        state = best_fit(model, samples, body, components=components)
        assert not state.beta[components:].any()
        errors.append(np.sqrt(np.mean(np.sum((model.vertices(state) - body) ** 2, axis=1))))
    assert errors[0] > errors[1] > errors[2]


def test_the_first_samples_are_the_same_as_all(model: BodyModel) -> None:
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, PROJECTION_STRIDE))
    state = _some_state(model)
    every, few = samples.jacobian(state), samples.first(50).jacobian(state)
    assert np.array_equal(every[0][:50], few[0])
    assert np.array_equal(every[1][:50], few[1])


def test_derivatives_of_some_components_are_those_of_all(model: BodyModel) -> None:
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, 97))
    state = _some_state(model)
    positions, every = samples.jacobian(state)
    same, few = samples.jacobian(state, 7)
    start = 3 * model.part_count
    assert np.allclose(positions, same, atol=1e-6)
    assert np.allclose(few[..., : start + 7], every[..., : start + 7], atol=1e-6)
    assert np.allclose(few[..., -3:], every[..., -3:])
    beyond = replace(state, beta=np.where(np.arange(model.beta_count) < 7, state.beta, 0.0))
    assert not np.allclose(samples.jacobian(beyond, 7)[0], positions, atol=1e-3)


def test_a_surface_in_another_topology_is_found(model: BodyModel) -> None:
    """A held-out body whose vertices come in no order that the model knows."""
    body = np.load(BODIES / "ben.npz")
    vertices, faces = body["vertices"].astype(np.float64), body["faces"].astype(np.int32)
    order = np.random.default_rng(0).permutation(len(vertices))
    where = np.argsort(order)
    sampling = Sampling.build(model)
    surface = vertices[order], where[faces].astype(np.int32)
    state = register(model, sampling.body, sampling.hands, *surface)
    found = distances(model, state, *surface)
    assert np.median(found.to_model_m) < 1e-3
    assert np.sqrt(np.mean(found.to_model_m**2)) < 3e-3
    assert np.sqrt(np.mean(found.to_surface_m**2)) < 3e-3
