"""Sensors that warm up while a booth is calibrated make girths wrong by millimetres unseen."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from seen_balls import CAMERAS, ball

from station.calibration.detect.detections import Observations
from station.calibration.detect.scene import StaticView, mean_view, static_view
from station.calibration.detect.step_names import EMPTY, MARK
from station.calibration.detect.warmth import common_change, depth_change
from station.calibration.guide.attempt import Attempt
from station.calibration.guide.operator import Guide
from station.calibration.guide.session import JOURNAL, Session
from station.calibration.guide.store import CalibrationStore
from station.calibration.solve.solving import solve
from station.calibration.solve.warming import check_warm, warming_words, widen_by_warming
from station.core.config import BoothConfig
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
    found = depth_change(*mean_view(_frames(view, change, seed=3), DEPTH_SCALE_M), empty)
    assert found == pytest.approx(change, abs=1e-4)


def test_another_booth_says_nothing_of_the_depths(empty: StaticView) -> None:
    nearer = np.asarray(0.5 * empty.depth_m() / DEPTH_SCALE_M, np.uint16)
    assert depth_change(*mean_view([nearer] * 3, DEPTH_SCALE_M), empty) is None


def test_curtains_that_hang_otherwise_say_nothing_of_the_depths(empty: StaticView) -> None:
    rows = np.arange(480)[:, None]
    hung = empty.depth_m() * (1.0 + 5e-3 * np.sign(np.sin(rows / 40.0 * np.pi)))
    frames = [np.asarray(hung / DEPTH_SCALE_M, np.uint16)] * 3
    assert depth_change(*mean_view(frames, DEPTH_SCALE_M), empty) is None


@pytest.mark.parametrize(
    ("changes", "common"),
    [
        ({}, 0.0),
        ({"a": 0.0, "b": 2e-3}, 0.0),
        ({"a": 0.0, "b": 0.0, "c": 1e-3, "d": 1e-3}, 0.0),
        ({"a": -1e-3, "b": 1e-3}, 0.0),
        ({"a": 1e-3, "b": 9e-4}, 9e-4),
        ({"a": -1e-3, "b": -9e-4, "c": 4e-3}, -9e-4),
    ],
)
def test_one_camera_does_not_speak_for_all(changes: dict[str, float], common: float) -> None:
    """It may have been moved: by 2 mm, a wall is 0.1 % farther away."""
    assert common_change(changes) == common


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Session.begin(tmp_path, "2026-11-21T10:00:00Z", 0.1, CAMERAS)


def _rest(session: Session, step: str, **changes: float) -> None:
    session.note_depths(step, {name.replace("_", "-"): own for name, own in changes.items()})
    session.record_resting(step, [ball("front-lower", 5.0)])


def _kept(session: Session) -> dict[str, dict[str, float]]:
    seen = Session.load(session.folder).depth_changes
    assert seen == session.depth_changes
    return seen


def test_what_the_steps_saw_is_kept_with_them(session: Session) -> None:
    _rest(session, MARK, front_lower=3e-4)
    session.note_depths("wall-0", {"front-upper": 2e-4})
    session.record_wall("wall-0", [])
    assert _kept(session) == {MARK: {"front-lower": 3e-4}, "wall-0": {"front-upper": 2e-4}}
    assert session.observations().depth_changes == session.depth_changes


def test_a_step_that_is_repeated_counts_anew(session: Session) -> None:
    """Its change when the sensors were cold refused the calibration for ever."""
    _rest(session, MARK, front_lower=9e-4, back_lower=9e-4)
    _rest(session, "stand-1700", front_upper=9e-4)
    _rest(session, "stand-900", front_upper=9e-4)
    _rest(session, MARK, front_lower=1e-5)
    _rest(session, "stand-1710", front_upper=2e-5)
    session.forget_raised(["stand-900"])
    kept = _kept(session)
    assert list(kept.items()) == [
        (MARK, {"front-lower": 1e-5}),
        ("stand-1710", {"front-upper": 2e-5}),
    ]
    _rest(session, MARK)
    assert MARK not in _kept(session)


def test_the_empty_booth_recorded_anew_forgets_no_change(session: Session) -> None:
    """A calibration that had been refused was accepted after it, 8 mm wrong."""
    _rest(session, MARK, front_lower=9e-4, back_lower=9e-4)
    session.note_depths(EMPTY, {"front-lower": 1e-4})
    session.record_empty({}, [])
    assert _kept(session) == {MARK: {"front-lower": pytest.approx(8e-4)}}


@pytest.mark.parametrize("changes", [3e-4, {"front-lower": "much"}, {"elsewhere": 1e-4}])
def test_changes_that_no_station_wrote_are_named(tmp_path: Path, changes: object) -> None:
    Session.begin(tmp_path, "2026-11-21T10:00:00Z", 0.1, CAMERAS)
    line = json.dumps({"step": EMPTY, "planes": [], "depth_changes": changes})
    (tmp_path / JOURNAL).write_text(line + "\n")
    with pytest.raises(FormatError, match="line 1"):
        Session.load(tmp_path)


def _changes(*common: float) -> dict[str, dict[str, float]]:
    """Steps in which all cameras but one, which stays cold, show these changes."""
    return {
        f"wall-{step}": {"a": change - 1e-5, "b": change + 2e-5, "c": change, "d": 0.0}
        for step, change in enumerate(common)
    }


@pytest.mark.parametrize(
    ("common", "words"),
    [
        ((2e-4, 9e-4), r"0\.09 % farther away"),
        ((-2e-4, -6e-4), r"0\.06 % nearer"),
        ((-3e-4, 3e-4), r"0\.06 % farther away"),
        ((3e-4, -3e-4), r"0\.06 % nearer"),
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
    assert widen_by_warming(SAID, changes, 8e-3) == SAID


def test_a_slight_change_widens_what_is_stated() -> None:
    """Girths change by 7 mm where depths change by 1e-3."""
    changes = _changes(1e-4, 3e-4)
    check_warm(changes)
    assert "0.03 % farther away" in warming_words(changes)
    widened = widen_by_warming(SAID, changes, 8e-3)
    assert 1.96 * np.sqrt(widened.girth_sigma_m**2 - SAID.girth_sigma_m**2) > 2.1e-3
    with pytest.raises(CalibrationError, match="warm up for 20 minutes"):
        widen_by_warming(SAID, changes, 3e-3)


def _alone(*changed: float) -> dict[str, dict[str, float]]:
    """Steps in which one camera shows these changes, and the others a little common warmth."""
    return {
        f"wall-{step}": {"a": 4e-5, "b": 2e-5 + change, "c": -1e-5, "d": 3e-5}
        for step, change in enumerate(changed)
    }


def test_one_sensor_that_warms_up_alone_is_named() -> None:
    """It was seen and said nothing of: girths were up to 6.3 mm wrong, stated to 1.0."""
    with pytest.raises(CalibrationError, match=r"camera b, .* saw the booth 0\.10 % nearer"):
        check_warm(_alone(0.0, -5e-4, -1e-3))
    with pytest.raises(CalibrationError, match=r"camera b, .* it was moved, or it warms up"):
        check_warm(_alone(1e-3, 1e-3))


def test_one_sensor_that_changes_slightly_widens_what_is_stated() -> None:
    changes = _alone(0.0, 4e-4)
    check_warm(changes)
    assert "fasten camera b and let all sensors warm up" in warming_words(changes)
    widened = widen_by_warming(SAID, changes, 8e-3)
    assert 1.96 * np.sqrt(widened.girth_sigma_m**2 - SAID.girth_sigma_m**2) > 2e-3
    with pytest.raises(CalibrationError, match="camera b, compared with most"):
        widen_by_warming(SAID, changes, 2.5e-3)


def test_one_of_two_cameras_that_warm_up_is_not_told_as_the_only_one() -> None:
    """The other one was plugged in with it; "alone" was untrue, and warming up one did not help."""
    two = {"wall-0": {"a": 1e-3, "b": 1.1e-3, "c": 0.0, "d": 0.0}}
    words = r"camera b, compared with most of the others, .*let all sensors warm up"
    with pytest.raises(CalibrationError, match=words):
        check_warm(two)


def test_two_cameras_of_four_say_nothing_of_the_others() -> None:
    changes = {"mark": {"a": 1e-3, "b": 1e-3}, **_alone(0.0)}
    check_warm(changes)
    assert widen_by_warming(SAID, changes, 8e-3) == SAID


def test_the_next_step_tells_what_the_solution_will_be_refused_for(
    session: Session, capsys: pytest.CaptureFixture[str]
) -> None:
    """All the other steps were done in vain."""
    store = CalibrationStore(session.folder, session.folder / "calibration.json")
    guide = Guide(attended=False, countdown_s=0.0)
    attempt = Attempt(cast(BoothConfig, SimpleNamespace()), store, None, guide)
    attempt.remark_on_warmth(session)
    assert capsys.readouterr().out == ""
    _rest(session, MARK, **dict.fromkeys(("front_lower", "front_upper", "back_lower"), 9e-4))
    attempt.remark_on_warmth(session)
    assert "0.09 % farther away in one step" in capsys.readouterr().out


def test_a_solution_is_not_begun_with_sensors_that_warmed_up() -> None:
    """It named a camera that had moved, and none had."""
    seen = [ball(name, 0.1 * k) for name in CAMERAS for k in range(100)]
    observations = Observations(seen, seen[:1], depth_changes={MARK: dict.fromkeys(CAMERAS, 9e-4)})
    with pytest.raises(CalibrationError, match=r"0\.09 % farther away in one step"):
        solve(
            observations, CAMERAS, radius_m=0.1, reference="front-upper",
            front_cameras=["front-upper"], created="2026-11-21T10:00:00Z",
        )  # fmt: skip
