"""Errors that a calibration states of itself: widened, refused, and carried to the measurements."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from station.calibration.adjust.problem import Sightings
from station.calibration.detect.coverage import Coverage
from station.calibration.solve.acceptance import HeldOut, held_out_seconds, widen_by_test
from station.calibration.solve.refusals import BOARD_WORDS, STAND_WORDS, Limits, check_predicted
from station.calibration.solve.solution import Solution
from station.calibration.solve.world import WorldPoses
from station.core.errors import CalibrationError
from station.core.kinect_v1 import INDEPENDENT_HZ
from station.core.rig import PredictedError
from station.simulation.scene import default_rig
from workers.export.stopwatch import Stopwatch
from workers.measure.scan_errors import ScanErrors
from workers.reconstruct import job
from workers.scape.verdict.clothes import Clothing
from workers.scape.verdict.unmatched import Patch

SAID = PredictedError(1e-3, 1.5e-3, 0.5e-3, 2e-4)
RMS_M, SECONDS = 2e-3, 16


def _held_out(mean_m: float) -> HeldOut:
    return HeldOut(int(SECONDS * INDEPENDENT_HZ), RMS_M, np.array([mean_m, 0.0, 0.0]))


def _waved(name: str, times_s: list[float]) -> Sightings:
    count = len(times_s)
    flat = np.ones((count, 1))
    pixels = np.ones((count, 1, 2))
    return Sightings(name, np.array(times_s), np.ones((count, 3)), pixels, flat, flat, 0.0 * pixels)


def test_every_camera_is_tested_however_rarely_it_saw_the_ball_with_others() -> None:
    often = list(np.arange(0.0, 20.0, 0.05))
    rarely = [*np.arange(2.0, 3.0, 0.05), *np.arange(7.1, 7.5, 0.05), *np.arange(11, 12, 0.04)]
    waved = {"a": _waved("a", often), "b": _waved("b", often)}
    assert held_out_seconds(waved).tolist() == [4, 9, 14, 19]
    waved["c"] = _waved("c", rarely)
    assert held_out_seconds(waved).tolist() == [2, 4, 9, 14, 19]
    waved["c"] = _waved("c", [second + 0.1 * i for second in range(3) for i in range(5)])
    assert held_out_seconds(waved).tolist() == [0, 1, 2, 4, 9, 14, 19]


def test_seconds_in_which_one_camera_alone_saw_the_ball_test_nothing() -> None:
    early, late = list(np.arange(0.0, 10.0, 0.05)), list(np.arange(5.0, 15.0, 0.05))
    assert held_out_seconds({"a": _waved("a", early), "b": _waved("b", late)}).tolist() == [9]


def test_offsets_within_their_own_noise_widen_nothing() -> None:
    noise_m = RMS_M / np.sqrt(SECONDS)
    assert widen_by_test(SAID, {"a": _held_out(0.99 * noise_m), "b": _held_out(0.0)}) == SAID


def test_offsets_beyond_their_noise_widen_what_is_said() -> None:
    found = widen_by_test(SAID, {name: _held_out(2e-3) for name in "ab"})
    unknown_m = np.sqrt((2e-3**2 - RMS_M**2 / SECONDS) / 6.0)
    assert found.height_sigma_m == pytest.approx(np.hypot(unknown_m, SAID.height_sigma_m))
    assert found.girth_sigma_m == pytest.approx(np.hypot(np.pi * unknown_m, SAID.girth_sigma_m))
    assert found.normal_rms_m == pytest.approx(np.hypot(unknown_m, SAID.normal_rms_m))
    assert found.tilt_sigma_rad == SAID.tilt_sigma_rad


def _nothing_seen() -> Coverage:
    return Coverage(default_rig().cameras, "front-upper", 0.1)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (Limits(height_m=1.9e-3), "heights could be wrong by up to 2.0 mm, but the limit is 2 mm"),
        (Limits(girth_m=2.9e-3), "girths could be wrong by up to 2.9 mm, but the limit is 3 mm"),
    ],
)
def test_what_could_spoil_sizes_is_refused(limits: Limits, words: str) -> None:
    check_predicted(SAID, Limits(), _nothing_seen(), heights_m=(), boarded=False)
    with pytest.raises(CalibrationError) as raised:
        check_predicted(SAID, limits, _nothing_seen(), heights_m=(), boarded=False)
    assert words in str(raised.value)
    assert (STAND_WORDS if "heights" in words else BOARD_WORDS) in str(raised.value)


def test_whoever_used_a_stand_is_not_told_to() -> None:
    with pytest.raises(CalibrationError) as raised:
        check_predicted(
            SAID, Limits(height_m=1e-3), _nothing_seen(), heights_m=(0.9, 1.7), boarded=True
        )
    assert "stand" not in str(raised.value).replace("understand", "")
    assert "wave the ball longer" in str(raised.value)


@pytest.mark.parametrize("predicted", [None, SAID])
def test_a_job_tells_the_measurements(
    monkeypatch: pytest.MonkeyPatch, predicted: PredictedError | None
) -> None:
    told: list[ScanErrors] = []

    def measure(*arguments: Any) -> str:
        told.append(arguments[-1])
        return "measured"

    monkeypatch.setattr(job, "measure_body", measure)
    monkeypatch.setattr(job, "measure_standing", measure)
    for skin in ("patch_sigma_m", "hidden_head_sigma"):
        monkeypatch.setattr(job, skin, lambda *_: np.zeros(3))
    monkeypatch.setattr(job, "cover_sigma_m", lambda *_: None)
    monkeypatch.setattr(job, "floor_sigma_m", lambda cloud: cloud.floor_sigma_m)
    surface = SimpleNamespace(sigma_m=np.zeros(3), seen=np.ones(3, bool))
    patches, clothing = Future[tuple[Patch, ...]](), Future[list[Clothing]]()
    patches.set_result(())
    clothing.set_result([])
    fit = SimpleNamespace(
        surface=surface,
        crown_sigma_m=3e-3,
        head_cover_m=0.0,
        patches=patches,
        clothing=clothing,
        vertices=np.zeros((3, 3)),
        state=None,
        cloud=SimpleNamespace(floor_sigma_m=5e-4, excess_noise_m=2.6e-3),
    )
    with ThreadPoolExecutor(1) as beside:
        job._measuring(beside, cast(Any, None), cast(Any, fit), predicted, Stopwatch())
    sizes = (5e-4, 0.0) if predicted is None else (SAID.height_sigma_m, SAID.girth_sigma_m)
    assert [(one.height_sigma_m, one.girth_sigma_m) for one in told] == [sizes, sizes]
    assert {(one.crown_sigma_m, one.excess_noise_m) for one in told} == {(3e-3, 2.6e-3)}


@pytest.mark.parametrize("heights_m", [(1.7,), (1.75, 1.8)], ids=["stand", "stand and hook"])
def test_whoever_showed_one_height_is_asked_for_two(heights_m: tuple[float, ...]) -> None:
    """The advice was to wave longer, which does not help."""
    with pytest.raises(CalibrationError, match="show the ball at two measured heights, not one"):
        check_predicted(
            SAID, Limits(height_m=1e-3), _nothing_seen(), heights_m=heights_m, boarded=True
        )


def test_the_vertical_is_told_as_calibration_json_has_it() -> None:
    """The floor's own scatter was told, a third of what the file says where nothing hung."""
    said = replace(SAID, tilt_sigma_rad=np.radians(0.18))
    poses = WorldPoses({}, np.zeros((0, 0)), 0.1, np.radians(0.06))
    rig = replace(default_rig(), predicted=said)
    told = Solution(rig, poses, {}, (), {}, 0.1).summary()
    assert "what is vertical is known to within 0.18 degrees" in told
