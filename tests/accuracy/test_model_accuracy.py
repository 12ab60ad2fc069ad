"""The body model on bodies and poses that it was not learned from, and how it is learned."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from workers.scape.learn.database import BodyDatabase, Shapes, Split, body_database
from workers.scape.learn.people.survey import STATURE, WAIST, Regression, surveyed
from workers.scape.learn.people.tailoring import sizes_of
from workers.scape.learn.projection import PROJECTION_STRIDE, best_fit
from workers.scape.learn.train import TrainingPlan, train
from workers.scape.model.body_model import BodyModel, load_model
from workers.scape.model.cache import FOLDER_VARIABLE
from workers.scape.model.sampled import SampledBody

BODIES = 3


@pytest.fixture(scope="module")
def database() -> BodyDatabase:
    return body_database()


@pytest.fixture(scope="module")
def held_out(database: BodyDatabase) -> Shapes:
    return database.sample("test", 16, 0)


def _rms_m(model: BodyModel, bodies: np.ndarray) -> np.ndarray:
    """Vertex rms of each body after the best fit of pose and shape."""
    samples = SampledBody.build(model, np.arange(0, model.vertex_count, PROJECTION_STRIDE))
    fitted = [model.vertices(best_fit(model, samples, body)) for body in bodies]
    return np.sqrt(np.mean(np.sum((np.array(fitted) - bodies) ** 2, axis=2), axis=1))


def test_held_out_bodies_are_found(
    model: BodyModel, database: BodyDatabase, held_out: Shapes
) -> None:
    shapes = held_out.take(np.arange(BODIES))
    neutral = _rms_m(model, database.vertices(shapes))
    assert neutral.mean() < 0.0015
    assert neutral.max() < 0.003
    posed = database.vertices(shapes, database.sample_poses("test", BODIES, 21))
    with_q = _rms_m(model, posed).mean()
    rigid = replace(
        model, pose_fields=np.zeros_like(model.pose_fields), sha256=f"{model.sha256} rigid"
    )
    assert with_q < 0.002
    assert with_q < 0.8 * _rms_m(rigid, posed).mean()


def test_the_shipped_template_is_the_database_s(model: BodyModel, database: BodyDatabase) -> None:
    assert np.array_equal(model.faces, database.faces)
    assert np.array_equal(model.symmetry, database.symmetry)


def test_splits_share_no_body(database: BodyDatabase, held_out: Shapes) -> None:
    others: tuple[Split, ...] = ("train", "validation")
    drawn = [held_out, *(database.sample(split, 16, 0) for split in others)]
    ages = [set(shapes.phenotypes["age"].tolist()) for shapes in drawn]
    assert not ages[0] & ages[1]
    assert not ages[0] & ages[2]
    assert not ages[1] & ages[2]


def test_bodies_have_the_sizes_of_the_persons_they_were_made_for(
    database: BodyDatabase, held_out: Shapes
) -> None:
    """The bodies' spread was 1.5 to 2.5 times people's, and hands were 26 mm long of the mean."""
    sizes = sizes_of(database, held_out)
    assert np.isfinite(sizes).all()
    people = surveyed()
    for sex in (False, True):
        expected = Regression.of(people.take(people.female == sex))
        mine = (held_out.phenotypes["gender"] > 0.5) == sex
        stature, waist = sizes[mine][:, [STATURE, WAIST]].T
        off = sizes[mine] - expected.sizes(stature, waist, np.full(mine.sum(), 45.0))
        deviation = np.delete(expected.deviations, [STATURE, WAIST], axis=1).std(axis=0)
        scaled = np.delete(off, [STATURE, WAIST], axis=1) / deviation
        # Sixteen bodies, with people's own spread of 1 and tails.
        assert np.sqrt(np.mean(scaled**2)) < 1.6
        assert np.abs(scaled.mean(axis=0)).mean() < 0.6


def test_a_seed_learns_the_same_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "cache"))
    plan = TrainingPlan(bodies=10, poses=10, components=8, residual_bodies=2)
    said = []
    for name in ("one.npz", "two.npz"):
        train(tmp_path / name, plan, lambda step, share: said.append((share, step)))
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    small = load_model(tmp_path / "one.npz")
    assert small.beta_count == 8
    assert said[-1] == (1.0, "done")
