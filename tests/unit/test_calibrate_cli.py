"""Messages of `station calibrate` that need no camera."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from seen_balls import CAMERAS, ball

from station.calibration.detect.board import Board
from station.calibration.guide import raised_ball
from station.calibration.guide.attempt import Attempt
from station.calibration.guide.calibrate_cli import calibrate
from station.calibration.guide.operator import Guide
from station.calibration.guide.procedure import Procedure
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.console.live import guided
from station.core.errors import BoothError, CalibrationError
from station.core.files import local_time
from station.core.rig import Rig
from station.simulation.scene import default_rig

STARTED = "2026-11-21T10:00:00Z"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "booth.toml"
    path.write_text(
        "".join(
            f'[[cameras]]\nname = "{name}"\ndriver = "recorded"\nrecording = "{name}"\n'
            for name in CAMERAS
        )
    )
    return path


@pytest.fixture
def store(config: Path) -> CalibrationStore:
    return CalibrationStore(config.parent / "calibrations", config.parent / "calibration.json")


def _run(config: Path, *words: str) -> Result:
    return CliRunner().invoke(calibrate, [*words, "--config", str(config)])


def _begin(store: CalibrationStore) -> Session:
    return Session.begin(store.unfinished, STARTED, 0.1, CAMERAS)


def test_a_damaged_calibration_has_a_line_of_its_own(config: Path, store: CalibrationStore) -> None:
    for day in (1, 2):
        _begin(store)
        store.finish(replace(default_rig(), created=f"2026-11-0{day}T10:00:00Z"), {})
    (store.folder / "20261101T100000Z" / "calibration.json").write_text("{")
    command = "from station.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", command, "calibrate", "--list", "--config", str(config)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "20261102T100000Z  4 cameras" in done.stdout
    (line,) = done.stderr.splitlines()
    assert line.startswith("  20261101T100000Z  cannot be used: ")


def test_stored_calibrations_are_listed_and_put_into_use(
    config: Path, store: CalibrationStore
) -> None:
    for day in (1, 2):
        _begin(store)
        store.finish(replace(default_rig(), created=f"2026-11-0{day}T10:00:00Z"), {})
    _begin(store)
    used = _run(config, "--use", "20261101T100000Z")
    assert used.exit_code == 0, used.output
    assert Rig.load(store.in_use).created == "2026-11-01T10:00:00Z"
    listed = _run(config, "--list").output.splitlines()
    assert listed[0].startswith("* 20261101T100000Z  4 cameras")
    assert listed[1].startswith("  20261102T100000Z")
    assert f"unfinished, started {local_time(STARTED)}" in listed[2]
    wrong = _run(config, "--use", "yesterday")
    assert isinstance(wrong.exception, CalibrationError)
    assert "20261101T100000Z, 20261102T100000Z" in str(wrong.exception)


def test_a_calibration_of_other_cameras_is_not_put_into_use(
    config: Path, store: CalibrationStore
) -> None:
    """It went into use without a word, and every scan was refused."""
    _begin(store)
    name = store.finish(replace(default_rig(), created="2026-11-01T10:00:00Z"), {}).name
    text = config.read_text()
    config.write_text(text.replace('name = "front-lower"', 'name = "side"'))
    refused = _run(config, "--use", name)
    assert isinstance(refused.exception, CalibrationError)
    assert str(refused.exception).startswith(
        f"calibration {name} cannot be used: camera front-lower was calibrated and is not in "
        "booth.toml; camera side is in booth.toml and was not calibrated; put the sensors and"
    )
    section = 'name = "front-lower"\ndriver = "recorded"\n'
    config.write_text(text.replace(section, f'{section}serial = "A1"\n'))
    refused = _run(config, "--use", name)
    then = CAMERAS["front-lower"].serial
    assert f"camera front-lower is sensor A1, but {then} was calibrated" in str(refused.exception)
    assert not store.in_use.exists()
    config.write_text(text.replace(section, f'{section}serial = "{then}"\n'))
    assert _run(config, "--use", name).exit_code == 0


def test_after_a_finished_calibration_solve_says_so(config: Path, store: CalibrationStore) -> None:
    """It once said that none had been begun, an hour after the operator had done all steps."""
    _begin(store)
    store.finish(replace(default_rig(), created="2026-11-01T10:00:00Z"), {})
    refused = _run(config, "solve")
    assert isinstance(refused.exception, CalibrationError)
    assert "20261101T100000Z, is finished" in str(refused.exception)
    assert "station calibrate begins another" in str(refused.exception)


def test_a_solution_takes_the_ball_that_was_waved(config: Path, store: CalibrationStore) -> None:
    """With another radius in booth.toml since, it went into use without a word."""
    _begin(store)
    refused = _run(config, "solve")
    assert "the ball has not been waved yet: station calibrate ball" in str(refused.exception)
    config.write_text("[calibrate]\nball_radius_m = 0.12\n" + config.read_text())
    refused = _run(config, "solve")
    assert "with a radius of 0.1 m, but booth.toml says 0.12 m" in str(refused.exception)
    assert "station calibrate --new" in str(refused.exception)


def test_a_solution_is_of_the_cameras_that_are_configured(
    config: Path, store: CalibrationStore
) -> None:
    """A calibration of four cameras went into use with three in booth.toml."""
    _begin(store)
    text = config.read_text()
    config.write_text(text[: text.rindex("[[cameras]]")])
    refused = _run(config, "solve")
    assert isinstance(refused.exception, CalibrationError)
    assert "camera back-upper was calibrated and is not in booth.toml" in str(refused.exception)
    config.write_text(text + '[[cameras]]\nname = "side"\ndriver = "recorded"\nrecording = "s"\n')
    assert "camera side is in booth.toml and was not" in str(_run(config, "solve").exception)
    config.write_text(text.replace('name = "front-lower"', 'serial = "A1"\nname = "front-lower"'))
    assert "camera front-lower is sensor A1, but V0" in str(_run(config, "solve").exception)


def test_a_list_says_what_was_seen_so_far(config: Path, store: CalibrationStore) -> None:
    _begin(store)
    listed = _run(config, "--list").output
    assert listed == f"  unfinished, started {local_time(STARTED)}: nothing yet\n"


def test_a_calibration_from_elsewhere_is_listed(config: Path, store: CalibrationStore) -> None:
    """The list said that there was no calibration while the booth used one."""
    default_rig().save(store.in_use)
    assert _run(config, "--list").output == (
        f"* {store.in_use}  in use; it is none of {store.folder}\n"
    )


def test_abandoned_calibrations_are_listed(config: Path, store: CalibrationStore) -> None:
    """Nothing but the folder's name told of them."""
    for _ in range(10):
        session = _begin(store)
        store.abandon()
    # One that was killed while it began has nothing that could be listed.
    session.folder.mkdir()
    store.abandon()
    # A damaged one hides no other.
    (store.folder / "abandoned-11" / "session.json").mkdir(parents=True)
    lines = _run(config, "--list").output.splitlines()
    assert lines[0] == f"  abandoned-1  started {local_time(STARTED)}"
    assert [line.split()[0] for line in lines] == [f"abandoned-{n}" for n in range(1, 11)]


@pytest.mark.parametrize(
    ("balls", "again", "kept"),
    [
        (0, "", "nothing was recorded"),
        (1, "", "what was seen is"),
        (1, "now", "nothing replaces what was seen of the ball before"),
        # A step that has nothing to do with the ball repeated it.
        (1, "before", "what was seen is"),
    ],
)
def test_a_step_that_is_stopped_says_what_is_kept(
    config: Path,
    store: CalibrationStore,
    monkeypatch: pytest.MonkeyPatch,
    balls: int,
    again: str,
    kept: str,
) -> None:
    """The page, and the command once a step had begun, spoke of what was seen where nothing was."""

    def stopped(_: Procedure) -> None:
        if again == "now":
            session.begin_run(again=True)
        raise KeyboardInterrupt

    session = _begin(store)
    session.record_balls(balls * [ball(next(iter(CAMERAS)), 0.0)])
    if again == "before":
        session.begin_run(again=True)
    monkeypatch.setattr(Procedure, "empty", stopped)
    with pytest.raises(CalibrationError, match=f"stopped; {kept}"):
        guided.run(config, "floor", new=False)
    assert f"stopped; {kept}" in _run(config, "floor").output


@pytest.mark.parametrize(
    ("balls", "marked", "following"),
    [
        (0, 0, "goes through the steps that are missing"),
        (1, 0, "goes through the steps that are missing"),
        (1, 1, "solve puts it into use"),
    ],
)
def test_a_step_says_what_comes_next(
    config: Path,
    store: CalibrationStore,
    monkeypatch: pytest.MonkeyPatch,
    balls: int,
    marked: int,
    following: str,
) -> None:
    """After the empty booth, which begins another calibration, solve was named, and refused."""
    session = _begin(store)
    seen = [ball(next(iter(CAMERAS)), 0.0)]
    session.balls += balls * seen
    session.mark += marked * seen
    monkeypatch.setattr(Procedure, "empty", lambda _: None)
    monkeypatch.setattr(Procedure, "unfinished_session", lambda _: session)
    done = _run(config, "floor")
    assert done.exit_code == 0, done.output
    assert f"kept, and not in use yet: station calibrate {following}" in done.output


def test_the_folder_above_the_recordings_names_the_right_one(config: Path) -> None:
    """The cameras' own recordings, front-lower, were taken for the step in front of the mark; the
    remedy was to take them away."""
    booth = config.parent
    (booth / "procedure/empty").mkdir(parents=True)
    (booth / "front-lower").mkdir()
    refused = _run(config, "--recordings", str(booth))
    assert isinstance(refused.exception, CalibrationError)
    assert str(refused.exception).endswith(f"--recordings {booth / 'procedure'}")


@pytest.mark.parametrize(
    ("recorded", "words", "remedy"),
    [("hanging-1800", (), "add --hanging"), ("stand-1800", ("--hanging",), "leave --hanging out")],
)
def test_a_forgotten_hanging_is_named(
    config: Path, recorded: str, words: tuple[str, ...], remedy: str
) -> None:
    recordings = config.parent / "procedure"
    (recordings / recorded).mkdir(parents=True)
    refused = _run(config, "stand", "--height", "1.8", *words, "--recordings", str(recordings))
    assert isinstance(refused.exception, CalibrationError)
    assert f"but {recorded}: {remedy}" in str(refused.exception)


def test_a_board_needs_the_empty_booth_first(config: Path, store: CalibrationStore) -> None:
    """The operator had set up the board before he was told."""
    _begin(store)
    refused = _run(config, "depth")
    assert "has to be recorded first: station calibrate floor" in str(refused.exception)
    assert "board" not in refused.output


def test_a_board_is_not_sent_to_a_step_that_begins_anew(
    config: Path, store: CalibrationStore
) -> None:
    """The empty booth was named, which begins another calibration in place of the one in use."""
    _begin(store)
    store.use(store.finish(replace(default_rig(), created="2026-11-01T10:00:00Z"), {}).name)
    refused = _run(config, "depth")
    assert "station calibrate goes through all steps" in str(refused.exception)


def test_a_stand_is_a_step_of_its_own(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    laid: list[tuple[str, str]] = []
    monkeypatch.setattr(Guide, "step", lambda _, title, *__, **___: laid.append(("", title)))

    def see(_: Attempt, height_m: float, kind: str, **__: bool) -> None:
        laid[-1] = (f"{kind} {height_m:g}", laid[-1][1])

    monkeypatch.setattr(raised_ball, "_see_and_keep", see)
    monkeypatch.setattr(Attempt, "check_station", lambda _: None)
    done = _run(config, "stand", "--height", "1.7")
    assert done.exit_code == 0, done.output
    assert laid == [
        ("stand 1.7", "Ball on a stand on the mark, its underside 1.7 m above the floor")
    ]
    assert _run(config, "stand", "--height", "0.7", "--hanging").exit_code == 0
    assert laid.pop() == (
        "hanging 0.7",
        "Ball hanging above the mark, its underside 0.7 m above the floor",
    )
    in_cm = _run(config, "stand", "--height", "170")
    assert in_cm.exit_code == 2
    assert "170 is not from 0.3 up to 2.2 metres" in in_cm.output
    nobody = _run(config, "stand", "--yes")
    assert nobody.exit_code == 2
    assert "give --height METRES" in nobody.output
    assert len(laid) == 1


def test_a_step_reads_its_own_configuration(tmp_path: Path) -> None:
    """The group once read booth.toml before the step could say which."""
    missing = CliRunner().invoke(calibrate, ["solve", "--config", str(tmp_path / "other.toml")])
    assert isinstance(missing.exception, BoothError)
    assert "other.toml" in str(missing.exception)


def _draw_boards(folder: Path, board: Board) -> None:
    for name in CAMERAS:
        (folder / name).mkdir(parents=True)
        image = board.printed().generateImage((560, 400), marginSize=20)
        canvas = np.full((480, 640), 200, np.uint8)
        canvas[40:440, 40:600] = image
        cv2.imwrite(str(folder / name / "000.png"), canvas)


def test_a_board_is_looked_for_in_a_folder_of_images(config: Path, store: CalibrationStore) -> None:
    images = config.parent / "images"
    _draw_boards(images, Board(7, 5, 0.06, 0.045))
    before = _run(config, "board", "--images", str(images))
    assert "no calibration has been started" in str(before.exception)
    _begin(store)
    done = _run(config, "board", "--images", str(images))
    assert done.exit_code == 0, done.output
    assert "camera front-lower: the board is seen in 1 image\n" in done.output
    assert "the factory's lens is kept, 12 are needed" in done.output
    assert Session.load(store.unfinished).lenses == {}


@pytest.mark.parametrize(
    ("squares", "words"),
    [
        ("9x6", "board of another size"),
        ("seven", "across x down"),
        ("6x4", "board of another size"),
    ],
)
def test_a_board_that_is_not_the_one_given_is_refused(
    config: Path, store: CalibrationStore, squares: str, words: str
) -> None:
    images = config.parent / "images"
    _draw_boards(images, Board(7, 5, 0.06, 0.045))
    _begin(store)
    done = _run(config, "board", "--images", str(images), "--squares", squares)
    assert isinstance(done.exception, CalibrationError)
    assert words in str(done.exception)


def test_images_that_cannot_be_used_are_named(config: Path, store: CalibrationStore) -> None:
    images = config.parent / "images"
    (images / "front-lower").mkdir(parents=True)
    _begin(store)
    nothing = _run(config, "board", "--images", str(images))
    assert "no image of the board" in str(nothing.exception)
    path = images / "front-lower/a.png"
    cv2.imwrite(str(path), np.zeros((100, 100), np.uint8))
    assert "a.png is 100 x 100; camera front-lower has 640 x 480" in str(
        _run(config, "board", "--images", str(images)).exception
    )
    path.write_bytes(b"no image")
    assert "cannot be read as an image" in str(
        _run(config, "board", "--images", str(images)).exception
    )


def test_nobody_is_waited_for_unattended(capsys: pytest.CaptureFixture[str]) -> None:
    guide = Guide(attended=False, countdown_s=60.0)
    guide.step("Ball", "Wave it.")
    for second in range(100):
        guide.progress(f"{second} s")
    guide.done("seen")
    assert not guide.answers_yes("Once more?")
    lines = capsys.readouterr().out.split("\n")
    assert lines == ["", "Ball", "  Wave it.", "  0 s", "  99 s", "  seen", ""]


def test_an_option_before_the_step_is_not_dropped(config: Path) -> None:
    """`station calibrate --new ball` used to begin nothing anew, without a word."""
    result = CliRunner().invoke(calibrate, ["--config", str(config), "--new", "ball"])
    assert result.exit_code == 2
    assert "station calibrate ball" in result.output


def test_a_replay_speaks_within_a_second(config: Path, tmp_path: Path) -> None:
    """It was silent for seconds while compiled code was loaded. Processor time, as the tests share
    the machine."""
    command = [sys.executable, "-m", "station.cli", "calibrate", "--config", str(config)]
    with subprocess.Popen(
        [*command, "--recordings", str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        words = process.stdout.readline()
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        process.kill()
    assert words == "starting ...\n"
    ticks = int(fields[11]) + int(fields[12])
    assert ticks / os.sysconf("SC_CLK_TCK") < 1.0


def test_a_step_that_fails_does_not_take_the_calibration_in_use_up_again(
    config: Path, store: CalibrationStore
) -> None:
    """The next calibration would have been solved from what was seen before a camera was moved."""
    session = _begin(store)
    session.record_empty({}, [])
    store.use(store.finish(replace(default_rig(), created="2026-11-01T10:00:00Z"), {}).name)
    with pytest.raises(BoothError):
        _raised(_run(config, "around", "--recordings", str(config.parent), "--yes"))
    assert not store.unfinished.exists()
    store.reopen("20261101T100000Z")
    with pytest.raises(CalibrationError, match="station calibrate solve puts them into use"):
        _raised(_run(config, "--yes"))


def _raised(result: Result) -> None:
    if result.exception is not None:
        raise result.exception
