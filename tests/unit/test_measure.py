"""The table of measurements on bodies of the model itself: no fit, no noise."""

import json
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from true_measurements import TrueBody

from station.core.errors import InputError
from station.core.geometry import so3_exp
from station.core.words.terms import TERMS
from workers.export.origin import Origin
from workers.export.result import measurements_document
from workers.measure.body import measure_body, measure_standing
from workers.measure.coverage import SeenSkin
from workers.measure.definitions import DEFINITIONS
from workers.measure.differences import side_differences
from workers.measure.intervals import (
    SHIPPED,
    ErrorModel,
    RowErrors,
    ScanErrors,
    learned,
    shipped,
    sides_pooled,
)
from workers.measure.kinds import TRUNK_ENDS, Route, Section
from workers.measure.sections import loop_length
from workers.measure.standing import on_both_feet, standard_state, stood_upright
from workers.measure.tracing import trace_all
from workers.scape.learn.landmarks import landmarks
from workers.scape.model.body_model import BodyModel, BodyState, load_model
from workers.scape.model.deformation import vertex_normals


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return load_model()


def _body(model: BodyModel, seed: int = 0, pose_deg: float = 5.0) -> tuple[BodyState, np.ndarray]:
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
    _, vertices = _body(model, seed)
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
    _, vertices = _body(model, 3)
    for row in measure_body(model, vertices).rows:
        if row.closed:
            assert loop_length(row.path, closed=True) == pytest.approx(row.value_m, rel=1e-9)


def test_standing_takes_the_scanned_pose_away(model: BodyModel) -> None:
    """The same person in two stances has one table in the standard pose."""
    tables = []
    for pose_deg in (0.0, 4.0):
        state, vertices = _body(model, 4, pose_deg)
        state = replace(state, beta=_body(model, 4, 0.0)[0].beta)
        vertices = model.vertices(state)
        rows = measure_standing(model, vertices, state).rows
        tables.append({row.name: row.value_m for row in rows})
    for name, value in tables[0].items():
        assert tables[1][name] == pytest.approx(value, abs=0.006), name


def test_what_standing_adds_on_the_average_is_taken_off(model: BodyModel) -> None:
    """Necks and shoulders once came out a centimetre too wide in the standard pose."""
    state, vertices = _body(model, 4)
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
    state, vertices = _body(model, 5)
    rows = {row.name: row for row in measure_standing(model, vertices, state).rows}
    path = rows["waist_girth"].path
    waist = vertices[model.landmarks["waist_front"]]
    assert np.abs(path[:, 2] - waist[2]).max() < 0.03
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert ((path >= low) & (path <= high)).all()


def test_the_intervals_belong_to_the_model(model: BodyModel) -> None:
    """A model learned anew was once shipped with the intervals of the one before."""
    document = json.loads(files("workers.measure").joinpath(SHIPPED).read_text("utf-8"))
    assert document["made_of"]["model_sha256"] == model.sha256


def test_intervals_hold_what_they_promise() -> None:
    """Ordinary scans by a constant, strange ones by what they show: 95 of 100 held in either."""
    rng = np.random.default_rng(0)

    def draw(count: int, strangeness: float) -> RowErrors:
        sigmas = strangeness * rng.uniform(0.5e-3, 3e-3, count)
        errors = 2e-3 + np.hypot(1e-3, 4.0 * sigmas) * rng.standard_normal(count)
        return RowErrors(errors, sigmas, np.zeros(count))

    found = learned(draw(400, 0.05), draw(200, 1.0), draw(400, 0.05))
    assert found.bias == pytest.approx(2e-3, abs=6e-4)
    for strangeness in (0.05, 1.0):
        scans = draw(4000, strangeness)
        pairs = zip(scans.errors, scans.sigmas, strict=True)
        ends = np.array([found.interval(1.0 + e, s) for e, s in pairs])
        held = (ends[:, 0] <= 1.0) & (ends[:, 1] >= 1.0)
        assert 0.92 < held.mean() < 0.985
        width = ends[:, 1] - ends[:, 0]
        assert (width.mean() > 0.01) == (strangeness == 1.0)


def test_chance_does_not_pass_for_a_systematic_error() -> None:
    errors = RowErrors(np.tile([1e-3, -1.1e-3, 2e-3, -1.9e-3], 10), np.zeros(40), np.zeros(40))
    found = learned(errors, errors, errors)
    assert found.bias == found.gain == found.noise_gain == 0.0


def test_noise_that_stays_widens_the_rows_that_it_was_seen_to_spoil() -> None:
    rng = np.random.default_rng(0)

    def draw(count: int, noise_m: float) -> RowErrors:
        noises = np.full(count, noise_m)
        errors = np.hypot(1e-3, 2.0 * noises) * rng.standard_normal(count)
        return RowErrors(errors, np.zeros(count), noises)

    found = learned(draw(400, 0.0), draw(200, 0.0), draw(200, 2.6e-3))
    for noise_m in (0.0, 1.3e-3, 2.6e-3):
        ends = np.array([found.interval(1.0 + e, 0.0, noise_m) for e in draw(4000, noise_m).errors])
        held = (ends[:, 0] <= 1.0) & (ends[:, 1] >= 1.0)
        assert 0.92 < held.mean() < 0.985


def test_what_a_scan_says_of_itself_widens_the_rows_it_concerns(model: BodyModel) -> None:
    sigma, seen = np.full(model.vertex_count, 3e-4), np.ones(model.vertex_count, bool)
    usual, doubtful = (
        {
            row.name: row.interval95_m
            for row in measure_body(model, model.mean, sigma, seen, errors).rows
        }
        for errors in (ScanErrors(), ScanErrors(girth_sigma_m=0.004, crown_sigma_m=0.008))
    )
    assert doubtful["height"][1] - doubtful["height"][0] > 0.031
    assert doubtful["knee_height"] == usual["knee_height"]
    assert doubtful["waist_girth"][1] > usual["waist_girth"][1] + 0.0005


def test_the_calibrations_own_errors_widen_volume_and_surface(model: BodyModel) -> None:
    """A girth of a metre that is 2 pi mm too long: the skin is 1 mm outside."""
    sigma, seen = np.full(model.vertex_count, 3e-4), np.ones(model.vertex_count, bool)
    said = ScanErrors(girth_sigma_m=2.0 * np.pi * 1e-3)
    usual, doubtful = (
        measure_body(model, model.mean, sigma, seen, errors) for errors in (ScanErrors(), said)
    )
    thicker = model.mean + 1e-3 * vertex_normals(model.mean, model.faces)
    moved = measure_body(model, thicker)
    for name in ("volume_m3", "surface_m2"):
        before, after = getattr(usual, name), getattr(doubtful, name)
        half = [0.5 * (one.interval95[1] - one.interval95[0]) for one in (before, after)]
        added = np.sqrt(half[1] ** 2 - half[0] ** 2) / 1.96
        assert added == pytest.approx(getattr(moved, name).value - before.value, rel=0.35), name


def test_an_interval_holds_its_value() -> None:
    low, high = ErrorModel(bias=-8e-3, constant=5e-3, gain=0.0, noise_gain=0.0).interval(0.4, 0.0)
    assert low == 0.4
    assert high == pytest.approx(0.413)


def test_noisy_readings_get_wider_intervals(model: BodyModel) -> None:
    """Some rows hardly: in volumes and in the height of the bust, noise averages out."""
    sigma = np.zeros(model.vertex_count)
    usual, noisy = (
        [float(np.diff(row.interval95_m)[0]) for row in body.rows]
        for body in (
            measure_body(model, model.mean, sigma, None, ScanErrors(excess_noise_m=noise_m))
            for noise_m in (0.0, 2.6e-3)
        )
    )
    growth = np.array(noisy) / np.array(usual)
    assert growth.min() > 1.0 - 1e-9
    assert np.median(growth) > 1.1


def test_noisy_readings_widen_the_volume_of_a_standing_body(model: BodyModel) -> None:
    sigma, state = np.zeros(model.vertex_count), model.neutral_state()
    usual, noisy = (
        float(np.diff(standing.volume_m3.interval95)[0])
        for standing in (
            measure_standing(model, model.mean, state, sigma, None, ScanErrors(excess_noise_m=n))
            for n in (0.0, 2.6e-3)
        )
    )
    assert noisy > 1.02 * usual


@pytest.mark.parametrize("sigma", [(np.nan, 0.0), (0.0, np.nan)])
def test_an_unknown_error_is_not_told_as_none(sigma: tuple[float, float]) -> None:
    found = ErrorModel(bias=0.0, constant=5e-3, gain=1.0, noise_gain=1.0).interval(0.9, *sigma)
    assert np.isnan(found).all()


def test_a_poorly_seen_body_gets_wider_intervals(model: BodyModel) -> None:
    sharp = measure_body(model, model.mean, np.full(model.vertex_count, 3e-4))
    blurred = measure_body(model, model.mean, np.full(model.vertex_count, 4e-3))
    widths = [
        np.mean([row.interval95_m[1] - row.interval95_m[0] for row in body.rows])
        for body in (sharp, blurred)
    ]
    assert widths[1] > 1.1 * widths[0]


@pytest.mark.filterwarnings("error")
def test_a_broken_body_is_an_error_that_names_the_row(model: BodyModel) -> None:
    """Two exchanged cameras gave a crushed one, of which numpy complained in the terminal."""
    crushed = model.mean.copy()
    neck, crotch = (model.landmarks[name] for name in TRUNK_ENDS)
    # Skin counts within a share of the distance between them.
    crushed[neck] = crushed[crotch] + 1e-9
    with pytest.raises(InputError, match="its landmarks give no direction; fit the body again"):
        trace_all(model, crushed)
    flat = model.mean * (1.0, 1.0, 0.0)
    with pytest.raises(InputError, match="cannot be measured"):
        trace_all(model, flat)
    torn = model.mean.copy()
    torn[100] = np.nan
    with pytest.raises(InputError, match="not numbers"):
        trace_all(model, torn)


def test_a_landmark_far_astray_blanks_its_own_rows_alone(model: BodyModel) -> None:
    """One knee in a torn cloud ended the whole result."""
    spiked = model.mean.copy()
    spiked[model.landmarks["knee_left"], 2] = 3.0
    document = measurements_document(Origin("s1"), measure_body(model, spiked))
    blank = {row["name"] for row in document["measurements"] if row["value_m"] is None}
    assert blank == {"knee_girth_left"}
    assert "knee_girth" not in {row["name"] for row in document["differences"]}


@pytest.mark.parametrize("bow_deg", range(0, 60, 5))
def test_a_chin_on_the_chest_blanks_the_neck_alone(model: BodyModel, bow_deg: int) -> None:
    """Around shoulders and chin together, a neck of 53 cm was measured as 91."""
    twists = np.zeros((model.part_count, 3))
    for part in ("neck", "head"):
        twists[model.part_names.index(part), 0] = np.radians(bow_deg)
    bowed = replace(model.neutral_state(), rotations=model.absolute_rotations(twists))
    document = measurements_document(Origin("s1"), measure_body(model, model.vertices(bowed)))
    blank = {row["name"]: row for row in document["measurements"] if row["value_m"] is None}
    assert set(blank) == ({"neck_girth"} if bow_deg > 25 else set())
    assert all(row["path"] == [] and row["interval95_m"] is None for row in blank.values())
    neck = next(row for row in document["measurements"] if row["name"] == "neck_girth")
    assert bow_deg > 25 or neck["value_m"] == pytest.approx(0.35, abs=0.015)


def test_a_row_says_whether_cameras_saw_its_line(model: BodyModel) -> None:
    """The front alone: what runs along the front is seen, the back's is the model's."""
    seen = model.mean[:, 1] < model.mean[model.landmarks["waist_side_left"], 1]
    skin = SeenSkin.build(model, model.mean, seen)
    traces = trace_all(model, model.mean)
    names = [trace.definition.name for trace in traces]
    basis = dict(zip(names, skin.bases(traces), strict=True))
    assert basis["across_front_skin_width"] == basis["crotch_length_front"] == "seen"
    assert basis["waist_girth"] == basis["belly_girth"] == "partly"
    assert basis["crotch_length_back"] == basis["across_back_skin_width"] == "inferred"
    assert {row.basis for row in measure_body(model, model.mean).rows} == {"seen"}


def test_a_height_is_seen_where_the_head_was_seen_to_end(model: BodyModel) -> None:
    """No camera has readings of a crown."""
    sigma = np.full(model.vertex_count, 1e-3)
    nothing = np.zeros(model.vertex_count, bool)
    basis = {
        crown: {
            row.name: row.basis
            for row in measure_body(
                model, model.mean, sigma, nothing, ScanErrors(crown_sigma_m=crown)
            ).rows
        }["height"]
        for crown in (0.0, 0.008)
    }
    assert basis == {0.0: "seen", 0.008: "inferred"}


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
