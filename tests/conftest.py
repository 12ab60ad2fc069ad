"""One virtual booth for all tests: four recordings of a person that no model was trained on."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

BODIES = Path(__file__).parents[1] / "station/simulation/bodies"
STATION = (sys.executable, "-m", "station.cli")


@pytest.fixture(scope="session")
def booth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings, calibration.json and booth.toml."""
    folder = tmp_path_factory.mktemp("booth")
    options = ("--body", BODIES / "ann.npz", "--out", folder, "--frames", "12", "--passes", "150")
    subprocess.run([*STATION, "record-virtual", *options], check=True, capture_output=True)
    return folder


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan bundle of another body, on an ordinary day."""
    from station.simulation.scene import load_mesh
    from station.simulation.sensor import SimulatedBooth, render_bundle

    folder = tmp_path_factory.mktemp("bundles") / "ben"
    return render_bundle(load_mesh(BODIES / "ben.npz"), folder, SimulatedBooth(seed=4))


class Station:
    """A running station and its operator."""

    def __init__(self, config: Path) -> None:
        self.config = config
        self.log = config.parent / "station.log"
        self._environment = {**os.environ, "BOOTH_CONFIG": str(config)}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [*STATION, "run"], env=self._environment, stdout=log, stderr=subprocess.STDOUT
            )
        self.wait_until(lambda: self.command("status").returncode == 0, "control answers")

    def command(self, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*STATION, *words],
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )

    def wait_until(self, true: Callable[[], bool], what: str, limit_s: float = 60.0) -> None:
        deadline_s = time.monotonic() + limit_s
        while not true():
            assert time.monotonic() < deadline_s, f"{what}: not within {limit_s} s\n" + (
                self.log.read_text()
            )
            time.sleep(0.1)

    def pids(self, module: str, *words: str) -> list[int]:
        """Processes of this station by what stands on their command line."""
        import psutil

        found = []
        for child in psutil.Process(self.process.pid).children(recursive=True):
            try:
                line = child.cmdline()
            except psutil.Error:
                continue
            if module in line and all(word in line for word in words):
                found.append(child.pid)
        return found

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(timeout=20)


@pytest.fixture
def make_station(booth: Path, tmp_path: Path) -> Iterator[Callable[[str], Station]]:
    """Starts stations on the booth's recordings; what is given is added to booth.toml."""
    running: list[Station] = []

    def make(extra: str = "", change: Callable[[str], str] = lambda text: text) -> Station:
        config = tmp_path / "booth.toml"
        text = (booth / "booth.toml").read_text().replace('recording = "', f'recording = "{booth}/')
        config.write_text(f'calibration = "{booth}/calibration.json"\n{change(text)}\n{extra}\n')
        running.append(Station(config))
        return running[-1]

    yield make
    for station in running:
        station.close()
