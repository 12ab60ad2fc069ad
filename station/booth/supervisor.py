"""`station run`: all processes of a booth in the foreground, restarted when they die or hang.

The processes report progress in the same way as to systemd: each has a socket that NOTIFY_SOCKET
names (sd_notify). A process that reports none within its time limit is killed and restarted.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click

from station.core.commands import config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.core.files import held, private_folder
from station.core.service import (
    STATION_LOCK,
    die_with_parent,
    file_name,
    set_up_logs,
    stop_event,
)
from station.messaging.transport import socket_folder

WATCHDOG_S = 10.0
"""As in the systemd units. A main loop's longest step is far below a second."""
_STARTING_S = 120.0
"""Compiling the reconstruction for the first time takes most of a minute."""
_BACK_OFF_S = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""A process that keeps dying is restarted within seconds each time. With 2 s at most, nine of them
whose configuration had been deleted kept both cores busy."""
_CALM_S = 10.0
_STOP_S = 5.0
_LOG = logging.getLogger("run")


@dataclass(frozen=True, slots=True)
class Service:
    """One process of the booth."""

    name: str
    """Its name in `station status`; its health file and its lock are named after it."""
    command: tuple[str, ...]
    """The command line without the configuration."""


def services(config: BoothConfig) -> list[Service]:
    """Every process that a booth consists of; `station.booth.health` expects a report of each."""
    station = (sys.executable, "-m", "station.cli")
    table = [
        Service("control", (*station, "control")),
        Service("sync", (*station, "sync")),
        *(
            Service(f"capture {camera.name}", (*station, "capture", camera.name))
            for camera in config.cameras
        ),
    ]
    if config.workers.count:
        table.append(Service("workers", (sys.executable, "-m", "workers.cli", "work")))
    if config.console.enabled:
        table.append(Service("console", (*station, "console")))
    if config.deliver:
        table.append(Service("deliver", (*station, "deliver")))
    return table


def _socket_name(service: str) -> str:
    return f"notify-{file_name(service)}"


class _Watch:
    """Receives the progress messages of one process."""

    def __init__(self, folder: Path, name: str) -> None:
        self.path = str(folder / _socket_name(name))
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._socket.bind(self.path)
        self.begin()

    def begin(self) -> None:
        """Reset for a new process: messages of the old one are ignored."""
        self._receive()
        self._limit_s, self._last_s = _STARTING_S, time.monotonic()

    def silent_for_s(self) -> float:
        """Seconds since its time limit; negative before it."""
        self._receive()
        return time.monotonic() - self._last_s - self._limit_s

    def _receive(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                for word in self._socket.recv(4096).decode(errors="replace").splitlines():
                    key, _, value = word.partition("=")
                    if key == "READY":
                        self._limit_s = WATCHDOG_S
                    if key == "WATCHDOG_USEC" and value.isdigit():
                        self._limit_s = int(value) / 1e6
                    self._last_s = time.monotonic()

    def close(self) -> None:
        self._socket.close()
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.path)


class _Child:
    """One supervised process."""

    def __init__(self, service: Service, config_path: Path, folder: Path) -> None:
        self.service = service
        self._command = (*service.command, "--config", str(config_path))
        self.process: subprocess.Popen[bytes] | None = None
        self.watch = _Watch(folder, service.name)
        self._failures = 0
        self._started_s = 0.0
        self._next_s = 0.0

    def look_after(self) -> None:
        """Start it when it does not run, with growing pauses while it keeps dying."""
        now_s = time.monotonic()
        if self.process is not None and self.process.poll() is None:
            if self.watch.silent_for_s() > 0.0:
                _LOG.warning("%s hangs; killing it", self.service.name)
                self.process.kill()
                self.process.wait()
            return
        if self.process is not None:
            self._put_off(now_s, f"ended with code {self.process.returncode}")
            self.process = None
        if now_s >= self._next_s:
            self._started_s = now_s
            self.watch.begin()
            try:
                self._start()
            except OSError as error:
                # Too many processes, or too little memory: no reason to end the others.
                self._put_off(now_s, f"cannot be started ({error.strerror or error})")

    def _put_off(self, now_s: float, why: str) -> None:
        self._failures = 0 if now_s - self._started_s > _CALM_S else self._failures + 1
        pause_s = _BACK_OFF_S[min(self._failures, len(_BACK_OFF_S) - 1)]
        self._next_s = now_s + pause_s
        _LOG.warning("%s %s; restarting it in %g s", self.service.name, why, pause_s)

    def _start(self) -> None:
        self.process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            env={
                **os.environ,
                "NOTIFY_SOCKET": self.watch.path,
                "WATCHDOG_USEC": str(int(1e6 * WATCHDOG_S)),
            },
            preexec_fn=partial(die_with_parent, os.getpid()),
        )

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()


def supervise(table: list[Service], config_path: Path, folder: Path, stop: threading.Event) -> None:
    """Keep all services running until told to stop; `folder` holds the sockets for their progress
    messages."""
    children = [_Child(service, config_path, folder) for service in table]
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
            if child.process is not None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.process.wait(max(0.1, deadline_s - time.monotonic()))
                if child.process.poll() is None:
                    child.process.kill()
            child.watch.close()


@click.command()
@config_option
def run(config_path: Path | None) -> None:
    """Run the whole booth in the foreground until Ctrl-C; an installed booth uses systemd instead.

    \b
    Examples:
      station run --config booth.toml
    """
    path = find_config(config_path)
    config = load_config(path)
    folder = private_folder(config.runtime.folder)
    busy = BoothError(
        f"a station is already running in {folder}; end it first (Ctrl-C in its terminal)"
    )
    with held(folder / STATION_LOCK, busy):
        click.echo(
            f"the booth of {path} is running; Ctrl-C ends it; next, in another terminal: "
            "station start"
        )
        if not config.calibration.exists():
            from station.calibration.guide.store import CalibrationStore

            click.echo(CalibrationStore.of(config).missing_words())
        set_up_logs(_LOG.name)
        table = services(config)
        longest = max((_socket_name(service.name) for service in table), key=len)
        supervise(table, path.resolve(), socket_folder(folder, longest), stop_event())
