"""Table of a body in the standard standing pose."""

from dataclasses import replace

import numpy as np
import pytest
from random_bodies import random_body

from workers.measure.body import measure_standing
from workers.measure.intervals import (
    shipped,
    sides_pooled,
)
from workers.measure.scan_errors import ScanErrors
from workers.measure.standing import on_both_feet, standard_state, stood_upright
from workers.measure.tracing import trace_all
from workers.scape.model.body_model import BodyModel


def test_standing_takes_the_scanned_pose_away(model: BodyModel) -> None:
    """The same person in two stances has one table in the standard pose."""
    tables = []
    for pose_deg in (0.0, 4.0):
        state, vertices = random_body(model, 4, pose_deg)
        state = replace(state, beta=random_body(model, 4, 0.0)[0].beta)
        vertices = model.vertices(state)
        rows = measure_standing(model, vertices, state).rows
        tables.append({row.name: row.value_m for row in rows})
    for name, value in tables[0].items():
        assert tables[1][name] == pytest.approx(value, abs=0.006), name


def test_what_standing_adds_on_the_average_is_taken_off(model: BodyModel) -> None:
    """Necks and shoulders once came out a centimetre too wide in the standard pose."""
    state, vertices = random_body(model, 4)
    sigma = np.full(model.vertex_count, 1e-3)
    traces = trace_all(model, stood_upright(model, vertices, state))
    rows = measure_standing(model, vertices, state, sigma).rows
    for trace, row in zip(traces, rows, strict=True):
        bias = shipped()["standard"][sides_pooled(row.name)].bias
        assert row.value_m == pytest.approx(max(0.0, trace.value_m - bias)), row.name
        low, high = row.interval95_m
        assert low == 0.0 or row.value_m - low == pytest.approx(high - row.value_m), row.name


def test_the_standard_pose(model: BodyModel) -> None:
    body = on_both_feet(model, model.vertices(standard_state(model, np.zeros(model.beta_count))))
    at = {name: body[index] for name, index in model.landmarks.items()}
    for side in ("left", "right"):
        arm = at[f"wrist_{side}"] - at[f"acromion_{side}"]
        from_trunk = np.degrees(np.arctan2(np.hypot(*arm[:2]), -arm[2]))
        assert from_trunk == pytest.approx(20.0, abs=2.0)
        bend = (
            at[f"elbow_{side}"] - at[f"acromion_{side}"],
            at[f"wrist_{side}"] - at[f"elbow_{side}"],
        )
        cosine = bend[0] @ bend[1] / np.linalg.norm(bend[0]) / np.linalg.norm(bend[1])
        assert np.degrees(np.arccos(cosine)) < 6.0
    assert at["heel_left"][0] - at["heel_right"][0] == pytest.approx(0.2, abs=0.03)
    assert abs(body[:, 2].min()) < 2e-3


def test_standing_lines_lie_on_the_scanned_mesh(model: BodyModel) -> None:
    state, vertices = random_body(model, 5)
    rows = {row.name: row for row in measure_standing(model, vertices, state).rows}
    path = rows["waist_girth"].path
    waist = vertices[model.landmarks["waist_front"]]
    assert np.abs(path[:, 2] - waist[2]).max() < 0.03
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert ((path >= low) & (path <= high)).all()


def test_noisy_readings_widen_the_volume_of_a_standing_body(
    model: BodyModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the gain that was learned; which may be none, since noise averages out in a volume."""
    sigma, state = np.zeros(model.vertex_count), model.neutral_state()
    volume = replace(shipped()["standard"]["volume"], noise_gain=4.0)
    learned = {**shipped(), "standard": {**shipped()["standard"], "volume": volume}}
    monkeypatch.setattr("workers.measure.intervals.shipped", lambda: learned)
    usual, noisy = (
        measure_standing(
            model, model.mean, state, sigma, None, ScanErrors(excess_noise_m=n)
        ).volume_m3
        for n in (0.0, 2.6e-3)
    )
    half = [0.5 * float(np.diff(one.interval95)[0]) / one.value for one in (usual, noisy)]
    assert np.sqrt(half[1] ** 2 - half[0] ** 2) == pytest.approx(4.0 * 2.6e-3)
