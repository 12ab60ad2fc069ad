"""A calibration that is being done survives a crash; what no station wrote is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from seen_balls import CAMERAS, ball

from station.calibration.detect.detections import PlaneObservation
from station.calibration.detect.scene import static_view
from station.calibration.detect.step_names import EMPTY, MARK, raised_height_m
from station.calibration.guide.seen import Lens
from station.calibration.guide.session import JOURNAL, SENSORS, Session
from station.core.errors import CalibrationError, FormatError
from station.sensors.identity import calibrated_serials

STARTED = "2026-11-21T10:00:00Z"


def test_a_session_goes_on_where_it_ended(tmp_path: Path) -> None:
    session = Session.begin(tmp_path, STARTED, 0.08, CAMERAS)
    floor = PlaneObservation("front-lower", "floor", 1000, np.ones((3, 4)))
    view = static_view([np.full((480, 640), 20000, np.uint16)] * 2, 1e-4)
    session.record_empty({"front-lower": view}, [floor])
    session.record_resting(MARK, [ball("front-lower", 5.0)])
    session.record_resting("around-0", [ball("front-lower", 9.0)])
    session.begin_run()
    session.record_balls([ball("front-lower", 100.0), ball("front-upper", 100.01)])
    session.begin_run()
    session.record_balls([ball("front-lower", 3.0)])
    session.record_lenses(
        {"front-upper": Lens([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]], [0] * 5)}
    )
    again = Session.load(tmp_path)
    assert (again.radius_m, again.started) == (0.08, STARTED)
    assert again.done(EMPTY)
    assert again.done(MARK)
    assert not again.done("front")
    assert not again.done("wall")
    observations = again.observations()
    assert [ball.camera for ball in observations.balls] == [
        "front-lower", "front-upper", "front-lower",
    ]  # fmt: skip
    # Runs have nothing in common, whatever the clocks said.
    assert observations.balls[2].time_s - observations.balls[1].time_s == pytest.approx(10.0)
    assert observations.balls[1].time_s - observations.balls[0].time_s == pytest.approx(0.01)
    assert len(observations.mark) == len(observations.planes) == 1
    assert [ball.time_s for ball in observations.around["around-0"]] == [9.0]
    assert again.lensed_cameras()["front-upper"].K[0, 0] == 600.0
    assert again.lensed_cameras()["front-lower"].K[0, 0] == 585.0
    assert again.background("front-lower") is not None
    assert again.background("back-lower") is None


def test_the_ball_waved_anew_replaces_the_old_one_in_one_line(tmp_path: Path) -> None:
    """Killed between two lines, or on a full disk, a calibration had neither."""
    session = Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    session.record_balls([ball("front-lower", 1.0), ball("front-lower", 2.0)])
    path = tmp_path / JOURNAL
    before = path.read_bytes()
    session.end_replay("a recording")
    session.begin_run(again=True)
    begun = path.read_bytes()
    session.replace_balls(
        [[ball("front-upper", 7.0), ball("front-upper", 8.0)], [ball("front-lower", 3.0)]]
    )
    whole = path.read_bytes()
    anew = Session.load(tmp_path)
    # Two runs of it, whose clocks have nothing in common.
    assert [ball.time_s for ball in anew.balls] == [7.0, 8.0, 18.0]
    assert not anew.replayed
    for end in range(len(begun), len(whole)):
        path.write_bytes(whole[:end])
        stopped = Session.load(tmp_path)
        assert [ball.time_s for ball in stopped.balls] == [1.0, 2.0]
        assert stopped.replayed == "a recording"
        assert stopped.replacing
    # As earlier versions wrote it.
    path.write_bytes(before + b'{"step":"forget-balls"}\n')
    assert Session.load(tmp_path).balls == []
    one = json.dumps(ball("front-upper", 7.0).to_json())
    path.write_bytes(before + f'{{"step":"ball-again","balls":[{one}]}}\n'.encode())
    assert [ball.time_s for ball in Session.load(tmp_path).balls] == [7.0]


def test_a_line_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    """Whoever only looks must not cut it off."""
    session = Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    session.record_empty({}, [])
    journal = tmp_path / JOURNAL
    journal.write_bytes(journal.read_bytes() + b'{"step":"ma')
    before = journal.read_bytes()
    assert Session.load(tmp_path, mend=False).done(EMPTY)
    assert journal.read_bytes() == before
    Session.load(tmp_path)
    assert journal.read_bytes() != before


def test_a_line_that_was_cut_off_costs_only_itself(tmp_path: Path) -> None:
    """kill -9 in the middle of a write."""
    session = Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    session.record_balls([ball("front-lower", 1.0)])
    path = tmp_path / JOURNAL
    whole = path.read_bytes()
    path.write_bytes(whole + whole[: len(whole) // 2])
    again = Session.load(tmp_path)
    assert len(again.balls) == 1
    again.record_balls([ball("front-lower", 2.0)])
    assert [ball.time_s for ball in Session.load(tmp_path).balls] == [1.0, 2.0]


@pytest.mark.parametrize(
    "line", ["{}", "[1]", "no json", '{"step": "ball", "balls": [{"camera": "a"}]}']
)
def test_a_line_that_is_not_ours_is_named(tmp_path: Path, line: str) -> None:
    session = Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    session.record_balls([ball("front-lower", 1.0)])
    path = tmp_path / JOURNAL
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(FormatError, match=r"observations\.jsonl: line 2"):
        Session.load(tmp_path)


def test_another_version_is_refused(tmp_path: Path) -> None:
    Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    path = tmp_path / "session.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": 7}))
    with pytest.raises(FormatError, match="version 7; this program reads 1"):
        Session.load(tmp_path)


def test_other_cameras_are_not_mixed_in(tmp_path: Path) -> None:
    session = Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    serials = calibrated_serials(CAMERAS)
    session.check_cameras(serials)
    with pytest.raises(CalibrationError, match="camera back-lower is sensor X, but V00000003 was"):
        session.check_cameras({**serials, "back-lower": "X"})
    del serials["back-upper"]
    with pytest.raises(
        CalibrationError, match=r"camera back-upper was .*with station calibrate --n"
    ):
        session.check_cameras(serials)
    assert (tmp_path / SENSORS).exists()


def test_a_corrected_height_of_the_stand_replaces_the_wrong_one(tmp_path: Path) -> None:
    """The wrong one stayed, and the calibration was refused for ever."""
    session = Session.begin(tmp_path / "s", "2026", 0.1, CAMERAS)
    for height_mm in (900, 1730, 1700):
        session.record_resting(f"stand-{height_mm}", [ball("front-upper", 0.0)])
    assert list(session.around) == ["stand-900", "stand-1700"]
    assert list(Session.load(tmp_path / "s").around) == ["stand-900", "stand-1700"]


@pytest.mark.parametrize(
    ("told", "kept"),
    [
        ("hanging-2000 hanging-500 hanging-1800", "hanging-1800"),
        ("hanging-1800 hanging-700 hanging-1790", "hanging-1790"),
        ("hanging-1800 hanging-1790 hanging-700", "hanging-1790 hanging-700"),
        ("hanging-1800 hanging-700 stand-1700", "hanging-1800 hanging-700 stand-1700"),
        ("stand-1700 stand-900 hanging-1800", "stand-1700 stand-900 hanging-1800"),
    ],
    ids=["another hook", "a height again", "corrected at once", "and a stand", "after a stand"],
)
def test_two_heights_of_one_hook_belong_together(tmp_path: Path, told: str, kept: str) -> None:
    """The old hook's lower place was compared with the new one's upper one."""
    session = Session.begin(tmp_path / "s", "2026", 0.1, CAMERAS)
    for step in told.split():
        session.record_resting(step, [ball("front-upper", 0.0)])
    assert session.raised == kept.split()
    assert Session.load(tmp_path / "s").raised == kept.split()


@pytest.mark.parametrize(
    "wrong",
    [
        {"time_s": float("nan")}, {"time_s": 10**400}, {"points": float("inf")}, {"radius_m": -0.1},
        {"radius_sigma_m": float("nan")}, {"center_m": [0.0, 0.0, -2.0]},
        {"covariance_m2": np.zeros((3, 3)).tolist()},
    ],
    ids=str,
)  # fmt: skip
def test_a_detection_that_cannot_be_is_named(tmp_path: Path, wrong: dict[str, object]) -> None:
    """Some were put into use; accuracy was less, and nothing said why."""
    session = Session.begin(tmp_path, "2026", 0.1, CAMERAS)
    seen = {**ball("front-lower", 1.0).to_json(), **wrong}
    (session.folder / JOURNAL).write_text(json.dumps({"step": MARK, "balls": [seen]}) + "\n")
    with pytest.raises(FormatError, match="line 1 cannot be read"):
        Session.load(tmp_path)


def test_one_place_is_not_said_in_the_plural(tmp_path: Path) -> None:
    """It said "1 places around it"."""
    session = Session.begin(tmp_path, "2026", 0.1, CAMERAS)
    session.record_resting("around-0", [ball("front-lower", 1.0)])
    assert session.summary() == "1 place around it"
    session.record_resting("around-1", [ball("front-lower", 1.0)])
    assert session.summary() == "2 places around it"


@pytest.mark.parametrize(
    "step",
    ["hanging-nan", "hanging-0", "stand-99999", "hanging--700", "standby-1500", "stand-١٨٠٠"],
)
def test_a_height_out_of_sight_is_named(tmp_path: Path, step: str) -> None:
    """One was taken for a head instead of the ball."""
    session = Session.begin(tmp_path, "2026", 0.1, CAMERAS)
    entry = {"step": step, "balls": [ball("front-lower", 1.0).to_json()]}
    (session.folder / JOURNAL).write_text(json.dumps(entry) + "\n")
    with pytest.raises(FormatError, match="line 1 cannot be read"):
        Session.load(tmp_path)


def test_a_height_of_hundreds_of_digits_is_none() -> None:
    """It overflowed, instead of the error that whoever reads a height waits for."""
    with pytest.raises(ValueError, match="does not end with the height"):
        raised_height_m(f"stand-{400 * '9'}")


def test_nested_nonsense_is_named(tmp_path: Path) -> None:
    session = Session.begin(tmp_path, "2026", 0.1, CAMERAS)
    (session.folder / JOURNAL).write_text("[" * 100_000 + "\n")
    with pytest.raises(FormatError, match="line 1 cannot be read"):
        Session.load(tmp_path)


def test_what_was_seen_is_listed(tmp_path: Path) -> None:
    """Nobody could tell the wrong one of "3 measured heights"."""
    session = Session.begin(tmp_path, "2026", 0.1, CAMERAS)
    for step in ("hanging-1800", "hanging-700", "stand-1080"):
        session.record_resting(step, [ball("front-lower", 1.0)])
    listed = "the ball hanging at 1.8 and 0.7 m; the ball on a stand at 1.08 m"
    assert session.summary() == listed


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"step": "wall-0", "planes": [{"camera": "front-lower"}]}, "surface"),
        ({"step": "wall-0", "planes": [{"camera": "front-lower", "surface": "wall-0",
          "points": 9, "patches": np.zeros((0, 4)).tolist()}]}, "numbers were expected"),
        ({"step": "wall-0", "planes": [{"camera": "front-lower", "surface": "wall-0",
          "points": 9, "patches": [[1.0, 2.0, 0.5, 1e-7]]}]}, "3 patches are needed, not 1"),
        ({"step": "wall-0", "planes": [{"camera": "front-lower", "surface": "wall-0",
          "points": 9, "patches": [[1.0, 2.0, 0.5, 0.0]] * 3}]}, "variance of an inverse depth"),
        ({"step": "wall-0", "planes": [{"camera": "front-lower", "surface": "wall-0",
          "points": 9, "patches": [[1.0, 2.0, 1e30, 1e-7]] * 3}]}, "depths lie between 0.1 and 20"),
        ({"step": "rubbish", "planes": []}, "there is no step rubbish"),
        ({"step": "forget-raised", "places": "hanging-1800"}, "places are a list"),
        ({"step": "board", "lenses": {"side": None}}, "there is no camera side"),
        ({"step": "board", "lenses": {"front-lower": {"K": np.zeros((3, 3)).tolist(),
          "distortion": [0.0] * 5}}}, "K must have positive focal lengths"),
        ({"step": "board", "lenses": {"front-lower": {"K": [[585, 0, 1e9], [0, 585, 240],
          [0, 0, 1]], "distortion": [0.0] * 5}}}, "an image's size away"),
        ({"step": "board", "lenses": {"front-lower": {"K": np.eye(3).tolist(),
          "distortion": [0.0] * 3}}}, "numbers were expected"),
        ({"step": "wall-0", "planes": [{"camera": "side", "surface": "wall-0",
          "points": 9, "patches": [[1.0, 2.0, 0.5, 1e-7]] * 3}]}, "there is no camera side"),
    ],
)  # fmt: skip
def test_a_damaged_line_is_named(tmp_path: Path, entry: dict[str, object], words: str) -> None:
    """Some ended in a traceback when the calibration was solved."""
    session = Session.begin(tmp_path, STARTED, 0.1, CAMERAS)
    (session.folder / JOURNAL).write_text(json.dumps(entry) + "\n")
    with pytest.raises(FormatError, match=f"line 1 cannot be read .*{words}"):
        Session.load(session.folder)
