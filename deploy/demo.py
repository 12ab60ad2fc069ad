"""`make demo`: a booth of four replayed Kinects is calibrated, then scans; the result's path is
printed."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from station.calibration.detect.step_names import EMPTY
from station.core.errors import DriverError
from station.core.geometry import invert, so3_log
from station.core.rig import Rig
from station.core.service import answered
from station.sensors.freenect import find_library
from station.simulation.record_cli import HEADING, PROCEDURE, TRUTH
from station.simulation.scene import default_rig

BODY = Path(__file__).parents[1] / "station/simulation/bodies/ann.npz"
STATION = (sys.executable, "-m", "station.cli")
WAVING_S = 24
_STARTS_S = 60.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="output folder")
    parser.add_argument("--body", type=Path, default=BODY, help="the virtual person")
    arguments = parser.parse_args()
    booth = arguments.folder.resolve() / arguments.body.stem
    config = booth / "booth.toml"
    try:
        find_library(replay=True)
        driver = "freenect"
    except DriverError as error:
        print(f"note: {error}; reading the same recordings with the recorded driver")
        driver = "recorded"
    if not config.exists() or f'"{driver}"' not in config.read_text():
        clear(booth)
        print("rendering what four Kinects see during a calibration and a scan ...", flush=True)
        options = ("--body", arguments.body, "--out", booth, "--driver", driver)
        calibration = ("--calibration", str(WAVING_S))
        record = [*STATION, "record-virtual", *options, *calibration]
        subprocess.run(record, check=True)
    environment = {**os.environ, "BOOTH_CONFIG": str(config)}
    if not (booth / "calibration.json").exists():
        calibrate = [*STATION, "calibrate", "--recordings", str(booth / PROCEDURE)]
        if subprocess.run(calibrate, env=environment, check=False).returncode:
            return 1
        discard(booth / PROCEDURE)
    compare(Rig.load(booth / "calibration.json"), Rig.load(booth / TRUTH))
    log = (booth / "station.log").open("w")
    print(f"starting the station (log: {log.name}) ...", flush=True)
    station = subprocess.Popen(
        [*STATION, "run"], env=environment, stdout=log, stderr=subprocess.STDOUT
    )
    try:
        _wait_for_control(environment)
        subprocess.run([*STATION, "start"], env=environment, check=True)
        done = subprocess.run([*STATION, "scan", "--label", "demo"], env=environment, check=False)
        subprocess.run([*STATION, "stop"], env=environment, check=True)
    finally:
        station.send_signal(signal.SIGTERM)
        station.wait(timeout=15)
    return done.returncode


def clear(booth: Path) -> None:
    """Delete what an interrupted demo, or one with another driver, recorded; nothing else."""
    config = booth / "booth.toml"
    if config.exists() and not config.read_text().startswith(HEADING):
        return
    for name in (PROCEDURE, *default_rig().cameras):
        shutil.rmtree(booth / name, ignore_errors=True)
    for name in ("booth.toml", "calibration.json", TRUTH):
        (booth / name).unlink(missing_ok=True)


def discard(procedure: Path) -> None:
    """Delete a calibration's recordings but the empty booth's, which `station check` can replay.

    What was detected in them is kept beside the calibration; they take a gigabyte and a half.
    """
    for step in procedure.iterdir():
        if step.name != EMPTY:
            shutil.rmtree(step)


def compare(found: Rig, truth: Rig) -> None:
    """Print how well the calibration found the cameras, relative to one another."""
    reference = truth.reference
    shifts_m, turns_rad = [], []
    for name in truth.cameras:
        (ours, true) = (
            invert(rig.cameras[reference].world_from_camera) @ rig.cameras[name].world_from_camera
            for rig in (found, truth)
        )
        off = invert(true) @ ours
        shifts_m.append(np.linalg.norm(off[:3, 3]))
        turns_rad.append(np.linalg.norm(so3_log(off[:3, :3])))
    print(
        f"the cameras were found within {1e3 * max(shifts_m):.1f} mm and "
        f"{np.degrees(max(turns_rad)):.2f} degrees of where they are, relative to {reference}"
    )


def _wait_for_control(environment: dict[str, str]) -> None:
    """Wait until the station responds."""
    deadline_s = time.monotonic() + _STARTS_S
    while time.monotonic() < deadline_s:
        done = subprocess.run(
            [*STATION, "status", "--json"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if answered(done.stdout):
            return
        time.sleep(0.2)
    raise SystemExit("error: the station did not start; read its log")


if __name__ == "__main__":
    sys.exit(main())
