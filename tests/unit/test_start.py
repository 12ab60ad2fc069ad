"""Starting states where hair hides a head."""

from __future__ import annotations

import numpy as np
import pytest

from workers.scape.fit.initial import is_head_hidden, taller
from workers.scape.model.body_model import BodyModel


def test_a_head_is_hidden_where_only_its_face_gives_points(model: BodyModel) -> None:
    body = model.mean
    head = body[model.part_of_vertex == model.part_names.index("head")]
    face = head[head[:, 1] < np.quantile(head[:, 1], 0.4)]
    assert not is_head_hidden(model, body, body)
    assert is_head_hidden(model, body, face)
    assert is_head_hidden(model, body, body[body[:, 2] < 1.0])


def test_a_taller_start_stands_on_the_same_soles(model: BodyModel) -> None:
    state = model.neutral_state()
    before, after = model.vertices(state), model.vertices(taller(model, state))
    assert after[:, 2].min() == pytest.approx(before[:, 2].min())
    assert 0.04 < np.ptp(after[:, 2]) - np.ptp(before[:, 2]) < 0.08
