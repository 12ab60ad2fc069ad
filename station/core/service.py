"""Life cycle of every process: signals, logs, caches, readiness, progress, end with its parent.

A process reports to its supervisor (systemd, or `station run`, by the same protocol) when it is
ready, and from then on that it makes progress: `Heartbeat.beat` is called where work is done, not
by a timer, so that a process that hangs is replaced. It also writes a report on itself to
`health/<process>.json` in the runtime folder; `station status` and the metrics are made from there,
whether the process still answers or not.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import signal
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import platformdirs

from station.core.errors import BoothError
from station.core.files import entries_of, held, is_held, private_folder, read_bounded_json

CACHE_VARIABLE = "BOOTH_CACHE"
"""Names the folder of all caches; the user's cache folder if unset."""
_LOCK = ".lock"
STATION_LOCK = f"station{_LOCK}"
"""Held by `station run` in the runtime folder."""
NOTHING_RUNS = (
    "the booth is not running here; start it with: station run, or an installed booth "
    "with: sudo systemctl start booth.target"
)
HEALTH = "health"
_CODE = Path(__file__).parent
_NUMBA_VARIABLE = "NUMBA_CACHE_DIR"
# Looked up now: a process that was just forked from one with threads must not wait for the loader.
_LIBC = ctypes.CDLL(None, use_errno=True)
_PRCTL = _LIBC.prctl
_PR_SET_PDEATHSIG = 1
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8
_MMAP_BYTES = 1 << 17
"""A depth frame is larger; what is smaller comes and goes without the kernel."""
_BEAT_PERIOD_S = 0.5
_HEALTH_PERIOD_S = 0.25
_MAX_HEALTH_BYTES = 1 << 20

_HANDLER = "booth"
_JOURNAL = "/run/systemd/journal/socket"
_PRIORITIES = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Python's levels as syslog's; what is below them is 7, for debugging."""


def stop_event() -> threading.Event:
    """Set by SIGTERM, SIGINT and a closed terminal; a process' main loop watches it."""
    stop = threading.Event()
    numbers = [signal.SIGTERM, signal.SIGINT]
    # nohup ignores the signal of a closed terminal.
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, lambda *_: stop.set())
    return stop


def set_up_logs(process: str) -> logging.Logger:
    """Log lines in systemd's journal where it listens, else on stderr.

    A line that is logged with `extra={"scan": scan_id}` has the field SCAN there: `journalctl
    SCAN=...` is one scan.
    """
    if is_read_by_journal():
        handler: logging.Handler = JournalHandler(process)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        words = f"%(asctime)s {process}: %(levelname)s %(message)s"
        handler.setFormatter(logging.Formatter(words, datefmt="%H:%M:%S"))
    handler.name = _HANDLER
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    return logging.getLogger(process)


def has_log() -> bool:
    """Whether this process has a log of its own, made by `set_up_logs`."""
    return any(handler.name == _HANDLER for handler in logging.getLogger().handlers)


@contextlib.contextmanager
def only_process(runtime_folder: Path, process: str) -> Iterator[logging.Logger]:
    """Start of a process that runs once per runtime folder; yields its log.

    Raises:
        BoothError: it is already running.
    """
    lock = runtime_folder / f"{file_name(process)}{_LOCK}"
    busy = BoothError(f"a {process} process is already running here ({lock}); end it first")
    log = set_up_logs(process)
    with held(lock, busy):
        return_freed_memory()
        yield log


def return_freed_memory() -> None:
    """Let large blocks, as frames are, go back to the kernel as soon as they are freed.

    glibc would keep them in heaps of each thread from the first one that is freed on: the memory
    of a process that runs for months would be the most that its threads ever had between them.
    """
    with contextlib.suppress(AttributeError):  # another C library
        _LIBC.mallopt(_M_MMAP_THRESHOLD, _MMAP_BYTES)
        _LIBC.mallopt(_M_ARENA_MAX, 1)


def is_read_by_journal(descriptor: int = 2) -> bool:
    """Whether systemd reads what is written to a file descriptor, stderr."""
    found = os.fstat(descriptor)
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


class JournalHandler(logging.Handler):
    """Sends lines to the journal by its own protocol; what it does not take goes to stderr."""

    def __init__(self, process: str, address: str = _JOURNAL) -> None:
        super().__init__()
        self._process, self._address = process, address
        self._stderr = logging.StreamHandler()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def emit(self, record: logging.LogRecord) -> None:
        """Send one line."""
        fields = {
            "MESSAGE": self.format(record),
            "PRIORITY": next((p for level, p in _PRIORITIES if record.levelno >= level), 7),
            "SYSLOG_IDENTIFIER": self._process.replace(" ", "-"),
        }
        scan = getattr(record, "scan", None)
        if scan is not None:
            fields["SCAN"] = scan
        try:
            data = b"".join(_field(name, str(value)) for name, value in fields.items())
            self._socket.sendto(data, self._address)
        except OSError:
            self._stderr.handle(record)


def _field(name: str, value: str) -> bytes:
    """A field in binary form, whose value may hold several lines."""
    data = value.encode(errors="replace")
    return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"


def set_up_caches() -> None:
    """Choose a writable cache folder for compiled code; call this before numba is imported.

    In $BOOTH_CACHE if that is set, else beside the code (numba's own way), else in the user's cache
    folder, else in a private one for temporary files.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    if not chosen and os.access(_CODE, os.W_OK):
        return
    folder = Path(chosen) if chosen else platformdirs.user_cache_path("body-booth")
    if not _takes_files(folder):
        folder = Path(tempfile.gettempdir()) / f"body-booth-cache-{os.getuid()}"
        os.environ[CACHE_VARIABLE] = str(private_folder(folder))
    os.environ.setdefault(_NUMBA_VARIABLE, str(folder / "numba"))


def _takes_files(folder: Path) -> bool:
    try:
        private_folder(folder)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def notify(state: str) -> None:
    """Tell the supervisor (sd_notify): "READY=1", "WATCHDOG=1"; does nothing without a
    supervisor."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    kind = socket.SOCK_DGRAM | socket.SOCK_NONBLOCK
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, kind) as sock:
        sock.connect("\0" + address[1:] if address.startswith("@") else address)
        sock.send(state.encode())


class Heartbeat:
    """Progress messages and health report of a process.

    The health file is written by a thread of its own: a stalled disk must not stop a main loop.
    """

    def __init__(self, runtime_folder: Path, process: str) -> None:
        self._path = private_folder(runtime_folder / HEALTH) / f"{file_name(process)}.json"
        self._process, self._started_s = process, time.monotonic()
        self._content: dict[str, Any] = {}
        self._beat_s = self._told_s = 0.0
        self._new = threading.Event()
        threading.Thread(target=self._write, name="health", daemon=True).start()

    @property
    def due(self) -> bool:
        """Whether it is time for a new health report."""
        return time.monotonic() - self._told_s >= _HEALTH_PERIOD_S

    def ready(self) -> None:
        """Report that the process is ready."""
        notify("READY=1")
        self.beat()

    def beat(self) -> None:
        """Report progress, also when there was nothing to do. Cheap: call it in every loop."""
        now_s = time.monotonic()
        if now_s - self._beat_s >= _BEAT_PERIOD_S:
            self._beat_s = now_s
            notify("WATCHDOG=1")

    def allow(self, seconds: float | None) -> None:
        """Extend the time limit for progress; None restores the usual one."""
        usual_us = int(os.environ.get("WATCHDOG_USEC", "0") or 0)
        limit_us = usual_us if seconds is None else int(1e6 * seconds)
        if usual_us:
            notify(f"WATCHDOG_USEC={limit_us}\nWATCHDOG=1")

    def report(self, content: Mapping[str, Any]) -> None:
        """Replace the health report; see `due`."""
        self._told_s = time.monotonic()
        self._content = {
            "process": self._process,
            "pid": os.getpid(),
            "started_s": self._started_s,
            "told_s": self._told_s,
            **content,
        }
        self._new.set()

    def _write(self) -> None:
        temporary = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        while self._new.wait():
            self._new.clear()
            with contextlib.suppress(OSError):
                temporary.write_text(json.dumps(self._content))
                temporary.replace(self._path)


def anything_runs(runtime_folder: Path) -> bool:
    """Whether a process of the booth runs, or the supervisor that starts them.

    Raises:
        OSError: the folder cannot be read.
    """
    return any(path.suffix == _LOCK and is_held(path) for path in entries_of(runtime_folder))


def file_name(process: str) -> str:
    """A process' name ("capture front-lower") as a file's."""
    return process.replace(" ", "-")


def read_health(runtime_folder: Path, process: str) -> dict[str, Any]:
    """Last report of a process, with `age_s`, the seconds since; empty if there is none."""
    path = runtime_folder / HEALTH / f"{file_name(process)}.json"
    try:
        content = read_bounded_json(path, _MAX_HEALTH_BYTES)
        # Monotonic times of an earlier boot mean nothing.
        age_s = time.monotonic() - float(content["told_s"])
        started_s = float(content.get("started_s", 0.0))
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {**content, "started_s": started_s, "age_s": age_s} if age_s >= 0.0 else {}


def answered(status: str) -> bool:
    """Whether control answered, from what `station status --json` printed."""
    try:
        return json.loads(status)["streaming"] is not None
    except (ValueError, KeyError, TypeError):
        return False


def die_with_parent(parent: int) -> None:
    """Ask the kernel to end this process when its parent (a process id) ends (Linux).

    It ends with the thread that started it: start it from one that lives as long.
    """
    _PRCTL(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        # It ended before the kernel was asked.
        os._exit(1)
