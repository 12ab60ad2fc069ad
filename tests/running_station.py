"""A running station and its operator, for tests of the whole."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import psutil

from station.core.service import answered, die_with_parent

STATION = (sys.executable, "-m", "station.cli")


class Station:
    """A running station and its operator."""

    def __init__(self, config: Path, variables: Mapping[str, str] | None = None) -> None:
        """Start it; `variables` are added to its environment and to the operator's."""
        self.config = config
        self.log = config.parent / "station.log"
        self._environment = {**os.environ, "BOOTH_CONFIG": str(config), **(variables or {})}
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [*STATION, "run"],
                env=self._environment,
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=partial(die_with_parent, os.getpid()),
            )
        try:
            self.wait_until(
                lambda: answered(self.command("status", "--json").stdout), "control answers"
            )
        except BaseException:
            self.close()
            raise

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
