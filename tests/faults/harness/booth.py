"""A booth under test: real processes, sensors that play a recording, faults by order.

Its operator uses the `station` command; its fitting room takes each result away as soon as it is
there, so that a second delivery of the same scan would show.
"""

from __future__ import annotations

import contextlib
import io
import secrets
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from injection import Injection, build, environment
from running_station import STATION, Station
from table import Row

INSIDE = Path(__file__).parent / "inside"
sys.path.append(str(INSIDE))  # the driver that the configurations name

from station.booth.health import MAX_AGE_S, booth_health  # noqa: E402
from station.cli import station as station_command  # noqa: E402
from station.core.config_file import load_config  # noqa: E402
from station.core.errors import BoothError  # noqa: E402

WAIT_S = 90.0
_BODY = Path(__file__).parents[3] / "station/simulation/bodies/ann.npz"
_CAMERAS = ("front-lower", "front-upper", "back-lower", "back-upper")
_ROLES = ("sync", "control", "work")
"""Words on the command lines of the processes that write."""
_PURGE = "purge"
"""That of the process that deletes what is past its time."""
_SETTINGS = """
[spool]
min_free_mb = 50
[console]
enabled = false
"""
_WHOLE = """
[spool]
min_free_mb = 50
[console]
port = {port}
[[deliver]]
name = "shop"
folder = "{handed}"
"""
_HANDED = "handed"
"""Folder to which a whole booth hands its results over."""


class Booth:
    """A running booth in a folder."""

    def __init__(
        self, folder: Path, *, job: str = "", settings: str = _SETTINGS, tmp: Path | None = None
    ) -> None:
        self.folder = folder
        self.path = _record(folder, settings)
        self.config = load_config(self.path)
        self.cameras = _CAMERAS
        self.disk = {role: Injection(folder / "faults", role) for role in _ROLES}
        self.clocks = [*self.disk.values(), Injection(folder / "faults", _PURGE)]
        self.order_job(job)
        self.station = Station(
            self.path,
            {
                "PYTHONPATH": str(INSIDE),
                "BOOTH_JOB_ORDER": str(folder / "job"),
                **({} if tmp is None else {"TMPDIR": str(tmp)}),
                **environment(build(folder), folder / "faults", (*_ROLES, _PURGE)),
            },
        )
        self.command("start")
        self.wait(self.well, "frames come")

    @property
    def spool(self) -> Path:
        return self.config.spool.folder

    def command(self, *words: str) -> tuple[int, str]:
        """Exit code and error of a `station` command; run in this process, to be quick."""
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            try:
                station_command.main([*words, "--config", str(self.path)], standalone_mode=False)
            except BoothError as error:
                return 1, str(error)
            except SystemExit as error:
                return int(error.code or 0), ""
        return 0, ""

    def order_job(self, order: str) -> None:
        """Change what the jobs do from now on; see `inside/errant_job.py`."""
        (self.folder / "job").write_text(order)

    def order_sensor(self, camera: str, fault: str) -> None:
        """Change what a sensor does from now on; see `inside/played_sensor.py`."""
        beside = self.folder / f"{camera}.new"
        beside.write_text(fault)
        beside.replace(_fault_file(self.folder, camera))

    def report(self, process: str) -> dict[str, Any]:
        """A process' last report on itself."""
        return booth_health(self.config).processes[process]

    def problems(self) -> list[str]:
        return booth_health(self.config).problems

    def framesets(self) -> int:
        return int(self.report("sync").get("framesets", 0))

    def processes(self) -> list[str]:
        return list(booth_health(self.config).processes)

    def pids(self, process: str) -> list[int]:
        """Process ids by the name in `station status`; "job" are the workers' jobs."""
        if process == "job":
            return self.station.pids("workers.reconstruct.job_process")
        if process == "workers":
            return self.station.pids("workers.cli")
        return self.station.pids(*process.split())

    def well(self) -> bool:
        """Whether nothing is wrong, and every camera sends."""
        health = booth_health(self.config)
        return not health.problems and health.sync.get("silent", ["unknown"]) == []

    def wait(self, true: Callable[[], bool], what: str, limit_s: float = WAIT_S) -> float:
        """Seconds until something is true.

        Raises:
            AssertionError: it does not become true; with the station's log.
        """
        began_s = time.monotonic()
        self.station.wait_until(true, what, limit_s)
        return time.monotonic() - began_s

    def replaced(self, process: str, pid: int) -> bool:
        """Whether another process than that one reports under its name."""
        told = self.report(process)
        return bool(told) and told["pid"] != pid and told["age_s"] < MAX_AGE_S

    def close(self) -> None:
        self.station.close()


def _fault_file(folder: Path, camera: str) -> Path:
    return folder / f"{camera}.fault"


def _record(folder: Path, settings: str) -> Path:
    """Record a virtual person into a folder; returns the configuration of the booth."""
    options = ("--body", str(_BODY), "--out", str(folder), "--frames", "12", "--passes", "1")
    subprocess.run([*STATION, "record-virtual", *options], check=True, capture_output=True)
    (folder / "faults").mkdir()
    sections = ""
    for number, camera in enumerate(_CAMERAS, 1):
        _fault_file(folder, camera).touch()
        sections += (
            f'[[cameras]]\nname = "{camera}"\ndriver = "played"\nrecording = "{camera}"\n'
            f'serial = "V{number:08d}"\nfault = "{camera}.fault"\n'
        )
    config = folder / "booth.toml"
    config.write_text(sections + settings)
    return config


class Scans:
    """Scans that were ordered, what was said of them, and what came of them."""

    def __init__(self, booth: Booth) -> None:
        self._booth = booth
        self.told: dict[str, tuple[int, str]] = {}
        self._room = booth.folder / "room"
        self._room.mkdir(exist_ok=True)
        self._open = threading.Event()
        self._taking_away = threading.Thread(target=self._take_away, daemon=True)
        self._taking_away.start()

    def take(self, *words: str) -> str:
        """Order one and wait for the word on it; returns its id."""
        scan_id = f"h-{secrets.token_hex(6)}"
        self.told[scan_id] = self._booth.command("scan", "--no-wait", "--scan-id", scan_id, *words)
        return scan_id

    def take_until_accepted(self, limit_s: float = WAIT_S) -> str:
        """Order scans until one is accepted, or the time is up; returns the last one's id."""
        began_s = time.monotonic()
        while not self.accepted(scan_id := self.take()) and time.monotonic() - began_s < limit_s:
            time.sleep(0.1)
        return scan_id

    def accepted(self, scan_id: str) -> bool:
        return self.told[scan_id][0] == 0

    def delivered(self) -> Counter[str]:
        """Count the deliveries of each scan."""
        return Counter(path.name.split(".")[0] for path in self._room.iterdir())

    def came(self, scan_id: str) -> bool:
        return self.delivered()[scan_id] > 0

    def settle(self, left: int = 0) -> None:
        """Wait until so few wait or are worked on; as long as something happens."""
        known, since_s = -1, time.monotonic()
        while time.monotonic() - since_s < WAIT_S:
            waiting = sum(
                len(list((self._booth.spool / state).iterdir()))
                for state in ("queue", "work", "outbox")
            )
            if waiting <= left:
                return
            if waiting != known:
                known, since_s = waiting, time.monotonic()
            time.sleep(0.05)

    def close(self) -> None:
        """The fitting room closes."""
        self._open.set()
        self._taking_away.join()

    def row(self, fault: str) -> Row:
        """Statements of the station, compared with what came."""
        came = self.delivered()
        sure = {scan: code for scan, (code, words) in self.told.items() if not _unsure(words)}
        lost = [scan for scan, code in sure.items() if code == 0 and not came[scan]]
        ghosts = [scan for scan, code in sure.items() if code != 0 and came[scan]]
        doubled = [scan for scan, count in came.items() if count > 1]
        for scan in (*lost, *ghosts, *doubled):
            print(f"        {scan}: {self.told[scan]}, came {came[scan]} times", flush=True)
        good = sum(code == 0 for code in sure.values())
        return Row(
            fault,
            "accepted: delivered once; failed: never",
            f"{len(self.told)} scans, {good} accepted, {len(lost)} lost, {len(ghosts)} ghosts, "
            f"{len(doubled)} doubled, {len(self.told) - len(sure)} unsure",
            good > 0 and not (lost or ghosts or doubled),
        )

    def _take_away(self) -> None:
        """Move results away, as soon as they are there and handed over."""
        handed = self._booth.folder / _HANDED
        while not self._open.wait(0.1):
            for result in list((self._booth.spool / "outbox").iterdir()):
                if not handed.is_dir() or (handed / result.name).is_dir():
                    shutil.move(result, self._room / f"{result.name}.{time.monotonic_ns()}")


def _unsure(words: str) -> bool:
    return "not known yet" in words


@contextlib.contextmanager
def running_booth(folder: Path, **options: Any) -> Iterator[tuple[Booth, Scans]]:
    """A booth and its scans; both end with the block."""
    booth = Booth(folder, **options)
    scans = Scans(booth)
    try:
        yield booth, scans
    finally:
        scans.close()
        booth.close()


@contextlib.contextmanager
def whole_booth(folder: Path, **options: Any) -> Iterator[tuple[Booth, Scans]]:
    """A booth with every process that a station can have: also console and hand-over."""
    (folder / _HANDED).mkdir()
    settings = _WHOLE.format(port=_free_port(), handed=_HANDED)
    with running_booth(folder, settings=settings, **options) as whole:
        yield whole


def until(true: Callable[[], bool], limit_s: float = WAIT_S, pause_s: float = 0.02) -> float:
    """Seconds until something is true, or infinity."""
    began_s = time.monotonic()
    while not true():
        if time.monotonic() - began_s > limit_s:
            return float("inf")
        time.sleep(pause_s)
    return time.monotonic() - began_s


def _free_port() -> int:
    """A TCP port of this machine that nobody listens at."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
