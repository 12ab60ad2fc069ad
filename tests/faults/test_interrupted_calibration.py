"""A calibration that is interrupted, killed or misses something: nothing that was seen is lost."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from ctrl_c import heard
from waiting import wait_until

from station.calibration.detect.step_names import BALL, EMPTY, MARK
from station.calibration.guide.session import JOURNAL, Session
from station.calibration.guide.store import CalibrationStore
from station.sensors.recording import RecordedFrame, write_recording
from station.simulation.procedure import VirtualProcedure
from station.simulation.scene import default_rig
from station.simulation.sensor import TICK_HZ

STATION = (sys.executable, "-m", "station.cli")
CAMERAS = ("front-lower", "front-upper")
WAVING_S = 5.0


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras' empty booth and a ball that is waved for a few seconds."""
    folder = tmp_path_factory.mktemp("procedure")
    procedure = VirtualProcedure(waving_s=WAVING_S)
    for step, stride in ((EMPTY, 2), (BALL, 3)):
        for name in CAMERAS:
            frames = procedure.frames(name, step, stride=stride)
            write_recording(
                folder / step / name,
                (RecordedFrame(frame.time_s, frame.ticks, frame.raw) for frame in frames),
                tick_hz=TICK_HZ,
            )
    return folder


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "booth.toml"
    lines = ["[calibrate]", "waving_s = 16"]
    for name in CAMERAS:
        lines += ["[[cameras]]", f'name = "{name}"', 'driver = "recorded"', 'recording = "none"']
    path.write_text("\n".join(lines))
    return path


def _command(config: Path, recordings: Path, *words: str) -> list[str]:
    return [*STATION, "calibrate", *words, "--config", str(config), "--recordings", str(recordings)]


def _run(config: Path, recordings: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        _command(config, recordings, *words),
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def _wait_for_the_ball(journal: Path) -> None:
    """Wait until the ball was seen."""
    wait_until(
        lambda: journal.exists() and '"step":"ball"' in journal.read_text(), "the ball", 120.0
    )


def test_killed_while_the_ball_is_waved(config: Path, recordings: Path) -> None:
    """kill -9: what was seen up to a second before is there, and the next run adds to it."""
    folder = config.parent / "calibrations/unfinished"
    done = _run(config, recordings, "floor")
    assert done.returncode == 0, done.stderr
    assert "empty booth kept" in done.stdout
    waving = subprocess.Popen(
        _command(config, recordings, "ball"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _wait_for_the_ball(folder / JOURNAL)
    assert waving.poll() is None
    os.kill(waving.pid, signal.SIGKILL)
    waving.wait()
    seen = len(Session.load(folder).balls)
    assert seen > 0
    again = _run(config, recordings, "ball")
    assert again.returncode == 0, again.stderr
    session = Session.load(folder)
    assert len(session.balls) > seen
    assert session.runs == 2
    assert session.done(EMPTY)
    refused = _run(config, recordings, "solve")
    assert refused.returncode == 1
    assert refused.stderr.startswith("error: ")
    assert refused.stderr.count("\n") == 1
    assert len(Session.load(folder).balls) == len(session.balls)
    assert not (config.parent / "calibration.json").exists()


def test_stopped_while_the_ball_is_waved(config: Path, recordings: Path) -> None:
    """Ctrl-C ends the command, not only the step; it went on to the next one."""
    folder = config.parent / "calibrations/unfinished"
    waving = subprocess.Popen(
        _command(config, recordings),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        preexec_fn=heard,
    )  # fmt: skip
    _wait_for_the_ball(folder / JOURNAL)
    assert waving.poll() is None
    waving.send_signal(signal.SIGINT)
    told = waving.communicate(timeout=30)[0]
    assert waving.returncode == -signal.SIGINT, told
    assert "stopped; what was seen is kept; station calibrate goes on from here" in told
    session = Session.load(folder)
    assert session.balls
    assert not session.done(MARK)


def test_a_ball_waved_anew_replaces_the_one_in_use(config: Path, recordings: Path) -> None:
    """The calibration that was solved from it keeps what it saw; it refused the step."""
    store = CalibrationStore(config.parent / "calibrations", config.parent / "calibration.json")
    for step in ("floor", "ball"):
        assert _run(config, recordings, step).returncode == 0
    seen = len(Session.load(store.unfinished).balls)
    rig = replace(default_rig(), created="2026-11-01T10:00:00Z")
    solved = store.use(store.finish(rig, {}).name)
    done = _run(config, recordings, "ball", "--again")
    assert done.returncode == 0, done.stderr
    assert f"added to what calibration {solved.name} was solved from" in done.stdout
    # A busy machine misses frames of a replay.
    assert 0 < len(Session.load(store.unfinished).balls) < 1.5 * seen
    assert len(Session.load(solved.folder).balls) == seen
    store.abandon()
    begun = _run(config, recordings, "floor")
    assert "a new calibration; until it is solved, the other is in use" in begun.stdout


def test_a_missing_camera_is_named_and_nothing_is_lost(
    config: Path, recordings: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(recordings / EMPTY, copy / EMPTY, copy_function=os.link)
    shutil.rmtree(copy / EMPTY / "front-upper")
    done = _run(config, copy, "floor")
    assert done.returncode == 1
    assert "front-upper" in done.stderr
    assert done.stderr.count("\n") == 1


def test_steps_in_the_wrong_order_say_which_comes_first(config: Path, recordings: Path) -> None:
    done = subprocess.run(
        [*STATION, "calibrate", "solve", "--config", str(config)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "no calibration has been started" in done.stderr
    moved = config.parent / "only-ball"
    shutil.copytree(recordings / BALL, moved / "wall-0", copy_function=os.link)
    done = _run(config, moved, "depth")
    assert done.returncode == 1
    assert "station calibrate goes through all steps" in done.stderr


def test_another_ball_is_not_mixed_in(config: Path, recordings: Path) -> None:
    assert _run(config, recordings, "floor").returncode == 0
    config.write_text(
        config.read_text().replace("[calibrate]", "[calibrate]\nball_radius_m = 0.12")
    )
    done = _run(config, recordings, "ball")
    assert done.returncode == 1
    assert "radius of 0.1 m, but booth.toml says 0.12 m" in done.stderr
    anew = _run(config, config.parent, "--new")
    assert "what was seen so far is kept" in anew.stdout
    assert (config.parent / "calibrations/abandoned-1/scene/front-lower.npz").exists()
