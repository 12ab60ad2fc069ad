"""`station run`: all processes of a booth in the foreground, restarted when they die."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import click

from station.core.config import BoothConfig, find_config, load_config
from station.core.errors import BoothError
from station.core.files import held
from station.core.service import die_with_parent, stop_event

_BACK_OFF_S = (0.1, 0.5, 1.0, 2.0, 5.0, 10.0)
_CALM_S = 30.0
_STOP_S = 5.0


@dataclass(frozen=True, slots=True)
class Service:
    """One process of the booth."""

    name: str
    command: tuple[str, ...]


def services(config: BoothConfig, path: Path) -> list[Service]:
    """Every process that a booth consists of."""
    python = sys.executable
    option = ("--config", str(path))
    station = (python, "-m", "station.cli")
    table = [
        Service("control", (*station, "control", *option)),
        Service("sync", (*station, "sync", *option)),
        *(
            Service(f"capture {camera.name}", (*station, "capture", camera.name, *option))
            for camera in config.cameras
        ),
    ]
    if config.workers.count:
        table.append(Service("workers", (python, "-m", "workers.cli", "work", *option)))
    if config.console.enabled:
        table.append(Service("console", (*station, "console", *option)))
    if config.deliver:
        table.append(Service("deliver", (*station, "deliver", *option)))
    return table


class _Child:
    """One supervised process."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.process: subprocess.Popen[bytes] | None = None
        self._failures = 0
        self._started_s = 0.0
        self._next_s = 0.0

    def look_after(self) -> None:
        """Start it when it does not run, with growing pauses while it keeps dying."""
        now_s = time.monotonic()
        if self.process is not None and self.process.poll() is None:
            return
        if self.process is not None:
            self._failures = 0 if now_s - self._started_s > _CALM_S else self._failures + 1
            pause_s = _BACK_OFF_S[min(self._failures, len(_BACK_OFF_S) - 1)]
            self._next_s = now_s + pause_s
            click.echo(
                f"{self.service.name} ended with code {self.process.returncode}; "
                f"starting it again in {pause_s:g} s",
                err=True,
            )
            self.process = None
        if now_s >= self._next_s:
            self._started_s = now_s
            self.process = subprocess.Popen(
                self.service.command, stdin=subprocess.DEVNULL, preexec_fn=die_with_parent
            )

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()


def supervise(table: list[Service], stop: threading.Event) -> None:
    """Keep all services running until told to stop."""
    children = [_Child(service) for service in table]
    try:
        while not stop.is_set():
            for child in children:
                child.look_after()
            stop.wait(0.1)
    finally:
        for child in children:
            child.stop()
        deadline_s = time.monotonic() + _STOP_S
        for child in children:
            if child.process is None:
                continue
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(max(0.1, deadline_s - time.monotonic()))
            if child.process.poll() is None:
                child.process.kill()


@click.command()
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
def run(config_path: Path | None) -> None:
    """Run the whole booth in the foreground until Ctrl-C; on a station systemd does this.

    \b
    Examples:
      station run --config booth.toml
    """
    path = find_config(config_path)
    config = load_config(path)
    folder = config.runtime.folder
    busy = BoothError(f"a station runs already in {folder}; end it first (Ctrl-C in its terminal)")
    with held(folder / "station.lock", busy):
        click.echo(f"the booth of {path} runs until Ctrl-C; next, elsewhere: station start")
        if not config.calibration.exists():
            click.echo(
                f"{config.calibration} is missing: station calibrate comes before the first scan"
            )
        supervise(services(config, path.resolve()), stop_event())
