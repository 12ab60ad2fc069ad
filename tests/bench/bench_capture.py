"""Four replayed sensors at 30 Hz through the real processes: losses, framesets, latency, load."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"
STATION = (sys.executable, "-m", "station.cli")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--driver",
        choices=["freenect", "recorded"],
        default="recorded",
        help="freenect: the replay library paces itself, at 28.9 Hz",
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        passes = str(int(arguments.seconds) + 60)
        options = ("--body", BODY, "--out", folder, "--frames", "30", "--passes", passes)
        command = [*STATION, "record-virtual", *options, "--driver", arguments.driver]
        subprocess.run(command, check=True, capture_output=True)
        config = folder / "booth.toml"
        extra = "\n[workers]\ncount = 0\n[console]\nenabled = false\n"
        config.write_text(config.read_text() + extra)
        environment = {**os.environ, "BOOTH_CONFIG": str(config)}
        station = subprocess.Popen([*STATION, "run"], env=environment)
        try:
            time.sleep(3.0)
            subprocess.run([*STATION, "start"], env=environment, check=True)
            time.sleep(3.0)
            measure(station.pid, environment, arguments.seconds)
        finally:
            station.send_signal(signal.SIGTERM)
            station.wait(timeout=20)


def measure(pid: int, environment: dict[str, str], seconds: float) -> None:
    """Print the table of one run."""
    children = psutil.Process(pid).children(recursive=True)
    before = status(environment)
    used_before, start_s = cpu_seconds(children), time.monotonic()
    time.sleep(seconds)
    used, elapsed_s = cpu_seconds(children), time.monotonic() - start_s
    after = status(environment)
    # Counted from when sync said so to when it said so again.
    sets = (after["framesets"] - before["framesets"]) / (after["told_s"] - before["told_s"])
    lost = sum(camera["lost"] for camera in after["cameras"].values())
    frames = sum(
        after["cameras"][name]["frames"] - before["cameras"][name]["frames"]
        for name in after["cameras"]
    )
    total = 0.0
    print(f"\n{seconds:.0f} s, {len(after['cameras'])} cameras at 640x480, 30 Hz")
    for name, seconds_used in used.items():
        share = (seconds_used - used_before[name]) / elapsed_s
        total += share
        print(f"  {name:<24} {100 * share:5.1f} % of a core")
    print(f"  all processes            {100 * total:5.1f} % of a core   (bar: < 50)")
    print(f"  frames                   {frames}, lost {lost}   (bar: 0 lost)")
    print(f"  framesets                {sets:.2f} /s   (bar: >= 29)")
    p50, p99 = 1e3 * after["latency_p50_s"], 1e3 * after["latency_p99_s"]
    print(f"  latency                  p50 {p50:.1f} ms, p99 {p99:.1f} ms   (bars: < 20, < 40)")


def status(environment: dict[str, str]) -> dict[str, Any]:
    done = subprocess.run(
        [*STATION, "status", "--json"], env=environment, capture_output=True, check=False
    )
    sensed: dict[str, Any] = json.loads(done.stdout)["sync"]
    return sensed


def cpu_seconds(processes: list[psutil.Process]) -> dict[str, float]:
    used = {}
    for process in processes:
        words = [w for w in process.cmdline() if w not in ("--config",) and "/" not in w]
        times = process.cpu_times()
        used[" ".join(words[2:])] = times.user + times.system
    return used


if __name__ == "__main__":
    main()
