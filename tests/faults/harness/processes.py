"""Processes of a running booth killed and stopped while scans are taken."""

from __future__ import annotations

import os
import random
import secrets
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import psutil
from running_station import Station
from table import Row, percentile

from station.booth.health import MAX_AGE_S, booth_health
from station.core.config import BoothConfig, load_config

_NAMED_S, _REPLACED_S, _FRAMES_S = 5.0, 15.0, 3.0
_WAIT_S = 90.0


class Scans:
    """Scans that were ordered, what was said of them, and what came of them."""

    def __init__(self, station: Station, config: BoothConfig) -> None:
        self._station, self._config = station, config
        self.told: dict[str, tuple[int, str]] = {}

    def take(self) -> None:
        """Order one and wait for the word on it."""
        scan_id = f"h-{secrets.token_hex(6)}"
        done = self._station.command("scan", "--no-wait", "--scan-id", scan_id)
        self.told[scan_id] = done.returncode, done.stderr.strip()

    def settle(self) -> None:
        """Wait until nothing waits or is worked on."""
        spool = self._config.spool.folder
        deadline_s = time.monotonic() + _WAIT_S
        while time.monotonic() < deadline_s:
            if not any(True for state in ("queue", "work") for _ in (spool / state).iterdir()):
                return
            time.sleep(0.2)

    def row(self, fault: str) -> Row:
        """Statements of the station, compared with the folders on disk."""
        spool = self._config.spool.folder
        kept = {
            state: {p.name for p in (spool / state).iterdir()} for state in ("outbox", "failed")
        }
        accepted = [scan for scan, (code, _) in self.told.items() if code == 0]
        refused = [
            scan
            for scan, (code, words) in self.told.items()
            if code and "not known yet" not in words
        ]
        lost = [scan for scan in accepted if scan not in kept["outbox"] | kept["failed"]]
        ghosts = [scan for scan in refused if scan in kept["outbox"]]
        return Row(
            fault,
            "accepted ones delivered, none failed and delivered",
            f"{len(self.told)} scans, {len(accepted)} accepted, {len(lost)} lost, "
            f"{len(ghosts)} ghosts",
            not lost and not ghosts and bool(accepted),
        )


def _processes(station: Station, config: BoothConfig) -> dict[str, Callable[[], list[int]]]:
    """Each process of the booth by name -> its process ids now."""
    table: dict[str, Callable[[], list[int]]] = {
        "control": lambda: station.pids("control"),
        "sync": lambda: station.pids("sync"),
        "workers": lambda: station.pids("workers.cli"),
    }
    for camera in config.cameras:
        table[f"capture {camera.name}"] = partial(station.pids, "capture", camera.name)
    return table


def kill_rows(station: Station, kills: int, seed: int) -> list[Row]:
    """kill -9 of a random process at a random moment of a scan, so many times."""
    config = load_config(station.config)
    rng = random.Random(seed)
    scans, back_s = Scans(station, config), list[float]()
    table = _processes(station, config)
    for _ in range(kills):
        name = rng.choice(list(table))
        taking = threading.Thread(target=scans.take)
        taking.start()
        time.sleep(rng.uniform(0.2, 2.5))
        before = _framesets(config)
        for pid in table[name]():
            os.kill(pid, signal.SIGKILL)
        killed_s = time.monotonic()
        taking.join()
        while _framesets(config) in (before, None) and time.monotonic() - killed_s < _WAIT_S:
            time.sleep(0.05)
        if name != "control" and name != "workers":
            back_s.append(time.monotonic() - killed_s)
        station.wait_until(lambda: _well(config), "the booth is whole again", _WAIT_S)
    # Each kill may rightly have cost its scan; nothing costs this one.
    scans.take()
    scans.settle()
    worst = max(back_s, default=0.0)
    return [
        scans.row(f"kill -9 at random moments, {kills} times"),
        Row(
            "frames after kill -9 of capture or sync",
            f"again within {_FRAMES_S:g} s (a quiet machine)",
            f"p50 {percentile(back_s, 0.5):.1f} s, worst {worst:.1f} s",
            worst <= _FRAMES_S,
            timed=True,
        ),
    ]


def stop_rows(station: Station, names: list[str]) -> list[Row]:
    """SIGSTOP of each process: named, then replaced."""
    config = load_config(station.config)
    table = _processes(station, config)
    named_s, replaced_s = list[float](), list[float]()
    for name in names:
        [victim, *_] = table[name]()
        stopped_s = time.monotonic()
        os.kill(victim, signal.SIGSTOP)
        _until(partial(_named, config, name))
        named_s.append(time.monotonic() - stopped_s)
        _until(partial(_told_anew, config, name, victim))
        replaced_s.append(time.monotonic() - stopped_s)
    return [
        Row(
            f"SIGSTOP of {', '.join(names)}",
            f"named within {_NAMED_S:g} s, replaced within {_REPLACED_S:g} s",
            f"named {max(named_s):.1f} s, replaced {max(replaced_s):.1f} s",
            max(named_s) <= _NAMED_S and max(replaced_s) <= _REPLACED_S,
            timed=True,
        )
    ]


def job_rows(station: Station) -> list[Row]:
    """A job that crashes: its scan is tried again, and the next one is delivered."""
    config = load_config(station.config)
    scans = Scans(station, config)
    scans.take()
    deadline_s = time.monotonic() + _WAIT_S
    while not list((config.spool.folder / "work").iterdir()) and time.monotonic() < deadline_s:
        time.sleep(0.02)
    for pid in station.pids("workers.reconstruct.job_process"):
        os.kill(pid, signal.SIGSEGV)
    scans.take()
    scans.settle()
    return [scans.row("SIGSEGV in the worker's jobs")]


def full_disk_rows(station: Station) -> list[Row]:
    """A disk without room: refused before the person is scanned, and well again without hands."""
    config = load_config(station.config)
    free = psutil.disk_usage(str(config.spool.folder)).free
    ballast = config.spool.folder.parent / "ballast"
    if free > 1 << 31:
        return []
    with ballast.open("wb") as stream:
        os.posix_fallocate(stream.fileno(), 0, max(1, free - (8 << 20)))
    refused = station.command("scan", "--no-wait")
    ballast.unlink()
    again = station.command("scan", "--no-wait")
    return [
        Row(
            "disk full",
            "refused before the scan, well without hands",
            f"exit codes {refused.returncode}, {again.returncode}",
            refused.returncode == 1 and "MB" in refused.stderr and again.returncode == 0,
        )
    ]


def memory_slopes(station: Station, seconds: float) -> list[Row]:
    """Growth of the processes' memory and descriptors while scans are taken."""
    scans = Scans(station, load_config(station.config))
    before = _sizes(station)
    began_s = time.monotonic()
    while time.monotonic() - began_s < seconds:
        scans.take()
        # The next one when this one is delivered: what is scanned faster only waits.
        scans.settle()
    hours = (time.monotonic() - began_s) / 3600.0
    after = _sizes(station)
    slope_mb = max((after[p][0] - before[p][0]) / 1e6 / hours for p in before if p in after)
    opened = max(after[p][1] - before[p][1] for p in before if p in after)
    return [
        scans.row(f"soak of {seconds / 60:.0f} min"),
        Row(
            "memory and descriptors of a process",
            "< 1 MB/h, flat",
            f"{slope_mb:.1f} MB/h, {opened:+d} descriptors",
            slope_mb < 1.0 and opened <= 2,
        ),
    ]


def _sizes(station: Station) -> dict[int, tuple[int, int]]:
    children = psutil.Process(station.process.pid).children(recursive=True)
    return {
        p.pid: (p.memory_info().rss, p.num_fds())
        for p in children
        if "job_process" not in " ".join(p.cmdline())
    }


def _framesets(config: BoothConfig) -> int | None:
    return booth_health(config).sync.get("framesets")


def _well(config: BoothConfig) -> bool:
    health = booth_health(config)
    return not health.problems and not health.sync.get("silent", ["unknown"])


def _named(config: BoothConfig, name: str) -> bool:
    return any(name in problem for problem in booth_health(config).problems)


def _told_anew(config: BoothConfig, name: str, old: int) -> bool:
    told = booth_health(config).processes[name]
    return bool(told) and told["pid"] != old and told["age_s"] < MAX_AGE_S


def _until(true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + _WAIT_S
    while not true() and time.monotonic() < deadline_s:
        time.sleep(0.05)


def make_booth(folder: Path, station_command: tuple[str, ...], body: Path) -> Path:
    """Record a virtual booth into a folder; returns its configuration."""
    options = ("--body", str(body), "--out", str(folder), "--frames", "12", "--passes", "600")
    subprocess.run(
        [*station_command, "record-virtual", *options, "--driver", "recorded"],
        check=True, capture_output=True,
    )  # fmt: skip
    config = folder / "booth.toml"
    config.write_text(f"{config.read_text()}\n[console]\nenabled = false\n")
    return config
