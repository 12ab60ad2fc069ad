"""From an empty booth and a waved ball to a calibration in use, through libfreenect's replay."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from running_station import Station

from station.calibration.guide.session import Session
from station.core.errors import DriverError
from station.core.geometry import invert, so3_log
from station.core.rig import Rig
from station.sensors.freenect import find_library
from station.simulation.record_cli import PROCEDURE, TRUTH

STATION = (sys.executable, "-m", "station.cli")
BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"


def _driver() -> str:
    try:
        find_library(replay=True)
    except DriverError:
        return "recorded"
    return "freenect"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A booth whose cameras nobody has told the station of."""
    folder = tmp_path_factory.mktemp("uncalibrated")
    command = [*STATION, "record-virtual", "--body", str(BODY), "--out", str(folder)]
    options = ["--calibration", "16", "--frames", "1", "--passes", "1", "--driver", _driver()]
    subprocess.run([*command, *options], check=True, capture_output=True)
    # The cameras themselves say where the person faces.
    shutil.rmtree(folder / PROCEDURE / "front")
    return folder


def _command(config: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*STATION, *words, "--config", str(config)],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip


def test_a_booth_is_calibrated_from_replayed_recordings(recorded: Path) -> None:
    config = recorded / "booth.toml"
    assert not (recorded / "calibration.json").exists()
    done = _command(config, "calibrate", "--recordings", str(recorded / PROCEDURE))
    assert done.returncode == 0, done.stdout + done.stderr
    found, truth = Rig.load(recorded / "calibration.json"), Rig.load(recorded / TRUTH)
    assert set(found.cameras) == set(truth.cameras)
    one = truth.reference
    for name in truth.cameras:
        ours, true = (
            invert(rig.cameras[one].world_from_camera) @ rig.cameras[name].world_from_camera
            for rig in (found, truth)
        )
        off = invert(true) @ ours
        assert np.linalg.norm(off[:3, 3]) < 0.006, name
        assert np.linalg.norm(so3_log(off[:3, :3])) < np.radians(0.3), name
        # The world frame itself: floor, mark, and where the person faces.
        place = found.cameras[name].world_from_camera[:3, 3]
        assert np.linalg.norm(place - truth.cameras[name].world_from_camera[:3, 3]) < 0.03
    entries = [path.name for path in (recorded / "calibrations").iterdir() if path.is_dir()]
    assert len(entries) == 1
    entry = recorded / "calibrations" / entries[0]
    assert json.loads((entry / "report.json").read_text())
    assert len(Session.load(entry).balls) > 100
    listed = _command(config, "calibrate", "--list")
    assert listed.stdout.startswith(f"* {entries[0]}")
    checked = _command(config, "check", "--recordings", str(recorded / PROCEDURE / "empty"))
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert checked.stdout.count("stands where it was calibrated") == 4
    assert "does not look as it did" not in checked.stdout
    assert "the booth is in order" in checked.stdout


def test_live_cameras_are_looked_at_like_recordings(make_station: Callable[..., Station]) -> None:
    station = make_station(
        "[workers]\ncount = 0", lambda text: text.replace("freenect", "recorded")
    )
    done = station.command("calibrate", "floor", "--yes")
    assert done.returncode == 0, done.stderr
    assert "empty booth kept" in done.stdout
    session = Session.load(station.config.parent / "calibrations/unfinished")
    assert set(session.cameras) == {"front-lower", "front-upper", "back-lower", "back-upper"}
    assert session.background("back-upper") is not None
