"""The second look at a head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from workers.cloud.observed import PointCloud, Preprocessed
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.fit.fit import sampling_of
from workers.scape.fit.head import head_off_m, settle_head
from workers.scape.fit.joint import JointResult
from workers.scape.fit.normal_equations import Target
from workers.scape.fit.observer import unobserved
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals


@pytest.mark.parametrize("nod_deg", [-18.0, 18.0])
def test_a_head_that_nods_is_found(model: BodyModel, nod_deg: float) -> None:
    upright = model.neutral_state()
    truth = model.vertices(upright)
    count = len(truth)
    cloud = PointCloud(
        truth,
        vertex_normals(truth, model.faces),
        np.full(count, 1e-3),
        np.zeros(count, np.int16),
        ("cloud",),
    )
    scan = Preprocessed(cloud, (), ())
    target = Target.build(cloud, scan.views, count)
    cameras = CameraCorrections.build(cloud, scan.views, scan.predicted)
    twists = model.relative_twists(upright.rotations)
    twists[model.part_names.index("head"), 0] += np.radians(nod_deg)
    nodding = replace(upright, rotations=model.absolute_rotations(twists))

    def settled(fit: JointResult) -> JointResult:
        return settle_head(model, sampling_of(model), target, fit, unobserved)

    right = JointResult(upright, cameras, truth, 0, None)
    assert settled(right) is right
    wrong = JointResult(nodding, cameras, model.vertices(nodding), 0, None)
    assert head_off_m(model, target.tree, wrong.vertices) > 0.004
    found = settled(wrong)
    chin = model.landmarks["chin"]
    assert np.linalg.norm(wrong.vertices[chin] - truth[chin]) > 0.03
    assert np.linalg.norm(found.vertices[chin] - truth[chin]) < 0.004
