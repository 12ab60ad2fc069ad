"""Arms that were fitted into the trunk, parted from it."""

from __future__ import annotations

import numpy as np
import pytest

from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.surface.contacts import parted
from workers.scape.surface.crossings import crossing_pairs
from workers.scape.surface.intersections import self_intersections, untangled


@pytest.fixture(scope="module")
def pressed(model: BodyModel) -> np.ndarray:
    """A body whose left arm is turned inwards until it is in the trunk."""
    twists = np.zeros((model.part_count, 3))
    twists[1:] = model.twist_mean.reshape(-1, 3)
    twists[model.part_names.index("upper_arm_left"), 1] += np.radians(24.0)
    rotations = model.absolute_rotations(twists)
    return model.vertices(BodyState(rotations, np.zeros(model.beta_count), np.zeros(3)))


def test_an_arm_is_parted_by_skin_that_was_not_measured(
    model: BodyModel, pressed: np.ndarray
) -> None:
    names = np.array(model.part_names)[model.part_of_vertex]
    arm = np.char.endswith(names, "arm_left")
    crossing = crossing_pairs(pressed, model.faces)
    moved = np.linalg.norm(parted(model, pressed, arm, crossing) - pressed, axis=1)
    trunk = np.isin(names, ["chest", "abdomen", "pelvis"])
    assert 0.001 < moved[trunk].max() < 0.04
    assert moved[arm].max() < 0.5 * moved[trunk].max()
    assert not moved[np.char.endswith(names, "_right")].any()


def test_a_pressed_arm_leaves_no_crossing_and_other_skin_alone(
    model: BodyModel, pressed: np.ndarray
) -> None:
    assert self_intersections(pressed, model.faces) > 40
    measured = np.zeros(len(pressed), bool)
    found = untangled(model, pressed, pressed, measured)
    assert self_intersections(found, model.faces) == 0
    legs = np.isin(np.array(model.part_names)[model.part_of_vertex], ["shin_left", "shin_right"])
    assert np.array_equal(found[legs], pressed[legs])


def test_a_body_whose_arms_are_away_stays(model: BodyModel) -> None:
    body = model.mean
    crossing = crossing_pairs(body, model.faces)
    assert parted(model, body, np.zeros(len(body), bool), crossing) is body
