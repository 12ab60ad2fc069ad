"""What the operator is told."""

from __future__ import annotations

import numpy as np
import pytest

from workers.scape.model import HAND, BodyModel, load_model
from workers.scape.verdict import hands_sunk, judge


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return load_model()


def _of(model: BodyModel, *names: str) -> np.ndarray:
    return np.isin(model.part_of_vertex, [model.part_names.index(name) for name in names])


def _with_right_hand_at_thigh(model: BodyModel, deep_m: float) -> np.ndarray:
    """The mean body, its right hand beside the thigh and so deep in it."""
    vertices = model.mean.copy()
    hand, thigh = _of(model, *(f"{part}_right" for part in HAND)), _of(model, "thigh_right")
    side = np.sign(vertices[hand, 0].mean())
    outside = (side * vertices[thigh, 0]).max()
    level = vertices[thigh][np.argmax(side * vertices[thigh, 0])]
    vertices[hand] -= vertices[hand].mean(axis=0)
    vertices[hand, 0] *= 0.3  # a flat hand
    innermost = (side * vertices[hand, 0]).min()
    vertices[hand] += (side * (outside - innermost - deep_m), *level[1:])
    return vertices


def test_a_hand_inside_the_thigh_is_named(model: BodyModel) -> None:
    sunk = hands_sunk(model, _with_right_hand_at_thigh(model, 0.05))
    verdict = judge((), {}, sunk, (), 0.0, 1.7, np.zeros(10), {})
    assert verdict.status == "rescan"
    assert len(verdict.reasons) == 1
    assert verdict.reasons[0].startswith("right hand")


def test_a_hand_that_rests_on_the_thigh_is_not(model: BodyModel) -> None:
    for vertices in (model.mean, _with_right_hand_at_thigh(model, 0.005)):
        sunk = hands_sunk(model, vertices)
        assert set(sunk) == {"hand_left", "hand_right"}
        assert judge((), {}, sunk, (), 0.0, 1.7, np.zeros(10), {}).status == "ok"
