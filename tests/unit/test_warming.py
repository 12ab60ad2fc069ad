"""Sensors that warm up while a booth is calibrated make girths wrong by millimetres unseen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from seen_balls import CAMERAS, ball

from station.calibration.detect.scene import StaticView, static_view
from station.calibration.detect.step_names import EMPTY, MARK
from station.calibration.detect.warmth import depth_change
from station.calibration.guide.session import JOURNAL, Session
from station.calibration.solve.warming import check_warm, warming_words, widen_by_warming
from station.core.errors import CalibrationError, FormatError
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import PredictedError
from station.simulation.noise import TrueView, UnitError, observe
from station.simulation.scene import (
    VirtualScene,
    booth_walls,
    chair,
    default_rig,
    fixed_posts,
    load_mesh,
)

CAMERA = default_rig().cameras["front-upper"]
ROOM = (*booth_walls(), *fixed_posts())
BODY = load_mesh(Path(__file__).parents[2] / "station/simulation/bodies/ben.npz")
SAID = PredictedError(1e-3, 1e-3, 2e-4, 1e-3)


def _frames(view: TrueView, change: float, seed: int) -> list[NDArray[np.uint16]]:
    """Frames of a unit whose depths are larger by a share than those of another of its kind."""
    warmer = replace(view, depth_m=view.depth_m * (1.0 + change))
    rng = np.random.default_rng(seed)
    return [TABLE[observe(warmer, UnitError(0.008, (0.2, -0.1)), rng)] for _ in range(12)]


@pytest.fixture(scope="module")
def empty() -> StaticView:
    view = VirtualScene(ROOM).view(CAMERA, CAMERA.world_from_camera)
    return static_view(_frames(view, 0.0, seed=1) + _frames(view, 0.0, seed=2), DEPTH_SCALE_M)


@pytest.mark.parametrize("change", [0.0, 4e-4, -1e-3])
@pytest.mark.parametrize("besides", [(), (BODY,), tuple(chair((-0.8, 0.6)))], ids=len)
def test_depths_that_changed_are_seen_with_somebody_in_view(
    empty: StaticView, change: float, besides: tuple[Any, ...]
) -> None:
    view = VirtualScene((*ROOM, *besides)).view(CAMERA, CAMERA.world_from_camera)
    found = depth_change(_frames(view, change, seed=3), DEPTH_SCALE_M, empty)
    assert found == pytest.approx(change, abs=1e-4)


def test_another_booth_says_nothing_of_the_depths(empty: StaticView) -> None:
    nearer = np.asarray(0.5 * empty.depth_m() / DEPTH_SCALE_M, np.uint16)
    assert depth_change([nearer] * 3, DEPTH_SCALE_M, empty) is None
    assert depth_change([], DEPTH_SCALE_M, empty) is None


def test_what_the_steps_saw_is_kept_with_them(tmp_path: Path) -> None:
    session = Session.begin(tmp_path, "2026-11-21T10:00:00Z", 0.1, CAMERAS)
    session.note_depths(MARK, "front-lower", 3e-4)
    session.record_resting(MARK, [ball("front-lower", 5.0)])
    session.record_wall("wall-0", [])
    kept = {MARK: {"front-lower": 3e-4}}
    assert Session.load(tmp_path).observations().depth_changes == kept
    session.record_empty({}, [])
    assert Session.load(tmp_path).observations().depth_changes == {}


@pytest.mark.parametrize("changes", [3e-4, {"front-lower": "much"}, {"elsewhere": 1e-4}])
def test_changes_that_no_station_wrote_are_named(tmp_path: Path, changes: object) -> None:
    Session.begin(tmp_path, "2026-11-21T10:00:00Z", 0.1, CAMERAS)
    line = json.dumps({"step": EMPTY, "planes": [], "depth_changes": changes})
    (tmp_path / JOURNAL).write_text(line + "\n")
    with pytest.raises(FormatError, match="line 1"):
        Session.load(tmp_path)


def _changes(*common: float) -> dict[str, dict[str, float]]:
    """Steps in which all cameras but one, that was bumped, show these changes."""
    return {
        f"wall-{step}": {"a": change - 1e-5, "b": change + 2e-5, "c": change, "d": 4e-3}
        for step, change in enumerate(common)
    }


@pytest.mark.parametrize(
    ("common", "words"),
    [
        ((2e-4, 9e-4), r"0\.09 % farther away"),
        ((-2e-4, -6e-4), r"0\.06 % nearer"),
        ((-3e-4, 3e-4), r"0\.06 % "),
    ],
)
def test_a_calibration_of_sensors_that_warm_up_is_refused(
    common: tuple[float, ...], words: str
) -> None:
    """Girths were 8.6 mm too small, stated to 3.0."""
    with pytest.raises(CalibrationError, match=words):
        check_warm(_changes(*common))


@pytest.mark.parametrize("common", [(), (0.0, 5e-5), (-4e-5, 4e-5)])
def test_warm_sensors_change_nothing(common: tuple[float, ...]) -> None:
    changes = _changes(*common)
    check_warm(changes)
    assert warming_words(changes) == ""
    assert widen_by_warming(SAID, changes) == SAID


def test_a_slight_change_widens_what_is_stated() -> None:
    """Girths change by 7 mm where depths change by 1e-3."""
    changes = _changes(1e-4, 3e-4)
    check_warm(changes)
    assert "0.03 % farther away" in warming_words(changes)
    widened = widen_by_warming(SAID, changes)
    assert 1.96 * np.sqrt(widened.girth_sigma_m**2 - SAID.girth_sigma_m**2) > 2.1e-3
