"""Hair beside a head."""

import numpy as np

from workers.cloud.observed import PointCloud
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.verdict.hair import Hair, hair_of
from workers.scape.verdict.unmatched import Patch


def test_arms_and_straps_beside_a_head_are_no_hair(model: BodyModel) -> None:
    """An arm over the head, which the fit lost, was hair; a strap over the chest was a beard."""
    normals, count = vertex_normals(model.mean, model.faces), model.vertex_count
    cloud = PointCloud(
        model.mean, normals, np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )
    head, neck, chest = (model.part_names.index(name) for name in ("head", "neck", "chest"))
    beard = Patch(0.025, 0.06, (chest, head), np.array([model.landmarks["chin"]]))
    assert hair_of(model, [beard], model.mean, cloud).on_head == (beard,)
    arm = Patch(0.0434, 0.078, (head,), np.flatnonzero(model.of_parts(("head",))))
    assert hair_of(model, [arm], model.mean, cloud) == Hair()
    strap = Patch(0.0072, 0.041, (chest, neck), np.array([model.landmarks["neck_front"]]))
    assert hair_of(model, [strap], model.mean, cloud).hanging == (strap,)
