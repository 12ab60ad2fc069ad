"""Questions and instructions of a guided calibration."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import click
import pytest

from station.calibration.detect.coverage import Coverage
from station.calibration.detect.step_names import BALL, EMPTY
from station.calibration.guide import attempt, procedure, raised_ball
from station.calibration.guide.operator import Guide
from station.calibration.guide.procedure import Procedure
from station.calibration.guide.raised_ball import see_all_heights, see_height
from station.calibration.guide.recordings import fingerprint
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.core.config import BoothConfig
from station.core.errors import CalibrationError
from station.sensors.recording import INDEX
from station.simulation.scene import default_rig

COUNTDOWN_S = 8.0


@pytest.fixture
def seconds(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Slept seconds instead of sleep."""
    slept: list[float] = []
    monkeypatch.setattr("station.calibration.guide.operator.time.sleep", slept.append)
    return slept


@pytest.fixture
def guided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Procedure, Session, list[str]]:
    """A procedure with an empty booth seen, its session, and the steps at which cameras look."""
    store = CalibrationStore(tmp_path / "calibrations", tmp_path / "calibration.json")
    session = Session.begin(store.unfinished, "2026", 0.1, default_rig().cameras)
    session.record_empty({}, [])
    looked: list[str] = []

    @contextmanager
    def no_feed(_: Procedure, step: str) -> Iterator[tuple[None, Session]]:
        looked.append(step)
        yield None, session

    monkeypatch.setattr(Procedure, "feed", no_feed)
    monkeypatch.setattr(Procedure, "check_station", lambda _: None)
    monkeypatch.setattr(
        procedure, "look_at_wall", lambda _, own, __, place: own.record_wall(f"wall-{place}", [])
    )
    monkeypatch.setattr(attempt, "rest_ball", lambda *_: [])
    guide = Guide(attended=True, countdown_s=COUNTDOWN_S)
    config = cast(BoothConfig, SimpleNamespace(reference=next(iter(session.cameras))))
    begun = Procedure(config, store, None, guide)
    assert session.done(EMPTY)
    return begun, session, looked


def test_a_step_without_a_cameras_recording_is_found_before_the_first_step(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path
) -> None:
    """The ball's was missed 78 s later."""
    begun, _, looked = guided
    names = list(default_rig().cameras)
    for step in ("empty", "ball"):
        for name in names:
            (tmp_path / "recordings" / step / name).mkdir(parents=True)
    (tmp_path / "recordings" / "ball" / names[2]).rmdir()
    (tmp_path / "recordings" / "another" / "thing").mkdir(parents=True)
    config = SimpleNamespace(cameras=[SimpleNamespace(name=name) for name in names])
    replayed = replace(begun, config=cast(BoothConfig, config), recordings=tmp_path / "recordings")
    with pytest.raises(CalibrationError, match=f"ball holds no recording of camera {names[2]}"):
        replayed.run()
    (tmp_path / "recordings" / "ball" / names[3]).rmdir()
    with pytest.raises(CalibrationError, match=f"of cameras {names[2]}, {names[3]}: record"):
        replayed.run()
    assert looked == []


def test_a_step_that_cannot_be_added_to_the_calibration_in_use_says_what_can_be_done(
    guided: tuple[Procedure, Session, list[str]],
) -> None:
    """There was nothing to "start again", and --new would have done more than the step."""
    begun, session, _ = guided
    calibrate = SimpleNamespace(ball_radius_m=0.12)
    step = replace(begun, config=cast(BoothConfig, SimpleNamespace(calibrate=calibrate)))
    fewer = dict(list(session.cameras.items())[1:])
    for remedy in ("start again with station calibrate --new", "run station calibrate, which does"):
        with pytest.raises(CalibrationError, match=f"is the same, or {remedy}"):
            step._joined("wall-0", session.cameras)
        with pytest.raises(CalibrationError, match=f"as they were, or {remedy}"):
            step._joined("wall-0", fewer)
        if begun.store.unfinished.exists():
            rig = replace(default_rig(), created="2026-11-01T10:00:00Z")
            begun.store.use(begun.store.finish(rig, {}).name)


def _answers(monkeypatch: pytest.MonkeyPatch, confirmed: list[bool]) -> None:
    monkeypatch.setattr(click, "prompt", lambda *_, **__: "")
    monkeypatch.setattr(click, "confirm", lambda *_, **__: confirmed.pop(0))


def test_three_boards_are_asked_for_and_no_more(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A question, an instruction and another prompt stood before each of any number of places."""
    begun, session, looked = guided
    _answers(monkeypatch, [True] * 9)
    begun.walls(asked=True)
    assert looked == ["wall-0", "wall-1", "wall-2"]
    assert sum(seconds) == 3 * COUNTDOWN_S / 2
    begun.walls(asked=True)
    assert session.wall_count == 3


def test_a_board_that_is_not_there_ends_the_step(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun, _, looked = guided
    _answers(monkeypatch, [True, False])
    begun.walls(asked=True)
    assert looked == ["wall-0"]
    _answers(monkeypatch, [True, True, True, False])
    begun.walls(asked=False)
    assert looked == ["wall-0", "wall-1", "wall-2", "wall-3", "wall-4"]
    assert sum(seconds) == 5 * COUNTDOWN_S / 2


@pytest.mark.parametrize("hangs", [False, True], ids=["stand", "hanging"])
def test_two_heights_of_the_ball_are_asked_for(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
    hangs: bool,
) -> None:
    """It asked for one more height until somebody entered 0; the second one is not left out, for it
    shows that the first was measured wrongly."""
    begun, session, looked = guided
    heights_m = [1.7, 0.0, 0.9]
    _answers(monkeypatch, [hangs])
    monkeypatch.setattr(click, "prompt", lambda *_, **__: heights_m.pop(0))
    for _ in range(3):
        see_all_heights(begun)
    kind = "hanging" if hangs else "stand"
    assert looked == [f"{kind}-1700", f"{kind}-900"]
    assert session.raised == looked
    assert sum(seconds) == COUNTDOWN_S


def _raise(
    guided: tuple[Procedure, Session, list[str]],
    monkeypatch: pytest.MonkeyPatch,
    heights_m: list[float],
    *,
    again: bool = False,
) -> list[str]:
    """The questions that are asked until these heights are given."""
    asked: list[str] = []

    def answer(question: str, **_: object) -> float:
        asked.append(question)
        return heights_m.pop(0)

    _answers(monkeypatch, [True])
    monkeypatch.setattr(click, "prompt", answer)
    see_all_heights(guided[0], again=again)
    return asked


def test_the_height_that_is_missing_is_asked_for(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After the lower one and a restart it asked for the lower one again, and that replaced it."""
    _, session, _ = guided
    session.record_resting("hanging-700", [])
    (question,) = _raise(guided, monkeypatch, [1.8])
    assert "about 1.8 m above the floor, from the same hook" in question
    assert session.raised == ["hanging-700", "hanging-1800"]
    assert _raise(guided, monkeypatch, []) == []
    assert len(seconds) == COUNTDOWN_S / 2


def test_a_second_height_near_the_first_is_not_taken(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, session, _ = guided
    asked = _raise(guided, monkeypatch, [180.0, 1.8, 1.75, 0.7])
    assert len(asked) == 4
    said = capsys.readouterr().out
    assert "1.75 m is too near to 1.8 m" in said
    assert "a ball at 180 m cannot be used: its height is in metres" in said
    assert session.raised == ["hanging-1800", "hanging-700"]
    assert seconds


def test_heights_are_shown_again_where_that_is_wanted(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The console's step asked nothing once two heights were there, which a refusal sends to it."""
    _, session, _ = guided
    session.record_resting("hanging-1900", [])
    session.record_resting("hanging-600", [])
    assert len(_raise(guided, monkeypatch, [1.8, 0.7], again=True)) == 2
    assert session.raised == ["hanging-1800", "hanging-700"]
    said = capsys.readouterr().out
    assert "this replaces the ball that was seen at 0.6 and 1.9 m" in said
    assert Session.load(session.folder).raised == session.raised
    assert seconds


def test_a_single_step_names_the_height_that_is_missing(
    guided: tuple[Procedure, Session, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    """A calibration without it was used, and nothing said that the vertical was unknown."""
    begun, _, _ = guided
    unattended = replace(begun, guide=replace(begun.guide, attended=False))
    see_height(unattended, 0.75, "hanging")
    assert "now about 1.8 m above the floor, from the same hook" in capsys.readouterr().out
    see_height(unattended, 1.8, "hanging")
    assert "from the same hook" not in capsys.readouterr().out


def test_a_height_that_is_decimetres_off_is_asked_for_again(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It was told with the solution, when the ball had been taken down."""
    _, session, looked = guided

    monkeypatch.setattr(raised_ball, "_wrong_height", _wrong_at_1080)
    asked = _raise(guided, monkeypatch, [1.08, 1.8, 0.7])
    assert asked[0] == asked[1]
    assert looked == ["hanging-1080", "hanging-1800", "hanging-700"]
    assert Session.load(session.folder).raised == ["hanging-1800", "hanging-700"]
    assert "seen near 1.8 m" in capsys.readouterr().out
    assert seconds


def _wrong_at_1080(_: Session, step: str, *__: object) -> str | None:
    return "seen near 1.8 m" if step == "hanging-1080" else None


def test_a_wrong_height_replaces_nothing(
    guided: tuple[Procedure, Session, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was kept beside the right one, and the height that was missing was not asked for."""
    begun, session, _ = guided
    session.record_resting("hanging-1800", [])
    session.record_resting("hanging-700", [])
    monkeypatch.setattr(raised_ball, "_wrong_height", _wrong_at_1080)
    unattended = replace(begun, guide=replace(begun.guide, attended=False))
    with pytest.raises(CalibrationError, match=r"seen near 1\.8 m"):
        see_height(unattended, 1.08, "hanging")
    assert Session.load(session.folder).raised == ["hanging-1800", "hanging-700"]


@pytest.mark.parametrize("ends", [CalibrationError("not seen"), KeyboardInterrupt()], ids=type)
def test_heights_are_kept_until_others_are_seen(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
    ends: BaseException,
) -> None:
    """They were forgotten before anybody had looked for the ball at the new one."""
    _, session, _ = guided
    session.record_resting("hanging-1800", [])
    session.record_resting("hanging-700", [])

    def not_seen(*_: object) -> None:
        raise ends

    monkeypatch.setattr(attempt, "rest_ball", not_seen)
    with pytest.raises(type(ends)):
        _raise(guided, monkeypatch, [1.7], again=True)
    assert Session.load(session.folder).raised == ["hanging-1800", "hanging-700"]
    assert seconds


def test_a_kind_that_is_given_is_not_asked_for(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """--hanging without a height was ignored, and Enter led to a stand."""
    begun, session, _ = guided
    heights_m = [1.8, 0.7]
    monkeypatch.setattr(click, "prompt", lambda *_, **__: heights_m.pop(0))
    see_all_heights(begun, again=True, kind="hanging")
    assert session.raised == ["hanging-1800", "hanging-700"]
    assert seconds


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["hanging-low"], "does not end with the height of the ball's underside in millimetres"),
        (["hanging-0700"], "does not end with the height .* 300 to 2200, such as hanging-1700"),
        (["hanging-700", "hanging-1200", "hanging-1800"], "3 heights of the hanging ball"),
    ],
)
def test_recorded_heights_that_cannot_be_used_are_named(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path, names: list[str], words: str
) -> None:
    begun, _, looked = guided
    for name in [*names, "standing-1200"]:
        (tmp_path / "recordings" / name).mkdir(parents=True)
    with pytest.raises(CalibrationError, match=words):
        see_all_heights(replace(begun, recordings=tmp_path / "recordings"))
    assert looked == []


def _replayed(begun: Procedure, recordings: Path) -> Procedure:
    return replace(begun, recordings=recordings, guide=replace(begun.guide, attended=False))


def test_all_recorded_heights_are_looked_at(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path
) -> None:
    begun, session, looked = guided
    for name in ("hanging-700", "hanging-1800", "stand-1500", "standing-1200"):
        (tmp_path / "recordings" / name).mkdir(parents=True)
    (tmp_path / "recordings" / "stand-plan.pdf").touch()
    see_all_heights(_replayed(begun, tmp_path / "recordings"))
    assert looked == ["hanging-1800", "hanging-700", "stand-1500"]
    assert session.raised == looked


def test_recorded_heights_replace_those_before(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path
) -> None:
    """A wrong height stayed beside them."""
    begun, session, _ = guided
    session.record_resting("stand-1200", [])
    for name in ("stand-900", "stand-1700"):
        (tmp_path / "recordings" / name).mkdir(parents=True)
    replayed = _replayed(begun, tmp_path / "recordings")
    see_all_heights(replayed, again=True)
    assert session.raised == ["stand-1700", "stand-900"]
    with pytest.raises(CalibrationError, match=r"no recording of the ball on a stand or hanging"):
        see_all_heights(_replayed(begun, tmp_path), again=True)


def test_no_stand_is_asked_about_once(
    guided: tuple[Procedure, Session, list[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun, _, looked = guided
    answers = [0.0, 1.7]
    _answers(monkeypatch, [False])
    monkeypatch.setattr(click, "prompt", lambda *_, **__: answers.pop(0))
    see_all_heights(begun)
    assert answers == [1.7]
    assert looked == []


def test_instructions_are_given_once(
    guided: tuple[Procedure, Session, list[str]],
    seconds: list[float],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    begun, _, looked = guided
    _answers(monkeypatch, [])
    begun.around(asked=True)
    said = capsys.readouterr().out
    assert looked == ["around-0", "around-1", "around-2"]
    assert sum(seconds) == 3 * COUNTDOWN_S
    assert said.count("where a lower camera sees it") == 1
    assert "Ball on the floor behind the mark" in said


def test_all_recorded_places_of_the_board_are_used(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path
) -> None:
    begun, _, looked = guided
    for place in range(5):
        (tmp_path / f"wall-{place}").mkdir()
    unattended = Guide(attended=False, countdown_s=COUNTDOWN_S)
    Procedure(begun.config, begun.store, tmp_path, unattended).walls(asked=True)
    assert looked == [f"wall-{place}" for place in range(5)]


def test_a_recording_of_the_ball_is_looked_at_once(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path
) -> None:
    """One that shows too little was looked at again each time; another one shows something else."""
    begun, session, _ = guided
    recording = tmp_path / "recordings" / BALL / "front-lower"
    recording.mkdir(parents=True)
    (recording / INDEX).write_text("d-1.0-1-0.pgm\n")
    replayed = replace(begun, recordings=tmp_path / "recordings")
    assert not replayed._waved(session)
    session.end_replay(fingerprint(tmp_path / "recordings" / BALL))
    assert replayed._waved(session)
    (recording / INDEX).write_text("d-2.0-2-0.pgm\n")
    assert not replayed._waved(session)


def test_a_ball_that_was_waved_enough_needs_no_recording(
    guided: tuple[Procedure, Session, list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, session, _ = guided
    monkeypatch.setattr(Coverage, "enough", True)
    (tmp_path / "recordings").mkdir()
    assert replace(begun, recordings=tmp_path / "recordings")._waved(session)
