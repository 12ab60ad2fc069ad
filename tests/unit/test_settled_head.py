"""The second look at a head."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from station.core.bundle import read_bundle
from workers.cloud.observed import PointCloud, Preprocessed
from workers.cloud.preprocess import preprocess
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.fit import fit as whole_fit
from workers.scape.fit import head
from workers.scape.fit.annealing import MIDDLE
from workers.scape.fit.fit import fit_body, sampling_of
from workers.scape.fit.head import settle_head
from workers.scape.fit.joint import JointResult, fit_jointly
from workers.scape.fit.normal_equations import Target
from workers.scape.fit.observer import unobserved
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals


@pytest.fixture
def target(model: BodyModel) -> Target:
    return Target.build(_cloud(model), (), model.vertex_count)


def _cloud(model: BodyModel) -> PointCloud:
    """The neutral body itself."""
    count = model.vertex_count
    places = model.vertices(model.neutral_state())
    normals = vertex_normals(places, model.faces)
    return PointCloud(places, normals, np.full(count, 1e-4), np.zeros(count, np.int16), ("cloud",))


def _nodding(model: BodyModel, nod_deg: float) -> JointResult:
    """A fit whose head is held otherwise."""
    upright = model.neutral_state()
    twists = model.relative_twists(upright.rotations)
    twists[model.part_names.index("head"), 0] += np.radians(nod_deg)
    state = replace(upright, rotations=model.absolute_rotations(twists))
    scan = Preprocessed(_cloud(model), (), ())
    cameras = CameraCorrections.build(scan.cloud, scan.views, scan.predicted)
    return JointResult(state, cameras, model.vertices(state), 0, None)


def _chin_off_m(model: BodyModel, fit: JointResult) -> float:
    chin = model.landmarks["chin"]
    place = model.vertices(model.neutral_state())[chin]
    return float(np.linalg.norm(fit.vertices[chin] - place))


@pytest.mark.parametrize("nod_deg", [-20.0, 20.0])
def test_a_head_that_nods_is_found_from_another_pose(
    model: BodyModel, target: Target, monkeypatch: pytest.MonkeyPatch, nod_deg: float
) -> None:
    sampling = sampling_of(model)
    # One step, so that what helps is the other pose.
    one = MIDDLE[-1:]
    monkeypatch.setattr(head, "_AGAIN", one)
    wrong = _nodding(model, nod_deg)
    assert _chin_off_m(model, wrong) > 0.03
    further = fit_jointly(model, sampling, target, wrong.state, wrong.cameras, one)
    assert _chin_off_m(model, further) > 0.008
    found = settle_head(model, sampling, target, wrong, unobserved)
    assert _chin_off_m(model, found) < 0.003


def test_a_head_that_lies_on_its_points_stays(model: BodyModel, target: Target) -> None:
    right = _nodding(model, 0.0)
    assert settle_head(model, sampling_of(model), target, right, unobserved) is right


def test_noise_is_no_reason_to_look_again(model: BodyModel) -> None:
    rng = np.random.default_rng(0)
    cloud = _cloud(model)
    noisy = replace(
        cloud,
        points=cloud.points + 0.005 * rng.standard_normal((len(cloud), 1)) * cloud.normals,
        sigma_m=np.full(len(cloud), 0.005),
    )
    target = Target.build(noisy, (), len(cloud))
    right = _nodding(model, 0.0)
    assert settle_head(model, sampling_of(model), target, right, unobserved) is right


def test_a_try_that_loses_the_head_is_no_better(model: BodyModel, target: Target) -> None:
    points = head.points_of_head(model, target, model.vertices(model.neutral_state()))
    assert len(points) > 300
    off_m = [
        head.head_off_m(model, target, points, target.tree.points + np.array((0.0, aside_m, 0.0)))
        for aside_m in (0.0, 0.02, 0.3)
    ]
    assert off_m[0] < 1e-6
    assert 0.005 < off_m[1] < off_m[2] == pytest.approx(0.03, rel=1e-3)


def test_every_fit_looks_at_its_head(
    model: BodyModel, bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = []

    def settled(*given: object) -> JointResult:
        looked.append(given)
        return settle_head(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(whole_fit, "settle_head", settled)
    fit_body(model, preprocess(read_bundle(bundle)))
    assert len(looked) == 1
