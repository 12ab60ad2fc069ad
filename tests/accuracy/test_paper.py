"""The paper's method keeps the limbs of people who stand as it asks."""

from __future__ import annotations

import numpy as np

from workers.cloud.observed import PointCloud
from workers.scape.fit.normal_equations import Target
from workers.scape.fit.paper import fit_like_the_paper
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals

_LOST_M = 0.02
"""Without the weights of pairs and the parents' turn the forearm ends 54 mm away."""


def test_an_arm_out_of_reach_comes_back_with_its_shoulder(model: BodyModel) -> None:
    """Turned by 8 degrees at the shoulder, a hand is 8 cm away, beyond the 5 cm of a pair."""
    start = model.neutral_state()
    twists = model.relative_twists(start.rotations)
    twists[model.part_names.index("upper_arm_left"), 1] += np.radians(8.0)
    body = model.turned(model.mean, model.absolute_rotations(twists), start.translation)
    cloud = PointCloud(
        points=body,
        normals=vertex_normals(body, model.faces),
        sigma_m=np.full(len(body), 1e-3),
        camera=np.zeros(len(body), np.int16),
        camera_names=("cloud",),
    )
    surface, _, _ = fit_like_the_paper(model, Target.build(cloud, (), len(cloud)), start)
    away = np.linalg.norm(surface.vertices - body, axis=1)
    of_part = np.array(model.part_names)[model.part_of_vertex]
    lost = {
        str(name): float(np.sqrt(np.mean(away[of_part == name] ** 2)))
        for name in model.part_names
        if not name.startswith(("hand", "foot"))
    }
    assert max(lost.values()) < _LOST_M, lost
