"""Watches cameras, framesets, scans and the spool, and writes changes to the event log."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from dataclasses import dataclass, field
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from station.archive.compare import compare_surfaces
from station.archive.index import ScanIndex
from station.archive.records import PLACES, ScanRecord
from station.booth.health import can_scan
from station.console.live.control import NotRunningError, command
from station.console.live.events import EventLog
from station.console.live.folders import FolderChanges
from station.core.config import BoothConfig
from station.core.errors import BoothError
from station.core.scans import ScanId
from station.core.spool import Spool
from station.messaging.asking import RefusedError
from station.messaging.messages import CameraHealth, Request, ScanEvent
from station.messaging.transport import endpoint, subscriber

_POLL_MS = 50
_LOOK_S = 0.1
"""Period of looking at the spool where the kernel tells nothing, and for silent cameras."""
_STATUS_S = 1.0
_SILENT_S = 1.3
"""Health is sent twice a second; two missing reports mean that the capture process is gone."""
_HANGS_S = 2.0
"""A round takes milliseconds; the supervisor waits longer before it acts."""
_SETTLED_NS = 1_000_000_000
"""A folder that changed this recently is looked at again."""
_RECENT = 1000
_DELETION_S = 3.0
"""Time from the removal of a result to that of its note, on a busy disk."""


@dataclass(slots=True)
class CameraState:
    """One camera as the operator sees it."""

    name: str
    state: str = "off"
    """"off", "opening", "streaming", "lost" or "dead"."""
    detail: str = "its capture process has not reported yet"
    frames: int = 0
    lost: int = 0
    heard_s: float = field(default_factory=time.monotonic)

    def document(self) -> dict[str, Any]:
        return {"name": self.name, "state": self.state, "detail": self.detail,
                "frames": self.frames, "lost": self.lost}  # fmt: skip


class Watch:
    """Runs in one thread; its state may be read from any."""

    def __init__(self, config: BoothConfig, events: EventLog, log: logging.Logger) -> None:
        self._config, self._events, self._log = config, events, log
        self._spool = Spool(config.spool.folder)
        self._index = ScanIndex(self._spool)
        self._cameras = {camera.name: CameraState(camera.name) for camera in config.cameras}
        self._status: dict[str, Any] = {}
        self._fault = ""
        self._problem = ""
        self._round_s = time.monotonic()
        self._rate_hz: float | None = None
        self._seen: dict[str, str] | None = None
        self._since = ""
        """Time of the oldest scan that was looked at, where there are older ones."""
        self._missing: dict[str, float] = {}
        """Scans that left the folders, since when (monotonic seconds)."""
        self._spool_ns: tuple[int, ...] = ()
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=run, name=name, daemon=True)
            for name, run in (("watch", self._run), ("status", self._ask))
        ]

    def start(self) -> None:
        self._index.hold()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(5.0)
        self._index.release()

    def hangs(self) -> bool:
        """Whether the watching thread has stopped making progress."""
        return time.monotonic() - self._round_s > _HANGS_S

    def health(self) -> dict[str, Any]:
        """Health report of the console for `station status`."""
        return {"problems": [f"console: {self._problem}"] if self._problem else []}

    def booth(self) -> dict[str, Any]:
        """The booth's state as far as it is known now."""
        # What was said before the station fell silent may have passed.
        status = {} if self._fault else self._status
        spool = self._status.get("spool", {})
        cancelled = int(self._status.get("cancelled", 0))
        usage = shutil.disk_usage(self._config.spool.folder)
        return {
            "running": not self._fault,
            "fault": self._fault,
            "problems": list(status.get("problems", [])),
            "remarks": list(status.get("remarks", [])),
            "can_scan": bool(status) and can_scan(self._config, status),
            "compiling": bool(status.get("processes", {}).get("workers", {}).get("compiling")),
            "streaming": bool(self._status.get("streaming", False)),
            "cameras": [camera.document() for camera in self._cameras.values()],
            "framesets_hz": self._rate_hz,
            "spool": {place: int(spool.get(place, 0)) for place in (*PLACES, "done")},
            "failed": max(0, int(spool.get("failed", 0)) - cancelled),
            "cancelled": cancelled,
            "disk_free_mb": usage.free / 1e6,
            "disk_needed_mb": self._config.spool.min_free_mb,
        }

    def _run(self) -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        sources = ["events", *(f"camera-{name}" for name in self._cameras)]
        incoming = subscriber(context, self._config.runtime.folder, sources, ["scan", "health"])
        ends = incoming.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        poller = zmq.Poller()
        poller.register(incoming, zmq.POLLIN)
        poller.register(ends, zmq.POLLIN)
        changes = FolderChanges(self._config.spool.folder / place for place in PLACES)
        if changes.fileno() >= 0:
            poller.register(changes.fileno(), zmq.POLLIN)
        looked_s = 0.0
        while not self._stop.is_set():
            self._round_s = time.monotonic()
            try:
                ready = dict(poller.poll(_POLL_MS))
                if incoming in ready:
                    self._receive(*incoming.recv_multipart())
                if ends in ready:
                    # Its last reports are older than its end.
                    while incoming.poll(0):
                        self._receive(*incoming.recv_multipart())
                    self._hear_end(recv_monitor_message(ends)["endpoint"].decode())
                now_s = time.monotonic()
                moved = changes.fileno() in ready and changes.any()
                if moved or now_s - looked_s > _LOOK_S:
                    looked_s = now_s
                    self._watch_spool(moved)
                    self._watch_missing()
                    self._watch_silence(now_s)
                    self._problem = ""
            except (BoothError, OSError, zmq.ZMQError) as error:
                self._log.warning("watching the booth: %s", error)
                self._problem = f"the booth cannot be watched ({error}); retrying"
                self._stop.wait(1.0)
        changes.close()
        incoming.disable_monitor()
        context.destroy(linger=0)

    def _hear_end(self, address: str) -> None:
        """A process closed its socket, or the kernel did when it died: known before its silence."""
        for camera in self._cameras.values():
            if address == endpoint(self._config.runtime.folder, f"camera-{camera.name}"):
                self._set_dead(camera)

    def _receive(self, topic: bytes, packed: bytes) -> None:
        if topic == b"scan":
            event = ScanEvent.unpack(packed)
            self._events.append(
                "scan",
                {"scan_id": event.scan_id, "state": event.state, "framesets": event.framesets,
                 "wanted": event.wanted, "reason": event.reason},
            )  # fmt: skip
            return
        health = CameraHealth.unpack(packed)
        camera = self._cameras.get(health.camera)
        if camera is None:
            return
        changed = (camera.state, camera.detail) != (health.state, health.detail)
        camera.state, camera.detail = health.state, health.detail
        camera.frames, camera.lost = health.frames, health.lost
        camera.heard_s = time.monotonic()
        if changed:
            self._events.append("camera", camera.document())

    def _watch_silence(self, now_s: float) -> None:
        for camera in self._cameras.values():
            if now_s - camera.heard_s > _SILENT_S:
                self._set_dead(camera)

    def _set_dead(self, camera: CameraState) -> None:
        if camera.state == "dead":
            return  # told already: it hung, and was killed for it
        camera.state = "dead"
        remedy = (
            "if this persists, check the recording"
            if camera.name in self._config.recorded
            else "if this persists, unplug the camera's USB cable for five seconds"
        )
        camera.detail = (
            f"its capture process is not responding and is restarted automatically; {remedy}"
        )
        self._events.append("camera", camera.document())

    def _watch_spool(self, moved: bool) -> None:
        folder = self._config.spool.folder
        changed = tuple(
            (folder / place).stat().st_mtime_ns for place in PLACES if (folder / place).is_dir()
        )
        settled = changed == self._spool_ns and not moved
        now_ns = time.time_ns()
        # Also where the clock was put back since, as in the index.
        if settled and all(abs(now_ns - moment_ns) > _SETTLED_NS for moment_ns in changed):
            return
        self._spool_ns = changed
        # No distances of a body are kept that may have been deleted.
        compare_surfaces.cache_clear()
        scans = self._index.find(limit=_RECENT)
        found = {scan.scan_id: scan for scan in scans}
        states = {scan_id: scan.state for scan_id, scan in found.items()}
        before, self._seen = self._seen, dict(states)
        for scan_id in (before or {}).keys() - states.keys():
            self._missing.setdefault(scan_id, time.monotonic())
        # Where newer ones were deleted, older ones come into what is looked at.
        since, self._since = self._since, scans[-1].created if len(scans) == _RECENT else ""
        for scan_id, state in states.items():
            if (
                before is not None
                and before.get(scan_id) != state
                and found[scan_id].created >= since
            ):
                self._tell(found[scan_id])

    def _watch_missing(self) -> None:
        """Tell what became of scans that left the folders."""
        for scan_id, since_s in list(self._missing.items()):
            if self._index.get(scan_id) is not None:
                del self._missing[scan_id]
            elif not self._spool.notes.path(ScanId(scan_id)).exists():
                del self._missing[scan_id]
                self._events.append("scan", {"scan_id": scan_id, "state": "deleted"})
            elif time.monotonic() - since_s > _DELETION_S:
                del self._missing[scan_id]
                self._events.append("scan", {"scan_id": scan_id, "state": "taken"})

    def _tell(self, scan: ScanRecord) -> None:
        done = scan.state in ("delivered", "rescan", "failed")
        document = {"scan_id": scan.scan_id, "state": scan.state, "label": scan.label,
                    "verdict": scan.verdict, "reasons": list(scan.reasons)}  # fmt: skip
        self._events.append("result" if done else "job", document)

    def _ask(self) -> None:
        while not self._stop.wait(_STATUS_S):
            try:
                self._take_status(command(self._config, Request("status")))
                self._set_fault("")
            except (NotRunningError, RefusedError) as error:
                self._set_fault(str(error))

    def _take_status(self, status: dict[str, Any]) -> None:
        rate_hz = status.get("sync", {}).get("framesets_hz")
        before = self._rate_hz, self._status.get("streaming")
        self._status = status
        self._rate_hz = None if rate_hz is None else round(rate_hz, 1)
        if self._rate_hz is not None and (self._rate_hz, status.get("streaming")) != before:
            told = {"rate_hz": self._rate_hz, "streaming": status["streaming"]}
            self._events.append("framesets", told)

    def _set_fault(self, fault: str) -> None:
        if fault != self._fault:
            self._fault = fault
            self._events.append("fault", {"fault": fault})
