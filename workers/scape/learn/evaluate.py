"""Evaluation of the model on bodies and poses that it was not learned from, with its bars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.core.errors import FormatError
from workers.scape.fit.sampling import Sampling
from workers.scape.learn.database import BodyDatabase
from workers.scape.learn.pictures import draw_case, draw_components
from workers.scape.learn.projection import PROJECTION_STRIDE, best_fit
from workers.scape.learn.registration import distances, register
from workers.scape.learn.resources import SAMPLES, measure_resources
from workers.scape.model.body_model import HAND, BodyModel, BodyState, load_model
from workers.scape.model.deformation import vertex_areas
from workers.scape.model.sampled import SampledBody

Array = NDArray[np.float64]

_COMPONENTS = (10, 20, 40, 60, 80, 100, 130, 160)
_RANDOM_BODIES = 20
_DRAWN_COMPONENTS = 5
_EXTREMITIES = (*HAND, "foot")


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Options of an evaluation."""

    model: Path | None = None
    bodies: int = 100
    seed: int = 0
    pictures: Path | None = None
    """Folder for pictures."""
    other_bodies: Path | None = None
    """Folder of npz files with `vertices` and `faces` of bodies of other families."""


def evaluate(plan: Evaluation) -> Iterator[str]:
    """Tables, line by line, over bodies of the test split."""
    model = load_model(plan.model)
    database = BodyDatabase()
    shapes = database.sample("test", plan.bodies, plan.seed)
    neutral = database.vertices(shapes)
    posed = database.vertices(shapes, database.sample_poses("test", plan.bodies, plan.seed))
    yield (
        f"model {model.name} {model.sha256[:12]}: {model.vertex_count} vertices, "
        f"{model.part_count} parts, {model.beta_count} components"
    )
    yield f"{plan.bodies} held-out bodies, split test, seed {plan.seed}; distances in mm"
    yield ""
    yield from _compactness(model)
    yield ""
    yield from _neutral(model, neutral)
    yield ""
    yield from _posed(model, posed, plan.pictures)
    yield ""
    yield from _specificity(model, neutral, plan.seed)
    yield ""
    yield from _resources(plan.model)
    if plan.other_bodies is not None:
        yield ""
        yield from _others(model, plan.other_bodies)
    if plan.pictures is not None:
        draw_components(model, _DRAWN_COMPONENTS, plan.pictures / "components.png")
        yield f"pictures in {plan.pictures}"


def _bar(name: str, value: float, limit: float, unit: str, *, at_least: bool = False) -> str:
    met = value >= limit if at_least else value <= limit
    sign = ">=" if at_least else "<="
    return f" bar: {name}: {value:.2f} {unit}, {sign} {limit:g}: {'met' if met else 'MISSED'}"


def _rms(errors: Array) -> Array:
    return np.asarray(1e3 * np.sqrt(np.mean(errors**2, axis=1)))


def _row(name: str, errors: Array) -> str:
    """Table row of distances (bodies, P) in metres."""
    rms = _rms(errors)
    p95 = 1e3 * float(np.quantile(errors, 0.95))
    return f" {name:<14}{rms.mean():8.2f}{rms.max():8.2f}{p95:8.2f}"


_HEAD = "                mean rms   worst     p95"


def _away(model: BodyModel, state: BodyState, body: Array) -> Array:
    return np.asarray(np.linalg.norm(model.vertices(state) - body, axis=1))


def _compactness(model: BodyModel) -> Iterator[str]:
    areas = vertex_areas(model.mean, model.faces)
    variance = np.einsum("jpc,jpc,p->j", model.directions, model.directions, areas)
    yield "compactness: share of the variance that the first components carry"
    for components in _COMPONENTS:
        if components <= model.beta_count:
            share = variance[:components].sum() / variance.sum()
            yield f" {components:4d} components {100 * share:7.2f} %"


def _neutral(model: BodyModel, bodies: Array) -> Iterator[str]:
    yield "generalisation: held-out bodies in the neutral pose, vertex to vertex"
    yield _HEAD
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, PROJECTION_STRIDE))
    starts = [model.project(body) for body in bodies]
    shipped = np.empty(0)
    for components in sorted({*_COMPONENTS, model.beta_count}):
        if components > model.beta_count:
            continue
        shipped = np.stack(
            [
                _away(
                    model,
                    best_fit(model, samples, body, start=start, components=components),
                    body,
                )
                for body, start in zip(bodies, starts, strict=True)
            ]
        )
        yield _row(f"{components} components", shipped)
    yield _bar("mean vertex rms", float(_rms(shipped).mean()), 2.0, "mm")
    yield _bar("worst body", float(_rms(shipped).max()), 5.0, "mm")


def _posed(model: BodyModel, bodies: Array, pictures: Path | None) -> Iterator[str]:
    yield "held-out bodies in held-out poses, best fit of pose and shape to the full mesh"
    yield _HEAD
    every = np.arange(0, model.vertex_count, PROJECTION_STRIDE)
    rigid = replace(
        model,
        pose_fields=np.zeros_like(model.pose_fields),
        sha256=f"{model.sha256} without pose-dependent deformation",
    )
    found = {}
    for name, variant in (("with Q", model), ("without Q", rigid)):
        samples = SampledBody.build(variant, every)
        states = [best_fit(variant, samples, body) for body in bodies]
        errors = np.stack(
            [_away(variant, state, body) for state, body in zip(states, bodies, strict=True)]
        )
        found[name] = states, errors
        yield _row(name, errors)
    states, errors = found["with Q"]
    mean = float(_rms(errors).mean())
    gain = 100.0 * (1.0 - mean / float(_rms(found["without Q"][1]).mean()))
    yield _bar("mean vertex rms with Q", mean, 4.0, "mm")
    yield _bar("Q lowers the mean by", gain, 20.0, "%", at_least=True)
    yield ""
    yield "by part, posed: rms, worst vertex"
    for part, name in enumerate(model.part_names):
        mine = errors[:, model.part_of_vertex == part]
        yield f" {name:<18}{1e3 * float(np.sqrt(np.mean(mine**2))):6.2f}{1e3 * mine.max():8.2f}"
    worst = int(np.argmax(_rms(errors)))
    yield f"worst case: body {worst}, {_rms(errors)[worst]:.2f} mm rms"
    if pictures is not None:
        fit = model.vertices(states[worst])
        title = f"body {worst}, {_rms(errors)[worst]:.1f} mm rms"
        draw_case(model, bodies[worst], fit, title, pictures / "worst.png")


def _specificity(model: BodyModel, bodies: Array, seed: int) -> Iterator[str]:
    """Distance of random bodies of the model to the nearest real one (mm, vertex rms)."""
    rng = np.random.default_rng(seed)
    centered = bodies - np.einsum("p,npc->nc", model.anchor, bodies)[:, None]
    nearest = []
    for _ in range(_RANDOM_BODIES):
        state = replace(model.neutral_state(), beta=rng.standard_normal(model.beta_count))
        made = model.neutral_surface(state)
        made = made - model.anchor @ made
        away = np.sqrt(np.mean(np.sum((centered - made) ** 2, axis=2), axis=1))
        nearest.append(away.min())
    yield (
        f"specificity: a random body of the model lies {1e3 * float(np.mean(nearest)):.1f} mm rms "
        f"from the nearest of the {len(bodies)} held-out ones"
    )


def _resources(path: Path | None) -> Iterator[str]:
    cold, warm = measure_resources(path)
    yield f"time and memory in processes of their own, {SAMPLES} samples"
    for name, span, limit, unit, scale in (
        ("cold load, caches built", cold.load, 5.0, "s", 1.0),
        ("warm load", warm.load, 0.5, "s", 1.0),
        ("one full body", warm.body, 10.0, "ms", 1e3),
        (f"Jacobian at {SAMPLES} samples", warm.jacobian, 30.0, "ms", 1e3),
    ):
        yield (
            f"{_bar(name, scale * span.wall_s, limit, unit)} "
            f"(processor {scale * span.processor_s:.2f} {unit})"
        )
    yield _bar("peak resident memory, cold", cold.peak_bytes / 1e6, 500.0, "MB")
    yield _bar("peak resident memory, warm", warm.peak_bytes / 1e6, 500.0, "MB")


def _others(model: BodyModel, folder: Path) -> Iterator[str]:
    """Bodies of other families: never trained or tuned on, reported alone."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise FormatError(f"{folder} holds no .npz files with vertices and faces")
    sampling = Sampling.build(model)
    yield "bodies of other families, surface to surface after a fit to their full mesh"
    yield "                                           rms  median     p95   worst"
    extremity = np.array([name.startswith(_EXTREMITIES) for name in model.part_names])
    for path in paths:
        vertices, faces = _surface_of(path)
        state = register(model, sampling.body, sampling.hands, vertices, faces)
        found = distances(model, state, vertices, faces)
        for where, away, part in (
            ("from it", found.to_model_m, model.part_of_vertex[found.nearest_vertex]),
            ("from the model", found.to_surface_m, model.part_of_vertex),
        ):
            for name, chosen in (
                ("trunk, limbs, head", ~extremity[part]),
                ("hands, feet", extremity[part]),
            ):
                mine = 1e3 * away[chosen]
                yield (
                    f" {path.stem:<12}{where:<16}{name:<20}"
                    f"{np.sqrt(np.mean(mine**2)):7.2f}{np.median(mine):8.2f}"
                    f"{np.quantile(mine, 0.95):8.2f}{mine.max():8.2f}"
                )


def _surface_of(path: Path) -> tuple[Array, NDArray[np.int32]]:
    try:
        with np.load(path, allow_pickle=False) as data:
            return np.asarray(data["vertices"], np.float64), np.asarray(data["faces"], np.int32)
    except (OSError, ValueError, KeyError) as cause:
        raise FormatError(f"{path} is not an npz file with vertices and faces ({cause})") from None
