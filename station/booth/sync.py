"""The sync-and-merge process: framesets by hardware time, the live cloud, and scan bundles."""

from __future__ import annotations

import logging
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
import numpy as np
import zmq
from numpy.typing import NDArray

from station.booth.frameset import Frameset, FramesetMatcher
from station.booth.live import merged_points
from station.booth.session import CANCELLED
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.store import CalibrationStore
from station.core.bundle import CapturedFrame, write_bundle
from station.core.config import BoothConfig, find_config, load_config
from station.core.errors import BoothError, CalibrationError
from station.core.rig import Rig
from station.core.service import notify, set_up_logs, stop_event
from station.core.spool import Spool
from station.messaging.messages import CameraHealth, FrameHeader, Reply, Request, ScanEvent
from station.messaging.transport import publisher, server, subscriber

_POLL_MS = 20
_LATENCIES_KEPT = 2000


@dataclass(frozen=True, slots=True)
class LiveFrame:
    """A frame as it came: the pixels are the message's own memory."""

    header: FrameHeader
    depth: NDArray[np.uint16]


@dataclass(slots=True)
class Collection:
    """A scan being collected."""

    scan_id: str
    label: str
    deadline_s: float
    sets: list[Frameset[LiveFrame]] = field(default_factory=list)
    complete_s: float = 0.0
    """Time at which its last frameset came."""


class SyncProcess:
    """Matches frames, publishes what is seen, writes bundles when told to."""

    def __init__(self, config: BoothConfig, log: logging.Logger) -> None:
        self._config, self._log = config, log
        self._names = [camera.name for camera in config.cameras]
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        folder = config.runtime.folder
        self._frames_in = subscriber(
            self._context, folder, [f"camera-{name}" for name in self._names], ["depth", "health"]
        )
        self._commands = server(self._context, folder, "sync")
        self._events = publisher(self._context, folder, "events", "scan")
        self._events_lock = threading.Lock()
        self._matcher: FramesetMatcher[LiveFrame] = FramesetMatcher(
            self._names, config.sync.tolerance_s
        )
        self._last_frame_s: dict[str, float] = {}
        self._health: dict[str, CameraHealth] = {}
        self._collection: Collection | None = None
        self._writer = ThreadPoolExecutor(max_workers=1)
        self._writing: dict[str, Future[None]] = {}
        self._ended: dict[str, ScanEvent] = {}
        self._set_count = 0
        self._latencies_s: list[float] = []
        self._live_s = 0.0
        self._rig: Rig | None = None
        self._drift = DriftWatch(CalibrationStore(config.calibrate.folder, config.calibration), log)

    def run(self, stop: threading.Event) -> None:
        """Until told to stop."""
        poller = zmq.Poller()
        poller.register(self._frames_in, zmq.POLLIN)
        poller.register(self._commands, zmq.POLLIN)
        notify("READY=1")
        while not stop.is_set():
            ready = dict(poller.poll(_POLL_MS))
            if self._frames_in in ready:
                self._take_frames()
            if self._commands in ready:
                self._answer()
            self._watch_collection()
        self._writer.shutdown(wait=True)
        self._context.destroy(linger=0)

    def _take_frames(self) -> None:
        while self._frames_in.poll(0):
            topic, packed, *body = self._frames_in.recv_multipart(copy=False)
            if bytes(topic.buffer).startswith(b"health/"):
                health = CameraHealth.unpack(packed.buffer)
                self._health[health.camera] = health
                continue
            header = FrameHeader.unpack(packed.buffer)
            depth = np.frombuffer(body[0].buffer, np.uint16).reshape(header.height, header.width)
            self._last_frame_s[header.camera] = time.monotonic()
            frame = LiveFrame(header, depth)
            for found in self._matcher.push(header.camera, header.host_time_s, frame):
                self._use(found)

    def _use(self, found: Frameset[LiveFrame]) -> None:
        self._set_count += 1
        now_s = time.monotonic()
        newest_s = max(frame.header.received_s for frame in found.frames.values())
        self._latencies_s.append(now_s - newest_s)
        del self._latencies_s[:-_LATENCIES_KEPT]
        if self._collection is not None:
            self._collection.sets.append(found)
            self._tell(self._collection, "capturing")
            if len(self._collection.sets) >= self._config.scan.framesets:
                self._collection.complete_s = now_s
                self._write(self._collection)
                self._collection = None
        if now_s - self._live_s > 1.0 / self._config.sync.live_hz:
            self._live_s = now_s
            self._publish_cloud(found)

    def _publish_cloud(self, found: Frameset[LiveFrame]) -> None:
        if self._rig is None:
            try:
                self._rig = Rig.load(self._config.calibration)
            except BoothError:
                return
        known = {n: f.depth for n, f in found.frames.items() if n in self._rig.cameras}
        scale_m = next(iter(found.frames.values())).header.depth_scale_m
        points = merged_points(self._rig, known, scale_m)
        self._publish(b"cloud", points.tobytes())

    def _watch_collection(self) -> None:
        collection = self._collection
        if collection is None or time.monotonic() < collection.deadline_s:
            return
        self._collection = None
        silent = self._silent()
        wanted = self._config.scan.framesets
        reason = (
            f"camera {', '.join(silent)} went silent; check its cable and scan again"
            if silent
            else f"only {len(collection.sets)} of {wanted} framesets came in "
            f"{self._config.scan.max_duration_s:g} s; check station status and scan again"
        )
        self._end(collection, "failed", reason)

    def _silent(self) -> list[str]:
        now_s = time.monotonic()
        limit_s = self._config.sync.silent_after_s
        return [n for n in self._names if now_s - self._last_frame_s.get(n, -1e9) > limit_s]

    def _answer(self) -> None:
        *route, packed = self._commands.recv_multipart()
        try:
            request = Request.unpack(packed)
            reply = self._reply(request)
        except BoothError as error:
            reply = Reply(ok=False, error=str(error))
        self._commands.send_multipart([*route, reply.pack()])

    def _reply(self, request: Request) -> Reply:
        if request.command == "scan":
            self._start_collection(request.scan_id, request.label)
            return Reply(ok=True)
        if request.command == "cancel":
            return self._cancel(request.scan_id)
        if request.command == "status":
            return Reply(ok=True, content=self._status())
        return Reply(ok=False, error=f"sync knows no command {request.command!r}")

    def _start_collection(self, scan_id: str, label: str) -> None:
        """Begin a scan, or go on with it if it is known already.

        Raises:
            BoothError: it cannot be taken now; nothing was begun.
        """
        current = self._collection
        if scan_id in self._ended or scan_id in self._writing:
            return
        if current is not None:
            if current.scan_id == scan_id:
                return
            raise BoothError("another scan is being taken; wait for it to end")
        silent = self._silent()
        if silent:
            raise BoothError(
                f"camera {', '.join(silent)} gives no frames{self._why(silent[0])}; "
                "run station start, or check the cable"
            )
        spool = Spool(self._config.spool.folder)
        spool.check_space(self._config.spool.min_free_mb)
        self._rig = Rig.load(self._config.calibration)
        for name in self._names:
            self._rig.camera(name, str(self._config.calibration))
        self._matcher.clear()
        deadline_s = time.monotonic() + self._config.scan.max_duration_s
        self._collection = Collection(scan_id, label, deadline_s)
        self._tell(self._collection, "capturing")

    def _cancel(self, scan_id: str) -> Reply:
        """Collect a scan no further; what was collected is dropped."""
        collection = self._collection
        if collection is None or collection.scan_id != scan_id:
            return Reply(ok=False, error=f"scan {scan_id} is not being taken")
        self._collection = None
        self._end(collection, "failed", CANCELLED)
        return Reply(ok=True)

    def _why(self, camera: str) -> str:
        health = self._health.get(camera)
        return f" ({health.detail or health.state})" if health else ""

    def _write(self, collection: Collection) -> None:
        rig = self._rig
        assert rig is not None
        writing = self._writer.submit(self._write_bundle, collection, rig)
        self._writing[collection.scan_id] = writing
        writing.add_done_callback(lambda done: self._written(collection, done))

    def _write_bundle(self, collection: Collection, rig: Rig) -> None:
        if self._config.drift.refuse_scans:
            self._refuse_moved_cameras(collection, rig)
        spool = Spool(self._config.spool.folder)
        temporary = spool.temporary(collection.scan_id)
        frames = {
            name: [
                CapturedFrame(
                    frame.depth,
                    frame.header.device_ticks,
                    frame.header.tick_hz,
                    frame.header.host_time_s,
                    frame.header.sequence,
                )
                for frame in (found.frames[name] for found in collection.sets)
            ]
            for name in self._names
        }
        first = next(iter(collection.sets[0].frames.values()))
        write_bundle(
            temporary,
            scan_id=collection.scan_id,
            created=datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
            label=collection.label,
            depth_scale_m=first.header.depth_scale_m,
            rig=rig,
            frames=frames,
            spread_s_max=max(found.spread_s for found in collection.sets),
        )
        spool.submit(temporary, collection.scan_id)

    def _refuse_moved_cameras(self, collection: Collection, rig: Rig) -> None:
        """A scan through a wrong calibration is worth nothing: say so while the person is there.

        Raises:
            CalibrationError: naming the cameras that moved.
        """
        moved = [
            move.words()
            for name in self._names
            for move in self._drift.moves(
                rig.cameras[name],
                [found.frames[name].depth for found in collection.sets],
                collection.sets[0].frames[name].header.depth_scale_m,
            )
            if move.moved or move.lost
        ]
        if moved:
            raise CalibrationError(
                f"{'; '.join(moved)}; look at it, then run station check, or station calibrate"
            )

    def _written(self, collection: Collection, done: Future[None]) -> None:
        error = done.exception()
        if error is None:
            self._log.info(
                "scan %s written %.2f s after its last frameset",
                collection.scan_id,
                time.monotonic() - collection.complete_s,
            )
            self._end(collection, "accepted", "")
        elif isinstance(error, BoothError):
            self._end(collection, "failed", str(error))
        else:
            self._end(collection, "failed", f"the scan could not be written ({error}); scan again")

    def _end(self, collection: Collection, state: str, reason: str) -> None:
        event = self._tell(collection, state, reason)
        self._ended[collection.scan_id] = event
        for old in list(self._ended)[:-100]:
            del self._ended[old]
        self._writing.pop(collection.scan_id, None)
        self._log.info("scan %s %s %s", collection.scan_id, state, reason)

    def _tell(self, collection: Collection, state: str, reason: str = "") -> ScanEvent:
        event = ScanEvent(
            collection.scan_id, state, len(collection.sets), self._config.scan.framesets, reason
        )
        self._publish(b"scan", event.pack())
        return event

    def _publish(self, topic: bytes, content: bytes) -> None:
        """The writer's thread publishes too; a socket is one thread's at a time."""
        with self._events_lock:
            self._events.send_multipart([topic, content])

    def _status(self) -> dict[str, Any]:
        current = self._collection
        latencies = sorted(self._latencies_s)
        return {
            "cameras": {
                name: {
                    "state": health.state,
                    "detail": health.detail,
                    "frames": health.frames,
                    "lost": health.lost,
                    "clock_resets": health.clock_resets,
                    "silent": name in self._silent(),
                }
                for name in self._names
                if (health := self._health.get(name))
            },
            "silent": self._silent(),
            "framesets": self._set_count,
            "latency_p50_s": latencies[len(latencies) // 2] if latencies else None,
            "latency_p99_s": latencies[int(0.99 * len(latencies))] if latencies else None,
            "collecting": None if current is None else [current.scan_id, len(current.sets)],
            "writing": [name for name, done in self._writing.items() if not done.done()],
            "ended": {event.scan_id: event.state for event in self._ended.values()},
        }


@click.command()
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
def sync(config_path: Path | None) -> None:
    """Match the cameras' frames and write scans; `station run` starts it.

    \b
    Examples:
      station sync --config booth.toml
    """
    config = load_config(find_config(config_path))
    SyncProcess(config, set_up_logs("sync")).run(stop_event())
