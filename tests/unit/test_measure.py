"""Table of measurements on bodies of the model itself: no fit, no noise."""

from dataclasses import replace

import numpy as np
import pytest
from random_bodies import random_body
from true_measurements import TrueBody

from station.core.geometry import so3_exp
from station.core.words.terms import TERMS
from workers.measure import tracing
from workers.measure.body import measure_body
from workers.measure.definitions import DEFINITIONS
from workers.measure.differences import side_differences
from workers.measure.intervals import (
    shipped,
    sides_pooled,
)
from workers.measure.kinds import Route, Section
from workers.measure.sections import loop_length
from workers.measure.standing import on_both_feet, standard_state
from workers.measure.tracing import trace_all
from workers.scape.learn.landmarks import landmarks
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals


def _values(model: BodyModel, vertices: np.ndarray) -> dict[str, float]:
    return {row.name: row.value_m for row in measure_body(model, vertices).rows}


def test_the_table_names_only_what_the_model_has(model: BodyModel) -> None:
    assert len({definition.name for definition in DEFINITIONS}) == len(DEFINITIONS) >= 60
    for definition in DEFINITIONS:
        if isinstance(definition.kind, Section | Route):
            assert set(definition.kind.parts) <= set(model.part_names)
    rows = {sides_pooled(definition.name) for definition in DEFINITIONS} | {"volume", "surface"}
    for models in shipped().values():
        assert rows == set(models)


def test_every_row_has_a_plain_name() -> None:
    assert {sides_pooled(definition.name) for definition in DEFINITIONS} == set(TERMS)


def test_the_model_carries_the_landmarks_of_the_template(model: BodyModel) -> None:
    assert landmarks(model.symmetry) == model.landmarks


def test_landmarks_lie_where_surveys_find_them(model: BodyModel) -> None:
    """Shares of the stature, ANSUR II, men and women averaged; 2 % of the stature is tolerated."""
    stature = np.ptp(model.mean[:, 2])
    for landmark, share in {
        "cervicale": 0.864, "acromion_left": 0.821, "suprasternale": 0.818, "bust_left": 0.722,
        "waist_front": 0.632, "buttock_left": 0.505, "crotch": 0.476, "knee_left": 0.285,
        "ankle_left": 0.040,
    }.items():  # fmt: skip
        height = model.mean[model.landmarks[landmark], 2] / stature
        assert height == pytest.approx(share, abs=0.02), landmark


@pytest.mark.parametrize("seed", [1, 2])
def test_an_independent_measuring_finds_the_same(model: BodyModel, seed: int) -> None:
    _, vertices = random_body(model, seed)
    truth = TrueBody(model, vertices).values()
    for name, value in _values(model, vertices).items():
        assert value == pytest.approx(truth[name], abs=5e-4), name
    measured = measure_body(model, vertices)
    assert measured.volume_m3.value == pytest.approx(truth["volume"], rel=1e-6)
    assert measured.surface_m2.value == pytest.approx(truth["surface"], rel=1e-6)


@pytest.mark.parametrize("lean_deg", [0.0, 20.0])
@pytest.mark.parametrize("bow_deg", [0.0, 20.0, 40.0])
def test_a_neck_is_as_wide_however_the_head_is_held(
    model: BodyModel, lean_deg: float, bow_deg: float
) -> None:
    twists = np.zeros((model.part_count, 3))
    for part, degrees in (("abdomen", lean_deg), ("chest", lean_deg), ("neck", bow_deg),
                          ("head", bow_deg)):  # fmt: skip
        twists[model.part_names.index(part), 0] = np.radians(degrees / 2.0)
    bowed = replace(model.neutral_state(), rotations=model.absolute_rotations(twists))
    upright = _values(model, model.mean)["neck_girth"]
    assert _values(model, model.vertices(bowed))["neck_girth"] == pytest.approx(upright, abs=0.020)


def test_a_collar_changes_little_with_the_skins_errors(model: BodyModel) -> None:
    """With a plane that grazes the shoulder, follows it far or leaves it: 9 and 23 mm."""
    row = [one for one in DEFINITIONS if one.name == "neck_base_girth"]
    moved = []
    for seed in range(12):
        _, body = random_body(model, seed, 8.0)
        normals = vertex_normals(body, model.faces)
        rng = np.random.default_rng(seed)
        off = []
        for _ in range(4):
            waves = rng.standard_normal((4, 3))
            waves *= 2.0 * np.pi / 0.1 / np.linalg.norm(waves, axis=1)[:, None]
            phase = rng.uniform(0.0, 2.0 * np.pi, 4)
            # 2 mm rms, 10 cm long.
            skin = 0.002 * np.cos(body @ waves.T + phase).sum(axis=1) / np.sqrt(2.0)
            off.append(trace_all(model, body + skin[:, None] * normals, row)[0].value_m)
        moved.append(np.abs(np.array(off) - trace_all(model, body, row)[0].value_m).max())
    assert np.median(moved) < 0.0065
    assert max(moved) < 0.012


def test_a_section_much_longer_than_the_necks_foot_is_no_neck(
    model: BodyModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = [one for one in DEFINITIONS if one.name == "neck_girth"]
    assert np.isfinite(trace_all(model, model.mean, row)[0].value_m)
    monkeypatch.setattr(tracing, "NARROWEST_OF_FOOT", 0.5)
    assert np.isnan(trace_all(model, model.mean, row)[0].value_m)


def test_hips_are_measured_where_the_seat_is(model: BodyModel) -> None:
    """A pad of 3 cm on both buttocks, 4 cm above their farthest points, moves the level up."""
    at = model.mean[model.landmarks["buttock_left"]] + (0.0, 0.0, 0.04)
    away = np.linalg.norm(np.abs(model.mean) * (1, 0, 0) + model.mean * (0, 1, 1)
                          - np.abs(at) * (1, 0, 0) - at * (0, 1, 1), axis=1)  # fmt: skip
    padded = model.mean + 0.03 * np.exp(-((away / 0.03) ** 2))[:, None] * (0.0, 1.0, 0.0)
    plain, moved = (
        next(row for row in measure_body(model, body).rows if row.name == "hip_girth").path
        for body in (model.mean, padded)
    )
    assert 0.01 < float(np.mean(moved[:, 2]) - np.mean(plain[:, 2])) < 0.06


def test_left_and_right_of_the_symmetric_body_agree(model: BodyModel) -> None:
    values = _values(model, model.mean)
    for name in values:
        if name.endswith("_left"):
            other = name.removesuffix("_left") + "_right"
            assert values[name] == pytest.approx(values[other], abs=1e-3), name


def test_a_larger_body_measures_more_in_proportion(model: BodyModel) -> None:
    small, large = _values(model, model.mean), _values(model, 1.1 * model.mean)
    for name, value in small.items():
        assert large[name] == pytest.approx(1.1 * value, rel=1e-6), name
    volumes = [measure_body(model, k * model.mean).volume_m3.value for k in (1.0, 1.1)]
    assert volumes[1] == pytest.approx(1.1**3 * volumes[0], rel=1e-6)


def test_values_do_not_depend_on_where_the_person_stands(model: BodyModel) -> None:
    turned = model.mean @ so3_exp([0.0, 0.0, 0.4]).T + (0.2, -0.1, 0.0)
    here, there = _values(model, model.mean), _values(model, turned)
    for name, value in here.items():
        assert there[name] == pytest.approx(value, abs=1e-6), name


def test_arms_never_count_to_the_trunk(model: BodyModel) -> None:
    """With arms that touch the hips, a plane cuts hands and trunk at one level."""
    state = standard_state(model, np.zeros(model.beta_count))
    low = on_both_feet(model, model.vertices(state))
    high = on_both_feet(model, model.vertices(model.neutral_state()))
    near, far = _values(model, low), _values(model, high)
    for name in ("waist_girth", "high_hip_girth", "hip_girth"):
        assert near[name] == pytest.approx(far[name], rel=0.03), name


@pytest.mark.parametrize(
    ("side", "curl"), [("left", (0.83, 1.21, -0.43)), ("right", (1.15, -1.60, 0.64))]
)
def test_a_fists_girth_is_that_of_its_palm(
    model: BodyModel, side: str, curl: tuple[float, float, float]
) -> None:
    """The curled fingers lie nearer to the line of the landmarks: 6 cm were measured, not 18."""
    state, fingers = model.neutral_state(), model.part_names.index(f"fingers_{side}")
    (row,) = (row for row in DEFINITIONS if row.name == f"hand_girth_{side}")
    girths_m = []
    for share in (0.0, 0.8, 1.0, 1.2, 1.3):
        rotations = state.rotations.copy()
        rotations[fingers] = rotations[fingers] @ so3_exp(share * np.array(curl))
        vertices = model.vertices(replace(state, rotations=rotations))
        girths_m.append(trace_all(model, vertices, [row])[0].value_m)
    assert np.ptp(girths_m) < 0.02


def test_a_girth_is_as_long_as_its_path(model: BodyModel) -> None:
    _, vertices = random_body(model, 3)
    for row in measure_body(model, vertices).rows:
        if row.closed:
            assert loop_length(row.path, closed=True) == pytest.approx(row.value_m, rel=1e-9)


def test_differences_are_left_minus_right(model: BodyModel) -> None:
    taller = model.mean.copy()
    arm = [model.part_names.index(part) for part in ("forearm_left", "hand_left")]
    inside = np.isin(model.part_of_vertex, arm)
    middle = taller[inside].mean(axis=0)
    taller[inside] = middle + 1.05 * (taller[inside] - middle)
    rows = measure_body(model, taller, np.full(model.vertex_count, 1e-3)).rows
    by_name = {row.name: row for row in rows}
    found = {row.name: row for row in side_differences(rows)}
    assert "knee_girth" in found
    assert not {"waist_girth", "height"} & set(found)
    forearm, knee = found["forearm_girth"], found["knee_girth"]
    left, right = by_name["forearm_girth_left"], by_name["forearm_girth_right"]
    assert forearm.value_m == pytest.approx(left.value_m - right.value_m)
    assert 0.008 < forearm.value_m < 0.02
    assert abs(knee.value_m) < 1e-3
    for row in (forearm, knee):
        low, high = row.interval95_m
        assert low < row.value_m < high
        assert high - low < 0.08


def test_the_belly_is_measured_where_it_protrudes(model: BodyModel) -> None:
    """Whichever way the person stands."""
    body = model.mean.copy()
    navel = np.array([0.0, body[model.landmarks["waist_front"], 1], 0.99])
    away = np.linalg.norm(body - navel, axis=1)
    trunk = np.isin(model.part_of_vertex, [0, 1])
    body[:, 1] -= 0.06 * np.exp(-((away / 0.08) ** 2)) * trunk
    for turn_rad in (0.0, 1.2):
        turned = body @ so3_exp([0.0, 0.0, turn_rad]).T
        path = next(row.path for row in measure_body(model, turned).rows
                    if row.name == "belly_girth")  # fmt: skip
        assert np.ptp(path[:, 2]) < 1e-9
        assert path[0, 2] == pytest.approx(0.99, abs=0.02)
