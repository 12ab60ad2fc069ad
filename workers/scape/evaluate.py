"""How good the model is on bodies and poses that it was not learned from."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from workers.scape.database import BodyDatabase
from workers.scape.model import BodyModel, BodyState

Array = NDArray[np.float64]

_COMPONENTS = (10, 20, 40, 60, 80, 100, 130, 160)
_SAMPLES = 3000


def evaluate(model: BodyModel, count: int, seed: int) -> Iterator[str]:
    """Tables, line by line, over `count` bodies of the test split."""
    database = BodyDatabase()
    shapes = database.sample("test", count, seed)
    neutral = database.vertices(shapes)
    posed = database.vertices(shapes, database.sample_poses("test", count, seed))
    yield f"model {model.name} {model.sha256[:12]}: {model.beta_count} components"
    yield f"{count} held-out bodies, split test, seed {seed}"
    yield ""
    yield "generalisation, neutral pose (vertex to vertex, mm)"
    yield " components    mean rms     worst   p95 vertex"
    for components in _COMPONENTS:
        if components > model.beta_count:
            continue
        cut = replace(model, directions=model.directions[:components])
        errors = np.stack([_error(cut, body) for body in neutral])
        yield f" {components:10d}  {_row(errors)}"
    yield ""
    yield "held-out bodies in held-out poses (mm)"
    yield "                 mean rms     worst   p95 vertex"
    without = replace(model, pose_fields=np.zeros_like(model.pose_fields))
    with_q = np.stack([_error(model, body) for body in posed])
    no_q = np.stack([_error(without, body) for body in posed])
    yield f" with Q      {_row(with_q)}"
    yield f" without Q   {_row(no_q)}"
    gain = 1.0 - _rms(with_q).mean() / _rms(no_q).mean()
    yield f" Q lowers the mean by {100 * gain:.0f} %"
    yield ""
    yield "by part, posed (mm rms)"
    for part, name in enumerate(model.part_names):
        mine = model.part_of_vertex == part
        if mine.any():
            yield f" {name:<18} {1e3 * float(np.sqrt(np.mean(with_q[:, mine] ** 2))):6.2f}"
    yield ""
    yield from _specificity(model, neutral, seed)
    yield from _speed(model)


def _error(model: BodyModel, body: Array) -> Array:
    """Distance (P,) of each vertex after the best fit of theta and beta."""
    return np.asarray(np.linalg.norm(model.vertices(model.project(body)) - body, axis=1))


def _rms(errors: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=1)))


def _row(errors: Array) -> str:
    rms = 1e3 * _rms(errors)
    return f"{rms.mean():10.2f}{rms.max():10.2f}{1e3 * float(np.quantile(errors, 0.95)):13.2f}"


def _specificity(model: BodyModel, bodies: Array, seed: int) -> Iterator[str]:
    """Distance of random bodies of the model to the nearest real one (mm, vertex rms)."""
    rng = np.random.default_rng(seed)
    centered = bodies - np.einsum("p,npc->nc", model.anchor, bodies)[:, None]
    nearest = []
    for _ in range(20):
        state = replace(model.neutral_state(), beta=rng.standard_normal(model.beta_count))
        made = model.neutral_surface(state)
        made = made - model.anchor @ made
        away = np.sqrt(np.mean(np.sum((centered - made) ** 2, axis=2), axis=1))
        nearest.append(away.min())
    yield f"specificity: {1e3 * float(np.mean(nearest)):.1f} mm to the nearest held-out body"


def _speed(model: BodyModel) -> Iterator[str]:
    state: BodyState = model.neutral_state()
    samples = model.at(np.linspace(0, model.vertex_count - 1, _SAMPLES).astype(np.int64))
    yield f"one full body: {1e3 * _median_s(lambda: model.vertices(state)):.1f} ms"
    jacobian_ms = 1e3 * _median_s(lambda: samples.jacobian(state))
    yield f"jacobian at {_SAMPLES} samples: {jacobian_ms:.1f} ms"


def _median_s(call: object) -> float:
    assert callable(call)
    times = []
    for _ in range(7):
        start_s = time.perf_counter()
        call()
        times.append(time.perf_counter() - start_s)
    return float(np.median(times))
