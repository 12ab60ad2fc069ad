"""Bodies of the model in random poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from workers.measure.standing import on_both_feet
from workers.scape.model.body_model import BodyModel, BodyState


def random_body(
    model: BodyModel, seed: int = 0, pose_deg: float = 5.0
) -> tuple[BodyState, np.ndarray]:
    """A random body near the neutral pose, on the floor."""
    rng = np.random.default_rng(seed)
    twists = np.radians(pose_deg) * np.clip(rng.standard_normal((model.part_count, 3)), -2, 2)
    twists[0] = 0.0
    state = replace(
        model.neutral_state(),
        beta=0.8 * rng.standard_normal(model.beta_count),
        rotations=model.absolute_rotations(twists),
    )
    vertices = on_both_feet(model, model.vertices(state))
    lift = vertices[0, 2] - model.vertices(state)[0, 2]
    return replace(state, translation=state.translation + np.array([0.0, 0.0, lift])), vertices
