"""Scans taken from the console: a countdown for the person, then the scan itself."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import zmq

from station.console.live.control import NotRunningError, command
from station.console.live.events import EventLog
from station.core.config import BoothConfig
from station.core.scans import CANCELLED
from station.messaging.asking import RefusedError
from station.messaging.countdowns import begin_countdown, cancel_countdown, is_cancelled
from station.messaging.messages import Request

_KEPT = 100


@dataclass(slots=True)
class _Waiting:
    """A scan that has not been sent to the station yet, or that it refused."""

    label: str
    starts_s: float
    state: str = "countdown"
    reason: str = ""


class ScanCountdown:
    """One countdown at a time; a repeated scan id is the same scan."""

    def __init__(self, config: BoothConfig, events: EventLog) -> None:
        self._config, self._events = config, events
        self._folder = config.runtime.folder
        self._waiting: dict[str, _Waiting] = {}
        self._lock = threading.Lock()

    def begin(self, scan_id: str, label: str, countdown_s: int) -> dict[str, Any]:
        """Take a scan, now or after a countdown.

        Raises:
            NotRunningError, RefusedError: as the station says; another countdown is running.
            OSError: the disk has no room for what commands know of it; nothing was begun.
        """
        with self._lock:
            if scan_id in self._waiting:
                return self._document(scan_id)
            running = [w for w in self._waiting.values() if w.state == "countdown"]
            if running:
                raise RefusedError("another scan is being taken; wait for it to end")
            if countdown_s <= 0:
                return command(self._config, Request("scan", scan_id, label))
            # Checked first, so that the person does not hold still in vain.
            if not command(self._config, Request("status"))["streaming"]:
                raise RefusedError("the sensors are stopped; run station start first")
            starts_s = time.monotonic() + countdown_s
            begin_countdown(self._folder, scan_id, label, starts_s)
            self._waiting[scan_id] = _Waiting(label, starts_s)
            for old in list(self._waiting)[:-_KEPT]:
                del self._waiting[old]
            document = self._document(scan_id)
        threading.Thread(target=self._count, args=(scan_id,), daemon=True).start()
        return document

    def status(self, scan_id: str) -> dict[str, Any] | None:
        """State of a scan that has not been sent to the station; None for any other."""
        with self._lock:
            return self._document(scan_id) if scan_id in self._waiting else None

    def counting(self) -> dict[str, str]:
        """The scan whose countdown runs, if any, with its label."""
        with self._lock:
            return {one: w.label for one, w in self._waiting.items() if w.state == "countdown"}

    def cancel(self, scan_id: str) -> dict[str, Any]:
        """Cancel a scan.

        Raises:
            NotRunningError, RefusedError: as the station says.
        """
        with self._lock:
            waiting = self._waiting.get(scan_id)
            if waiting is not None and waiting.state == "countdown":
                with suppress(OSError):  # it is not taken, whatever is left on the disk
                    cancel_countdown(self._folder, scan_id)
                self._end(scan_id, waiting, CANCELLED)
            if waiting is not None:
                return self._document(scan_id)
        return command(self._config, Request("cancel", scan_id))

    def _count(self, scan_id: str) -> None:
        """Publish the remaining seconds, then send the scan to the station."""
        while (left_s := self._left_s(scan_id)) is not None and left_s > 0:
            whole = int(left_s + 0.999)
            self._tell(scan_id, "countdown", left_s=whole)
            time.sleep(max(0.02, left_s - (whole - 1)))
        with self._lock:
            waiting = self._waiting[scan_id]
            if waiting.state != "countdown":
                return
            try:
                command(self._config, Request("scan", scan_id, waiting.label))
            except (NotRunningError, RefusedError, OSError, zmq.ZMQError) as error:
                # Whatever it is: a countdown that does not end keeps all other scans waiting.
                self._end(scan_id, waiting, str(error))
                return
            del self._waiting[scan_id]

    def _left_s(self, scan_id: str) -> float | None:
        with self._lock:
            waiting = self._waiting[scan_id]
            if waiting.state != "countdown":
                return None
            if is_cancelled(self._folder, scan_id):
                return 0.0  # by a command: control refuses the order, and says so
            return waiting.starts_s - time.monotonic()

    def _end(self, scan_id: str, waiting: _Waiting, reason: str) -> None:
        waiting.state, waiting.reason = "failed", reason
        self._tell(scan_id, "failed", reason=reason)

    def _tell(self, scan_id: str, state: str, *, left_s: int = 0, reason: str = "") -> None:
        data = {"scan_id": scan_id, "state": state, "reason": reason, "left_s": left_s}
        self._events.append("scan", {**data, "framesets": 0, "wanted": 0})

    def _document(self, scan_id: str) -> dict[str, Any]:
        waiting = self._waiting[scan_id]
        return {"scan_id": scan_id, "label": waiting.label, "state": waiting.state,
                "reason": waiting.reason, "framesets": 0, "wanted": 0}  # fmt: skip
