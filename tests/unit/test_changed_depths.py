"""Depths that changed since the calibration, by laws that the estimate does not assume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView, static_view
from station.calibration.moves.depths import ChangedDepths, SeenDepths, changed_depths
from station.calibration.moves.look import Look, compared
from station.calibration.moves.motion import depths_words
from station.calibration.moves.reference import DriftReference
from station.core.depth.correction import DepthCorrection
from station.core.depth.field import DepthField
from station.core.geometry import se3_exp
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import PredictedError
from station.simulation.noise import UnitError, observe
from station.simulation.scene import VirtualScene, booth_walls, default_rig, load_mesh

RIG = default_rig()
BODY = load_mesh(Path(__file__).parents[2] / "station/simulation/bodies/ben.npz")
UNIT = UnitError(0.008, (0.2, -0.1), frozen_share=0.5, frozen_seed=(3,))
SHARES = dict(zip(RIG.cameras, (0.7, 1.3, 0.9, 1.1), strict=True))
"""Each unit's change as a share of all units'."""
MOVED = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -0.003]))
"""A camera that was pushed back: a wall seems 0.1 % farther away."""


@pytest.fixture(scope="module")
def calibrated() -> dict[str, tuple[DriftReference, StaticView]]:
    found = {}
    for name, camera in RIG.cameras.items():
        view = VirtualScene(booth_walls()).view(camera, camera.world_from_camera)
        rng = np.random.default_rng(1)
        empty = static_view((TABLE[observe(view, UNIT, rng)] for _ in range(20)), DEPTH_SCALE_M)
        found[name] = DriftReference.prepare(camera, empty), empty
    return found


PUSHED = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -0.010]))


def _looks(
    calibrated: dict[str, tuple[DriftReference, StaticView]],
    share: float,
    power: int = 0,
    moved: str = "",
    by: NDArray[np.float64] = MOVED,
) -> dict[str, Look]:
    """Somebody stands in a booth whose sensors are warmer than they were."""
    looks = {}
    for name, camera in RIG.cameras.items():
        pose = camera.world_from_camera @ (by if name == moved else np.eye(4))
        view = VirtualScene((*booth_walls(), BODY)).view(camera, pose)
        unit = replace(UNIT, warmth=(share * SHARES[name], power))
        rng = np.random.default_rng(2)
        frames = [TABLE[observe(view, unit, rng)] for _ in range(10)]
        looks[name] = Look.of(*calibrated[name], frames, DEPTH_SCALE_M)
    return looks


@pytest.mark.parametrize(("power", "share"), [(-1, 1.5e-3), (0, -2.5e-3), (1, 1.5e-3)])
def test_a_body_is_put_where_it_stands_whatever_the_law(
    calibrated: dict[str, tuple[DriftReference, StaticView]], share: float, power: int
) -> None:
    """Girths were 5 to 18 mm off, stated to 6."""
    looks = _looks(calibrated, share, power)
    changed, moves = compared(looks, RIG.cameras)
    assert changed is not None
    assert np.sign(changed.at_walls) == np.sign(share)
    assert not any(move.moved for move in moves)
    off_m, left_m = [], []
    for name, law in changed.laws.items():
        warm_m = 1.7 + UnitError(warmth=(share * SHARES[name], power)).offset_m(0.0, 0.0, 1.7)
        corrected_m = 1.0 / DepthCorrection().after(law).inverse_at(
            np.array([1.0 / warm_m]), *np.zeros((2, 1))
        )
        off_m.append(warm_m - 1.7)
        left_m.append(corrected_m[0] - 1.7)
    left = np.sqrt(np.mean(np.square(left_m)))
    assert left < 0.4 * np.sqrt(np.mean(np.square(off_m)))
    assert left < 1.5 * changed.sigma_m


def test_sensors_as_they_were_change_nothing(
    calibrated: dict[str, tuple[DriftReference, StaticView]],
) -> None:
    changed, _ = compared(_looks(calibrated, 0.0), RIG.cameras)
    assert changed is None


@pytest.mark.parametrize("share", [0.0, 1.5e-3])
def test_a_camera_that_was_pushed_back_does_not_speak_for_all(
    calibrated: dict[str, tuple[DriftReference, StaticView]], share: float
) -> None:
    looks = _looks(calibrated, share, moved="front-lower")
    changed, _ = compared(looks, RIG.cameras)
    assert (changed is None) == (share == 0.0)
    alone = {name: looks[name] for name in ("front-lower", "back-lower")}
    assert compared(alone, RIG.cameras)[0] is None


@pytest.mark.parametrize("share", [0.0, 1e-3])
def test_a_camera_that_was_pushed_back_is_named_though_depths_changed(
    calibrated: dict[str, tuple[DriftReference, StaticView]], share: float
) -> None:
    """A change of its own depths explained 10 mm, and no move was left."""
    looks = _looks(calibrated, share, moved="front-lower", by=PUSHED)
    _, moves = compared(looks, RIG.cameras)
    assert [move.camera for move in moves if move.moved] == ["front-lower"]


def test_one_camera_alone_does_not_tell_that_depths_changed(
    calibrated: dict[str, tuple[DriftReference, StaticView]],
) -> None:
    """In a booth of one camera, one that was pushed back by 15 mm passed for a warm one."""
    looks = _looks(calibrated, 0.0, moved="front-lower", by=PUSHED)
    changed, [move] = compared({"front-lower": looks["front-lower"]}, ["front-lower"])
    assert changed is None
    assert move.moved


def test_a_camera_that_sees_nothing_of_the_booth_changes_as_the_others_do(
    calibrated: dict[str, tuple[DriftReference, StaticView]],
) -> None:
    looks = _looks(calibrated, 1.5e-3)
    looks["front-lower"] = replace(looks["front-lower"], depths=None)
    changed, _ = compared(looks, RIG.cameras)
    assert changed is not None
    change = np.polynomial.polynomial.polyval(1.0 / 1.7, changed.laws["front-lower"]) * 1.7
    assert change == pytest.approx(1.5e-3, rel=0.4)


@pytest.mark.parametrize(("at_body", "agree"), [(6e-4, True), (-1e-3, False), (3e-3, False)])
def test_cameras_that_were_all_turned_a_little_show_no_change(at_body: float, agree: bool) -> None:
    """Floors seemed nearer or farther away, and bodies were to be shifted by 5 mm."""
    walls_and_body = np.stack([0.3 ** (np.arange(3.0) - 1.0), 1.7 ** (1.0 - np.arange(3.0))])
    sure = 1e10 * walls_and_body.T
    seen = SeenDepths(3e-4, sure @ walls_and_body, sure @ [3e-4, at_body])
    assert (changed_depths(dict.fromkeys(RIG.cameras, seen)) is not None) == agree


def test_a_large_change_is_told_as_one_that_no_scan_is_taken_with() -> None:
    changed = ChangedDepths(-5e-3, {}, 1e-3)
    assert changed.too_large
    assert "all cameras see everything nearer" in changed.words()
    assert depths_words([]) is None


def test_the_corrected_calibration_states_larger_errors() -> None:
    said = replace(RIG, predicted=PredictedError(1e-3, 1e-3, 2e-4, 1e-3))
    law = np.array([1e-4, -2e-3, 1e-3])
    corrected = ChangedDepths(1e-3, {"back-upper": law}, 5e-4).corrected(said)
    assert list(corrected.cameras) == list(RIG.cameras)
    assert corrected.cameras["front-lower"] is said.cameras["front-lower"]
    assert corrected.predicted is not None
    assert corrected.predicted.girth_sigma_m > 1.5e-3
    assert ChangedDepths(1e-3, {}, 5e-4).corrected(RIG).predicted is None


@pytest.mark.parametrize("model", ["none", "polynomial", "long", "field"])
def test_a_correction_after_a_change_is_the_one_of_what_was_read_before(model: str) -> None:
    rng = np.random.default_rng(0)
    field = DepthField((0.3, 0.5, 1.0), rng.normal(0.0, 1e-3, (3, 4, 5)))
    correction = {
        "none": DepthCorrection(),
        "polynomial": DepthCorrection((1e-3, 0.998, 2e-3), (1e-3, -2e-3)),
        "long": DepthCorrection((1e-3, 0.998, *[1e-5] * 8)),
        "field": DepthCorrection((1e-3, 0.998, 2e-3), (1e-3, -2e-3), field),
    }[model]
    now, (x, y) = rng.uniform(0.25, 1.2, 50), rng.uniform(-1.0, 1.0, (2, 50))
    before = now + 2e-3 + 3e-3 * now - 4e-3 * now**2
    expected = correction.inverse_at(before, x, y)
    changed = DepthCorrection.from_json(correction.after([2e-3, 3e-3, -4e-3]).to_json())
    assert changed.inverse_at(now, x, y) == pytest.approx(expected, abs=2e-5)
