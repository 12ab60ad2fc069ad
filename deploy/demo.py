"""`make demo`: a booth of four replayed Kinects, one scan, the result's path printed."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from station.drivers.freenect import find_library
from station.errors import DriverError

BODY = Path(__file__).parents[1] / "station/data/bodies/ann.npz"
STATION = (sys.executable, "-m", "station.cli")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="where it all goes")
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
        print("rendering four Kinect recordings of a virtual person ...", flush=True)
        options = ("--body", arguments.body, "--out", booth, "--driver", driver)
        subprocess.run([*STATION, "record-virtual", *options], check=True)
    environment = {**os.environ, "BOOTH_CONFIG": str(config)}
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


def _wait_for_control(environment: dict[str, str]) -> None:
    """The station is up when it answers."""
    for _ in range(10):
        answer = subprocess.run(
            [*STATION, "status"], env=environment, capture_output=True, check=False
        )
        if answer.returncode == 0:
            return
        time.sleep(0.2)
    raise SystemExit("error: the station did not start; read its log")


if __name__ == "__main__":
    sys.exit(main())
