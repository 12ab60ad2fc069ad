"""Findings that make a scan unusable, and those that are only remarked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from workers.cloud.observed import RAISED_FLOOR, TWO_PEOPLE, Finding, PointCloud
from workers.scape.evidence.inside import shares_inside
from workers.scape.model.body_model import FLOOR, BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.verdict.clothes import Clothing
from workers.scape.verdict.hair import hair_of
from workers.scape.verdict.posture import arms_inside, feet_cut_off, head_turned, leaning
from workers.scape.verdict.seen import PartReport
from workers.scape.verdict.unmatched import patch_sigma_m, unmatched_patches
from workers.scape.verdict.verdict import judge, lost_parts

Array = NDArray[np.float64]


def _scan_of(model: BodyModel, vertices: Array) -> PointCloud:
    """Three points on each triangle, as dense as a booth's cloud on the trunk."""
    normals = vertex_normals(vertices, model.faces)
    shares = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])
    points = np.einsum("sc,kci->ski", shares, vertices[model.faces]).reshape(-1, 3)
    directions = np.einsum("sc,kci->ski", shares, normals[model.faces]).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count = len(points)
    return PointCloud(
        points, directions, np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )


def test_a_bare_cloud_shows_where_its_feet_are(model: BodyModel) -> None:
    assert feet_cut_off(model, model.mean, model.mean[::4]) == {}
    left = model.mean[:, 0] > 0.0
    for cut, feet in ((left, ["foot_left"]), (~left, ["foot_right"]), (left | ~left, None)):
        kept = model.mean[~cut | (model.mean[:, 2] > 0.05)]
        found = feet_cut_off(model, model.mean, kept)
        assert list(found) == (feet or ["foot_left", "foot_right"])
        bare, booth = _verdict(model, {}, {}, found), _verdict(model, {}, {"a": 0.0}, found)
        assert bare.status == "rescan"
        assert FLOOR in bare.missing
        # A booth knows its floor.
        assert FLOOR not in booth.missing


def test_heights_above_a_mat_are_blank(model: BodyModel) -> None:
    sides, beta = {"front": 0.9, "back": 0.9}, np.zeros(model.beta_count)
    mat = Finding(RAISED_FLOOR, None, 0.012, "there is a mat")
    verdict = judge((), sides, [mat], {}, 1.75, beta, {"a": 0.0}, 1e-3)
    assert (verdict.reasons, verdict.missing) == (("there is a mat",), (FLOOR,))


def test_two_people_are_the_only_reason(model: BodyModel) -> None:
    """Fifteen reasons told what of a body had not been found in the two."""
    sides, beta = {"front": 0.1, "back": 0.9}, np.full(model.beta_count, 9.0)
    two = Finding(TWO_PEOPLE, None, None, "two people")
    lost = {"forearm_left": "the left forearm does not match the scan", "": "things"}
    verdict = judge((), sides, [two], lost, 2.4, beta, {"a": 0.01}, 1e-3)
    assert verdict.reasons == ("two people",)
    assert "forearm_left" in verdict.missing


def _elbow_bent(model: BodyModel, degrees: float) -> Array:
    twists = np.zeros((model.part_count, 3))
    twists[model.part_names.index("forearm_left"), 0] = np.radians(degrees)
    state = replace(model.neutral_state(), rotations=model.absolute_rotations(twists))
    return model.vertices(state)


def _verdict(  # type: ignore[no-untyped-def]
    model: BodyModel,
    lost: dict[str, str],
    shifts: dict[str, float],
    misplaced: dict[str, str] | None = None,
):
    sides, beta = {"front": 0.9, "back": 0.9}, np.zeros(model.beta_count)
    return judge((), sides, (), lost, 1.75, beta, shifts, 1e-3, misplaced or {})


def test_what_clothing_may_explain_is_told_with_a_rescan(model: BodyModel) -> None:
    """A belly that hangs is no clothing, but who wears a vest has to be told."""
    hips = Clothing("pelvis", ("pelvis", "abdomen", "thigh_left"), 0.03)
    sides, beta, lost = {"front": 0.9, "back": 0.9}, np.zeros(model.beta_count), {"abdomen": "lost"}
    found = judge((), sides, (), lost, 1.75, beta, {}, 1e-3, {}, ["hair"], [hips])
    assert (found.status, found.reasons) == ("rescan", ("lost",))
    assert [note[:22] for note in found.notes] == ["clothing may lie up to"]
    assert found.missing == ("abdomen",)
    arms = Clothing("upper_arm", ("abdomen", "upper_arm_left"), 0.03)
    worn = judge((), sides, (), lost, 1.75, beta, {}, 1e-3, {}, ["hair"], [hips, arms])
    assert [reason[:14] for reason in worn.reasons] == ["loose clothing"]
    assert worn.notes == ()
    assert set(worn.missing) == {*hips.covered, *arms.covered}


def test_a_lost_forearm_is_named_with_its_size(model: BodyModel) -> None:
    patches = unmatched_patches(model, _elbow_bent(model, -30.0), _scan_of(model, model.mean))
    assert 0.0060 < patches[0].area_m2 < 0.1
    reasons = lost_parts(model, patches)
    assert any(
        "left" in reason and "does not match the scan" in reason for reason in reasons.values()
    )
    assert not any("right" in reason for reason in reasons.values())
    verdict = _verdict(model, reasons, {})
    assert verdict.status == "rescan"
    assert verdict.missing
    assert all(part.endswith("_left") for part in verdict.missing)


def test_an_arm_that_the_fit_put_into_the_trunk_is_named(model: BodyModel) -> None:
    assert arms_inside(model, model.mean) == {}
    twists = np.zeros((model.part_count, 3))
    for arms in (("left",), ("left", "right")):
        for side in arms:
            sign = 1.0 if side == "left" else -1.0
            twists[model.part_names.index(f"upper_arm_{side}"), 1] = sign * np.radians(60.0)
        state = replace(model.neutral_state(), rotations=model.absolute_rotations(twists))
        verdict = _verdict(model, {}, {}, arms_inside(model, model.vertices(state)))
        assert verdict.status == "rescan"
        # Of two arms it said that too much of the scan did not match a body.
        assert len(verdict.reasons) == len(arms)
        assert "forearm was not found" in verdict.reasons[0]
        parts = ("upper_arm", "forearm", "hand")
        assert set(verdict.missing) == {f"{part}_{side}" for part in parts for side in arms}


def test_a_hand_alone_in_the_trunk_is_an_arm_that_was_not_found(model: BodyModel) -> None:
    """A forearm in a dark sleeve was bent to the trunk, a quarter of it inside: the scan was ok,
    and the forearm 22 cm off."""
    twists = np.zeros((model.part_count, 3))
    twists[model.part_names.index("forearm_right")] = (0.0, 0.0, np.radians(90.0))
    state = replace(model.neutral_state(), rotations=model.absolute_rotations(twists))
    vertices = model.vertices(state)
    assert shares_inside(model, vertices, [["forearm_right"]])[0] < 0.3
    verdict = _verdict(model, {"": "80 cm2 of the scan"}, {}, arms_inside(model, vertices))
    # What lies beside the body may be the arm itself.
    assert verdict.reasons == (
        "the right forearm was not found: hold both arms away from the body",
    )
    assert {"forearm_right", "hand_right"} <= set(verdict.missing)


def _rotations(model: BodyModel, part: str, twist: tuple[float, float, float]) -> Array:
    twists = np.zeros((model.part_count, 3))
    twists[model.part_names.index(part)] = twist
    return model.absolute_rotations(twists)


def test_a_head_bent_onto_the_chest_was_not_found(model: BodyModel) -> None:
    """Without a reading of the head the fit bent the neck to the stump, and all of it was seen."""
    assert head_turned(model, _rotations(model, "neck", (-0.4, 0.1, 0.0))) == {}
    lost = head_turned(model, _rotations(model, "neck", (-1.0, 0.3, 0.0)))
    verdict = _verdict(model, {}, {}, lost)
    assert verdict.reasons == (
        "the head was not found: look straight ahead, with thick hair tied up or covered",
    )
    assert verdict.missing == ("head",)


def test_a_lean_is_a_reason(model: BodyModel) -> None:
    root = model.part_names[int(np.flatnonzero(model.part_parents < 0)[0])]
    assert leaning(model, _rotations(model, root, (0.1, 0.0, 2.0))) == []
    (finding,) = leaning(model, _rotations(model, root, (0.5, 0.0, 0.0)))
    assert finding.message == "the person leans by 29 degrees: stand upright"


def test_readings_that_scatter_are_the_reason_where_there_is_no_other(model: BodyModel) -> None:
    scatter = "the readings lie 12 mm from the body; "
    cameras = {"front-lower": 0.0}
    for stature_m, shifts, first in (
        (1.75, cameras, scatter + "run: station check"),
        (1.75, {}, scatter + "clean the cloud"),
        (1.0, cameras, "the person is 1.00 m tall"),
    ):
        sides, beta = {"front": 0.9, "back": 0.9}, np.zeros(model.beta_count)
        verdict = judge((), sides, (), {}, stature_m, beta, shifts, 0.0123)
        assert len(verdict.reasons) == 1
        assert verdict.reasons[0].startswith(first)


def test_what_hangs_on_a_missing_part_is_missing(model: BodyModel) -> None:
    sides = {"front": 0.9, "back": 0.9}
    parts = [PartReport("thigh_right", 0.1, 1e-3), PartReport("shin_right", 0.4, 1e-3)]
    verdict = judge(parts, sides, (), {}, 1.75, np.zeros(model.beta_count), {"a": 0.0}, 1e-3)
    assert set(verdict.missing) == {"thigh_right", "shin_right", "foot_right"}


def test_who_seems_short_without_feet_is_told_of_the_feet_first(model: BodyModel) -> None:
    sides = {"front": 0.9, "back": 0.9}
    for coverage, stature_m, at in ((0.0, 1.28, 1), (0.9, 1.28, 0), (0.0, 2.31, 0)):
        parts = [PartReport("foot_left", coverage, 1e-3)]
        verdict = judge(parts, sides, (), {}, stature_m, np.zeros(model.beta_count), {}, 1e-3)
        assert verdict.reasons[at].startswith(f"the person is {stature_m} m tall")
        assert len(verdict.reasons) == 1 + (coverage == 0.0)


def test_what_is_no_person_is_told_before_its_missing_parts(model: BodyModel) -> None:
    sides = {"front": 0.9, "back": 0.9}
    parts = [PartReport("foot_left", 0.0, 1e-3)]
    verdict = judge(parts, sides, (), {}, 1.28, np.full(model.beta_count, 9.0), {}, 1e-3)
    nobody, unseen, short = verdict.reasons
    assert nobody == "what stands in the booth does not look like a person"
    assert "left foot" in unseen
    assert short.startswith("the person is 1.28 m tall")


def test_a_half_seen_part_next_to_an_unseen_one_is_missing(model: BodyModel) -> None:
    """A forearm was 150 mm off: the points on a quarter of it were those of the elbow."""
    names = ("upper_arm_left", "forearm_left", "hand_left")
    parts = [
        PartReport(name, share, 1e-3) for name, share in zip(names, (0.9, 0.3, 0.0), strict=True)
    ]
    sides = {"front": 0.9, "back": 0.9}
    verdict = judge(parts, sides, (), {}, 1.75, np.zeros(model.beta_count), {}, 1e-3)
    assert verdict.reasons == ("nothing of the left hand was seen",)
    assert set(verdict.missing) == {"forearm_left", "hand_left"}
    # Readings beside the body are the missing limb's.
    beside = {"": "338 cm2 of the scan do not belong to the person"}
    verdict = judge(parts, sides, (), beside, 1.75, np.zeros(model.beta_count), {}, 1e-3)
    assert set(verdict.missing) == set(names)


def test_a_part_far_from_its_points_is_missing_in_a_bad_scan_alone(model: BodyModel) -> None:
    """A second scan of a sound person with odd hands would show the same."""
    sides = {"front": 0.9, "back": 0.9}
    for coverage, missing in ((0.9, ()), (0.0, ("hand_right", "hand_left"))):
        parts = [PartReport("hand_left", 0.3, 6.5e-3), PartReport("hand_right", coverage, 1e-3)]
        verdict = judge(parts, sides, (), {}, 1.75, np.zeros(model.beta_count), {}, 1e-3)
        assert set(verdict.missing) == set(missing)


def test_many_unseen_parts_are_counted(model: BodyModel) -> None:
    parts = [PartReport(name, 0.05, 1e-3) for name in model.part_names[:8]]
    verdict = judge(parts, {}, (), {}, 1.75, np.zeros(model.beta_count), {}, 1e-3)
    assert verdict.reasons == ("the cloud hardly shows 8 of 8 parts of the body",)
    assert set(verdict.missing) >= {part.name for part in parts}


def test_two_limbs_that_do_not_match_leave_nothing_to_measure(model: BodyModel) -> None:
    """A person who was fitted the wrong way round: only the feet lay beside the scan."""
    parts = [PartReport(name, 0.9, 1e-3) for name in ("chest", "forearm_right", "foot_left")]
    sides = {"front": 0.9, "back": 0.9}
    feet = {
        f"foot_{side}": f"the {side} foot does not match the scan" for side in ("left", "right")
    }
    for lost, everything in ((feet, True), ({"foot_left": feet["foot_left"]}, False)):
        verdict = judge(parts, sides, (), lost, 1.75, np.zeros(model.beta_count), {}, 1e-3)
        assert ({"chest", "forearm_right"} <= set(verdict.missing)) == everything
        assert "foot_left" in verdict.missing
        whole = "too much of the scan does not match a body: nothing can be measured"
        assert verdict.reasons[0].startswith(whole) == everything
        assert ("stands on its head" in verdict.reasons[0]) == everything
    assert "head" not in _verdict(model, feet, {"front-upper": 0.001}).reasons[0]


def test_folds_and_stray_readings_are_no_lost_limb(model: BodyModel) -> None:
    """A fold of 25 mm, 3 cm long and 1 cm wide, and readings scattered over the booth."""
    cloud = _scan_of(model, model.mean)
    navel = cloud.points[np.argmin(np.linalg.norm(cloud.points - (0.0, -0.2, 1.0), axis=1))]
    away = np.abs(cloud.points - navel)
    fold = (away[:, 0] < 0.015) & (away[:, 2] < 0.005)
    points = cloud.points - 0.025 * fold[:, None] * cloud.normals
    rng = np.random.default_rng(4)
    stray = rng.choice(len(points), 60, replace=False)
    points[stray] = rng.uniform((-0.8, -0.7, 0.0), (0.8, 0.7, 2.0), (60, 3))
    patches = unmatched_patches(model, model.mean, replace(cloud, points=points))
    assert patches
    assert lost_parts(model, patches) == {}


@pytest.mark.parametrize(("radius_m", "widened"), [(0.028, True), (0.013, False)])
def test_a_small_patch_widens_the_skin_beside_it(
    model: BodyModel, radius_m: float, widened: bool
) -> None:
    """25 cm^2 do, 5 cm^2 are a fold or stray readings."""
    cloud = _scan_of(model, model.mean)
    navel = cloud.points[np.argmin(np.linalg.norm(cloud.points - (0.0, -0.2, 1.0), axis=1))]
    fold = np.linalg.norm(cloud.points - navel, axis=1) < radius_m
    points = cloud.points - 0.022 * fold[:, None] * cloud.normals
    patches = unmatched_patches(model, model.mean, replace(cloud, points=points))
    sigma_m = patch_sigma_m(model, patches)
    away = np.linalg.norm(model.mean - navel, axis=1)
    if widened:
        assert (sigma_m[away < 0.010] > 0.012).all()
        assert (sigma_m[away > 0.2] == 0.0).all()
    else:
        assert (sigma_m == 0.0).all()
    assert lost_parts(model, patches) == {}


def test_a_person_of_whom_one_side_is_missing_is_not_measured(model: BodyModel) -> None:
    parts = [PartReport("abdomen", 0.48, 1e-3), PartReport("hand_left", 0.85, 1e-3)]
    sides = {"front": 0.9, "back": 0.002}
    found = judge(parts, sides, (), {}, 1.75, np.zeros(model.beta_count), {}, 1e-3)
    assert found.status == "rescan"
    assert found.reasons == ("nothing of the person's back was seen",)
    assert found.missing == ("abdomen",)


def test_a_person_whose_left_side_is_missing_is_not_measured(model: BodyModel) -> None:
    """A leg beside the other one may be seen even so: the trunk says that half of it is missing."""
    parts = [PartReport("abdomen", 0.55, 1e-3), PartReport("thigh_left", 0.3, 1e-3)]
    sides = {"front": 0.7, "back": 0.7, "left side": 0.5, "right side": 0.8}
    found = judge(parts, sides, (), {}, 1.75, np.zeros(model.beta_count), {}, 1e-3)
    # It was said of cameras also where there are none: of a bare cloud.
    assert found.reasons == ("the cloud shows only 50 % of the person's left side",)
    booth = judge(parts, sides, (), {}, 1.75, np.zeros(model.beta_count), {"a": 0.0}, 1e-3)
    assert booth.reasons == ("the cameras saw only 50 % of the person's left side",)
    assert found.missing == ("abdomen", "thigh_left")


def test_something_beside_the_person_is_no_limb(model: BodyModel) -> None:
    cloud = _scan_of(model, model.mean)
    box = cloud.points[:, 2] < 0.25
    beside = np.where(box[:, None], cloud.points + np.array([0.9, 0.0, 0.0]), cloud.points)
    reasons = lost_parts(model, unmatched_patches(model, model.mean, replace(cloud, points=beside)))
    assert len(reasons) == 1
    assert "take other things out of the booth" in reasons[""]


def test_a_camera_a_few_millimetres_off_is_a_note(model: BodyModel) -> None:
    """A second scan would show it again."""
    assert _verdict(model, {}, {"front-upper": 0.0015}).notes == ()
    noted = _verdict(model, {}, {"front-upper": 0.0031})
    assert noted.status == "ok"
    assert "front-upper has moved by 3 mm" in noted.notes[0]
    unusable = _verdict(model, {}, {"front-upper": 0.0052})
    assert unusable.status == "rescan"
    assert unusable.notes == ()


@pytest.mark.parametrize(
    ("around", "told"),
    [((0.0, 0.13, -0.02), []), ((0.0, -0.09, -0.13), []), ((0.0, 0.09, -0.16), ["neck"])],
    ids=["bun", "beard", "on the neck"],
)
def test_hair_is_told_from_a_lost_head(
    model: BodyModel, around: tuple[float, float, float], told: list[str]
) -> None:
    """A ball of hair of 5 cm beside a head in its place, and beside one that is 5 cm too low."""
    skin = _scan_of(model, model.mean)
    head = model.of_parts(("head",))
    middle = 0.5 * (model.mean[head].min(axis=0) + model.mean[head].max(axis=0))
    outwards = np.random.default_rng(2).standard_normal((3000, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    count = len(skin) + len(outwards)
    cloud = PointCloud(
        np.concatenate([skin.points, middle + around + 0.05 * outwards]),
        np.concatenate([skin.normals, outwards]),
        np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",),
    )  # fmt: skip
    for lower_m, expected in ((0.0, told), (0.05, ["head"])):
        fitted = model.mean - lower_m * head[:, None] * (0.0, 0.0, 1.0)
        patches = unmatched_patches(model, fitted, cloud)
        lost = lost_parts(model, patches, hair_of(model, patches, fitted, cloud))
        assert set(lost) >= set(expected)
        assert bool(lost) == bool(expected)
