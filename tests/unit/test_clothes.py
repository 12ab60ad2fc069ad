"""Signs of clothing on a surface."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from workers.cloud.observed import PointCloud
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.verdict.clothes import (
    Clothing,
    clothing_reasons,
    clothing_remarks,
    clothing_signs,
    is_worn,
)
from workers.scape.verdict.seen import TRUNK

Array = NDArray[np.float64]
ARMS = ("upper_arm_left", "upper_arm_right")
SLEEVED = (*TRUNK, "shoulder_left", "shoulder_right")


def signs_of(
    model: BodyModel, thicker_m: Array, unseen: NDArray[np.bool_] | None = None
) -> list[Clothing]:
    """Signs in a scan of the mean body whose skin lies so much (P,) farther out."""
    faces, weights = (
        model.faces,
        np.random.default_rng(3).dirichlet(np.ones(3), (4, len(model.faces))),
    )
    normals = vertex_normals(model.mean, faces)
    surface = model.mean + thicker_m[:, None] * normals
    points = np.einsum("kfi,fid->kfd", weights, surface[faces]).reshape(-1, 3)
    directions = np.tile(normals[faces[:, 0]], (4, 1))
    count = len(points)
    cloud = PointCloud(
        points, directions, np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )
    rotations = np.tile(np.eye(3), (len(model.part_names), 1, 1))
    seen = np.ones(model.vertex_count, bool) if unseen is None else ~unseen
    fitted = SimpleNamespace(vertices=surface, seen=seen)
    return clothing_signs(model, model.mean, rotations, fitted, cloud)  # type: ignore[arg-type]


def sleeve(model: BodyModel, side: str) -> NDArray[np.bool_]:
    """The upper half of an upper arm."""
    arm = model.of_parts((f"upper_arm_{side}",))
    outwards = model.mean[model.landmarks[f"elbow_{side}"]] - model.mean[arm].mean(axis=0)
    along = model.mean @ outwards
    return np.asarray(arm & (along < np.median(along[arm])))


def test_a_shirt_ends_at_both_upper_arms(model: BodyModel) -> None:
    shirt = model.of_parts(SLEEVED) | sleeve(model, "left") | sleeve(model, "right")
    found = signs_of(model, np.where(shirt, 0.015, 0.0))
    (arms,) = (sign for sign in found if sign.at == "upper_arm")
    assert arms.is_sure
    assert {*SLEEVED, *ARMS} <= set(arms.covered)
    assert not {"head", "hand_left", "thigh_left"} & set(arms.covered)
    assert arms.thickness_m > 0.015


def test_what_bodies_have_is_no_clothing(model: BodyModel) -> None:
    """One bandaged arm; flesh that hangs over a waistband in front; muscles on both arms."""
    height, ahead = model.mean[:, 2], -vertex_normals(model.mean, model.faces)[:, 1]
    waist = 0.5 * sum(height[model.landmarks[f"waist_{side}"]] for side in ("front", "back"))
    apron = model.of_parts(TRUNK) & (height > waist - 0.10) & (ahead > 0.3)
    middle = {s: np.median(height[model.of_parts((f"upper_arm_{s}",))]) for s in ("left", "right")}
    muscles = np.zeros(model.vertex_count)
    for side, level in middle.items():
        arm = model.of_parts((f"upper_arm_{side}",))
        muscles += 0.010 * arm * np.exp(-0.5 * ((height - level) / 0.04) ** 2)
    for thicker in (0.015 * sleeve(model, "left"), 0.025 * apron, muscles):
        assert signs_of(model, np.asarray(thicker)) == []


def test_what_hangs_down_to_the_crotch_is_one_sign(model: BodyModel) -> None:
    """A belly over the tops of the thighs was a sign of the trunk and one of the legs."""
    height = model.mean[:, 2]
    trunk = model.of_parts((*TRUNK, "thigh_left", "thigh_right"))
    low = height[model.landmarks["crotch"]]
    found = signs_of(model, np.where(trunk & (height > low), 0.012, 0.0))
    assert [sign.at for sign in found] == ["pelvis", "pelvis"]
    assert "thigh_left" in found[1].covered
    assert not is_worn(found, [])


@pytest.mark.parametrize("press_m", [0.003, 0.008])
def test_a_band_that_presses_into_flesh_is_no_clothing(model: BodyModel, press_m: float) -> None:
    """Briefs, a bra and grippers of cycling shorts, with the flesh above and below them."""
    height = model.mean[:, 2]
    at = {name: height[vertex] for name, vertex in model.landmarks.items()}
    thighs = model.of_parts(("thigh_left", "thigh_right"))
    deeper = np.zeros(model.vertex_count)
    for parts, level in (
        (model.of_parts(TRUNK), 0.5 * (at["waist_front"] + at["crotch"])),
        (model.of_parts(TRUNK), at["underbust_left"]),
        (thighs, 0.5 * (at["crotch"] + at["knee_left"])),
    ):
        away = np.abs(height - level)
        bulge = 0.7 * np.exp(-0.5 * ((away - 0.035) / 0.012) ** 2)
        deeper += parts * (np.where(away < 0.02, 1.0, 0.0) - np.where(away < 0.02, 0.0, bulge))
    assert signs_of(model, -press_m * deeper) == []


def test_hips_are_compared_with_what_was_seen(model: BodyModel) -> None:
    """Hips of 6 mm passed for loose where shins gave no readings, however the rest was."""
    height, ahead = model.mean[:, 2], model.mean[:, 1]
    folds = np.sin(height / 0.03) * np.sin(ahead / 0.03)
    unseen = model.of_parts(("shin_left", "shin_right"))
    hips = model.of_parts(("pelvis",))
    found = signs_of(model, np.where(hips, 0.012, 0.010) * folds, unseen)
    assert "pelvis" not in [sign.at for sign in found]


def test_an_edge_around_both_arms_above_bare_hips_is_flesh(model: BodyModel) -> None:
    """Muscles and lipoedema have edges of 4 to 5 mm there."""
    cuffs = np.where(sleeve(model, "left") | sleeve(model, "right"), 0.006, 0.0)
    assert signs_of(model, cuffs) == []
    shirt = np.where(model.of_parts(("pelvis",)), 0.008, cuffs)
    assert [sign.at for sign in signs_of(model, shirt) if sign.at == "upper_arm"] == ["upper_arm"]


def test_cloth_that_hangs_over_the_hips_may_be_clothing(model: BodyModel) -> None:
    """It has no edge, but folds that no other part has."""
    height, ahead = model.mean[:, 2], model.mean[:, 1]
    folds = np.sin(height / 0.03) * np.sin(ahead / 0.03)
    hips = model.of_parts(("pelvis",))
    (sign,) = signs_of(model, np.where(hips, 0.012 * folds, 0.001 * folds))
    assert sign.at == "pelvis"
    everywhere = np.where(hips, 0.024, 0.020) * folds
    assert "pelvis" in [sign.at for sign in signs_of(model, everywhere)]


def test_one_sign_is_remarked_and_two_are_a_reason() -> None:
    hips = Clothing("pelvis", (*TRUNK, "thigh_left"), 0.02)
    belly = Clothing("abdomen", TRUNK, 0.03)
    arms = Clothing("upper_arm", (*TRUNK, *ARMS), 0.02)
    assert not is_worn([], ["pelvis"])
    assert not is_worn([hips], ["head"])
    assert not is_worn([hips, belly], ["abdomen"])
    assert is_worn([hips], ["thigh_left"])
    assert not is_worn([arms], [])
    assert is_worn([hips, arms], [])
    assert is_worn([replace(arms, is_sure=True)], [])
    assert clothing_reasons([]) == []
    assert clothing_reasons([arms, hips]) == [
        "loose clothing hides the body, as seen at the upper arms: take it off, or wear something "
        "close-fitting"
    ]
    thicker = Clothing("pelvis", TRUNK, 0.03)
    assert clothing_remarks([hips, thicker]) == [
        "clothing may lie up to 30 mm off the skin at the hips: if any is loose there, take it off "
        "and scan again"
    ]


@pytest.mark.parametrize("side", ["left", "right"])
def test_nothing_seen_of_a_side_is_no_clothing(model: BodyModel, side: str) -> None:
    """Half a cloud has no edges around both limbs, and does not fail."""
    sign = 1.0 if side == "left" else -1.0
    points = model.mean[sign * model.mean[:, 0] > 0.02]
    count = len(points)
    cloud = PointCloud(
        points, np.zeros((count, 3)), np.full(count, 1e-3), np.zeros(count, np.int16), ("cloud",)
    )
    rotations = np.tile(np.eye(3), (len(model.part_names), 1, 1))
    seen = sign * model.mean[:, 0] > 0.02
    fitted = SimpleNamespace(vertices=model.mean, seen=seen)
    assert clothing_signs(model, model.mean, rotations, fitted, cloud) == []  # type: ignore[arg-type]
