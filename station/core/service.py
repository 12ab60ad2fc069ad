"""The life of every process: signals, logs, readiness, death with its parent."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import signal
import socket
import sys
import threading

_PR_SET_PDEATHSIG = 1


def stop_event() -> threading.Event:
    """Set by SIGTERM and SIGINT; a process' main loop watches it."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop


def set_up_logs(process: str) -> logging.Logger:
    """Log lines on stderr; systemd adds its own times."""
    times = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.INFO,
        format=f"{times}{process}: %(levelname)s %(message)s",
        datefmt="%H:%M:%S",
    )
    return logging.getLogger(process)


def notify(state: str) -> None:
    """Tell systemd (sd_notify): "READY=1", "WATCHDOG=1"; nothing where nobody listens."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.connect("\0" + address[1:] if address.startswith("@") else address)
        sock.send(state.encode())


def die_with_parent() -> None:
    """Ask the kernel to end this process when its parent ends (Linux)."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() == 1:
        sys.exit(1)
