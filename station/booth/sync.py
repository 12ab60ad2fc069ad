"""The sync-and-merge process: framesets by hardware time, the live cloud, and outcomes of scans."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import click
import zmq

from station.booth.collection import (
    LATE,
    Collection,
    Order,
    check_words,
    silence_in_words,
    too_slow_words,
    went_silent_words,
)
from station.booth.frame_check import FrameCheck, wrong_sensors
from station.booth.frameset import Frameset, FramesetMatcher, rate_hz
from station.booth.live import LiveCloud, frameset_points, is_empty
from station.booth.scan_writer import Ended, ScanWriter, Started
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.store import CalibrationStore
from station.core.bundle import NOBODY
from station.core.commands import config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.core.rig import Rig
from station.core.scans import CANCELLED, ScanId, scan_id_of
from station.core.service import Heartbeat, only_process, stop_event
from station.messaging.intake import FrameIntake, LiveFrame
from station.messaging.messages import Reply, Request, ScanEvent
from station.messaging.transport import publisher, server
from station.sensors.identity import calibrated_serials

_POLL_MS = 20
_SETS_KEPT = 60
"""Two seconds of them: on a busy computer they come in bursts."""
_LATENCIES_KEPT = 2000
_FLOWING_S = 0.2
"""Age of a camera's last frame up to which its frames flow."""
_ENDED_KEPT = 100


class SyncProcess:
    """Connects the parts: frames to framesets, framesets to scans, orders to outcomes."""

    def __init__(self, config: BoothConfig, log: logging.Logger) -> None:
        self._config, self._log = config, log
        self._names = [camera.name for camera in config.cameras]
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        folder = config.runtime.folder
        self._intake = FrameIntake(self._context, folder, self._names)
        self._commands = server(self._context, folder, "sync")
        self._events = publisher(self._context, folder, "events", "scan")
        self._matcher: FramesetMatcher[LiveFrame] = FramesetMatcher(
            self._names, config.sync.tolerance_s
        )
        self._checks = {name: FrameCheck(replays=name in config.recorded) for name in self._names}
        self._serials: dict[str, str] = {}
        self._live = LiveCloud(config.calibration, config.sync.live_hz)
        self._writer = ScanWriter(config, DriftWatch(CalibrationStore.of(config)), log)
        self._order: Order | None = None
        """Started, but its frames are not being collected yet."""
        self._collection: Collection | None = None
        self._writing: dict[ScanId, Order] = {}
        self._cancelled: set[ScanId] = set()
        self._ended: deque[Ended] = deque(maxlen=_ENDED_KEPT)
        self._set_count = 0
        self._set_times_s: deque[float] = deque(maxlen=max(config.scan.framesets, _SETS_KEPT))
        self._silent_s = time.monotonic()
        """Last moment at which a camera was silent."""
        self._latencies_s: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._heart = Heartbeat(folder, "sync")

    def run(self, stop: threading.Event) -> None:
        """Run until told to stop."""
        poller = zmq.Poller()
        poller.register(self._intake.socket, zmq.POLLIN)
        poller.register(self._commands, zmq.POLLIN)
        self._heart.ready()
        while not stop.is_set():
            ready = dict(poller.poll(_POLL_MS))
            if self._intake.socket in ready:
                self._take_frames()
            if self._commands in ready:
                self._answer()
            for event in self._writer.events():
                self._handle(event)
            self._watch_collection()
            self._heart.beat()
            if self._heart.due:
                self._heart.report(self._health())
        self._writer.close()
        self._context.destroy(linger=0)

    def _take_frames(self) -> None:
        for frame in self._intake.frames():
            header = frame.header
            self._serials[header.camera] = header.serial
            if not self._checks[header.camera].usable(header, frame.depth):
                continue
            for found in self._matcher.push(header.camera, header.host_time_s, frame):
                self._use(found)

    def _use(self, found: Frameset[LiveFrame]) -> None:
        self._set_count += 1
        now_s = time.monotonic()
        self._set_times_s.append(now_s)
        newest_s = max(frame.header.received_s for frame in found.frames.values())
        self._latencies_s.append(now_s - newest_s)
        collection = self._collection
        if collection is not None:
            complete = collection.add(found, now_s)
            self._tell(collection, "writing" if complete else "capturing")
            if complete and (reason := self._useless(collection.rig, found)):
                self._collection = None
                self._fail(collection.order, reason)
            elif complete:
                self._collection = None
                self._writing[collection.order.scan_id] = collection.order
                self._writer.write(collection)
        points = self._live.points(found, now_s)
        if points is not None:
            self._events.send_multipart([b"cloud", points.tobytes()])

    def _handle(self, event: Started | Ended) -> None:
        if isinstance(event, Ended):
            self._ended.append(event)
            told = ScanEvent(
                event.scan_id, "accepted" if event.accepted else "failed", 0, 0, event.reason
            )
            self._events.send_multipart([b"scan", told.pack()])
            self._writing.pop(event.scan_id, None)
            self._cancelled.discard(event.scan_id)
            if self._order is not None and self._order.scan_id == event.scan_id:
                self._order = None
            return
        self._order = None
        if event.order.scan_id in self._cancelled:
            self._fail(event.order, CANCELLED)
            return
        self._matcher.clear()
        scan = self._config.scan
        deadline_s = time.monotonic() + scan.max_duration_s
        self._collection = Collection(event.order, event.rig, scan.framesets, deadline_s)
        self._live.rig = event.rig
        if wrong := self._wrong_sensors(event.rig):
            self._collection = None
            self._fail(event.order, "; ".join(wrong))
        else:
            self._tell(self._collection, "capturing")

    def _watch_collection(self) -> None:
        collection = self._collection
        if collection is None or time.monotonic() < collection.deadline_s:
            return
        self._collection = None
        reason = (
            "; ".join(self._troubles())
            or went_silent_words(self._silent(), self._config.recorded, self._intake.off())
            or self._too_slow_words(len(collection.sets))
        )
        self._fail(collection.order, reason)

    def _fail(self, order: Order, reason: str) -> None:
        self._writing[order.scan_id] = order
        self._writer.fail(order, reason)

    def _silent(self) -> list[str]:
        return self._intake.silent(self._config.sync.silent_after_s)

    def _troubles(self) -> list[str]:
        now_s = time.monotonic()
        return [
            f"camera {name}: {trouble}"
            for name in self._names
            if (trouble := self._checks[name].trouble(now_s))
        ]

    def _too_slow(self, now_s: float) -> str:
        """Words on framesets that are too rare for a scan; empty if they are not."""
        scan = self._config.scan
        since_s = now_s - scan.max_duration_s
        count = sum(moment_s > since_s for moment_s in self._set_times_s)
        # A camera that has just been stopped or unplugged is no sign of a busy computer.
        stopped = self._silent_s > since_s or self._intake.silent(_FLOWING_S)
        if count >= scan.framesets or stopped or self._troubles():
            return ""
        return self._too_slow_words(count)

    def _too_slow_words(self, count: int) -> str:
        """Words on a scan's time in which so many framesets came."""
        scan = self._config.scan
        return too_slow_words(
            count, scan.framesets, scan.max_duration_s, self._config.sync.tolerance_s
        )

    def _useless(self, rig: Rig, last: Frameset[LiveFrame]) -> str:
        """Reason why a scan that ended with a frameset shows no body; empty if it may show one."""
        if wrong := self._wrong_sensors(rig):
            return "; ".join(wrong)
        empty = is_empty(self._config.volume, frameset_points(rig, last))
        return NOBODY if empty else ""

    def _wrong_sensors(self, rig: Rig) -> list[str]:
        return wrong_sensors(self._serials, calibrated_serials(rig.cameras))

    def _answer(self) -> None:
        *route, packed = self._commands.recv_multipart()
        try:
            reply = self._reply(Request.unpack(packed))
        except BoothError as error:
            reply = Reply(ok=False, error=str(error))
        self._commands.send_multipart([*route, reply.pack()])

    def _reply(self, request: Request) -> Reply:
        if request.command == "scan":
            order = Order(scan_id_of(request.scan_id), request.label, request.valid_until_s)
            self._take_up(order)
            return Reply(ok=True)
        if request.command == "cancel":
            return self._cancel(scan_id_of(request.scan_id), request.valid_until_s)
        return Reply(ok=False, error=f"sync does not know the command {request.command!a:.80}")

    def _take_up(self, order: Order) -> None:
        """Start a scan, or refuse it with the reason; the outcome is on disk either way."""
        if order.scan_id in self._in_hand():
            return
        cancelled = CANCELLED if order.scan_id in self._cancelled else ""
        late = LATE if order.late(time.monotonic()) else ""
        if reason := cancelled or late or self._unready():
            self._writer.refuse(order, reason)
        else:
            self._order = order
            self._writer.begin(order)

    def _in_hand(self) -> set[ScanId]:
        found = set(self._writing)
        if self._order is not None:
            found.add(self._order.scan_id)
        if self._collection is not None:
            found.add(self._collection.order.scan_id)
        return found

    def _unready(self) -> str:
        """Reason why no scan can be taken now; empty if one can."""
        if self._order is not None and (stalled := self._writer.stalled(time.monotonic())):
            return f"{stalled}; check it with station status, and scan again when it does"
        if self._order is not None or self._collection is not None:
            current = self._order or (self._collection and self._collection.order)
            return f"scan {current and current.scan_id} is being taken; wait until it is done"
        if silent := self._silent():
            told = silence_in_words({name: self._intake.why(name) for name in silent})
            stays = (
                "if it stays silent, see station status"
                if len(silent) == 1
                else "if they stay silent, see station status"
            )
            remedy = check_words(silent, self._config.recorded)
            return f"{told}; scan again in a few seconds; {stays}; {remedy}"
        return "; ".join(self._troubles())

    def _cancel(self, scan_id: ScanId, valid_until_s: float = 0.0) -> Reply:
        """Stop collecting a scan and discard what was collected; its order may come later, until
        `valid_until_s`, if it was sent while sync was restarting."""
        if scan_id in self._writing:
            return Reply(
                ok=False, error=f"scan {scan_id} is being stored: it is too late to cancel"
            )
        collection, ended = self._collection, {event.scan_id for event in self._ended}
        if collection is not None and collection.order.scan_id == scan_id:
            self._collection = None
            self._fail(collection.order, CANCELLED)
        elif scan_id in self._in_hand() or (
            scan_id not in ended and time.monotonic() < valid_until_s
        ):
            self._cancelled.add(scan_id)
        else:
            return Reply(ok=False, error=f"scan {scan_id} is not being taken")
        return Reply(ok=True)

    def _tell(self, collection: Collection, state: str) -> None:
        count = len(collection.sets)
        event = ScanEvent(collection.order.scan_id, state, count, collection.wanted)
        self._events.send_multipart([b"scan", event.pack()])

    def _health(self) -> dict[str, Any]:
        now_s = time.monotonic()
        silent = self._silent()
        if silent:
            self._silent_s = now_s
        latencies = sorted(self._latencies_s)
        collection = self._collection
        return {
            "cameras": {
                name: {
                    "state": health.state,
                    "detail": health.detail,
                    "frames": health.frames,
                    "lost": health.lost,
                    "unmatched": self._matcher.dropped[name],
                    "clock_resets": health.clock_resets,
                    "silent": name in silent,
                    "last_frame_age_s": now_s - self._intake.last_frame_s.get(name, now_s),
                    "rate_hz": None if name in silent else self._checks[name].rate_hz(),
                    "trouble": self._checks[name].trouble(now_s),
                }
                for name in self._names
                if (health := self._intake.health.get(name))
            },
            "silent": silent,
            "problems": [
                *filter(None, [self._writer.stalled(now_s), self._too_slow(now_s)]),
                *(self._wrong_sensors(rig) if (rig := self._live.rig) else []),
            ],
            "remarks": self._writer.remarks(rig),
            "framesets": self._set_count,
            "framesets_hz": rate_hz(self._set_times_s, now_s),
            "latency_p50_s": latencies[len(latencies) // 2] if latencies else None,
            "latency_p99_s": latencies[int(0.99 * len(latencies))] if latencies else None,
            "collecting": None
            if collection is None
            else [collection.order.scan_id, len(collection.sets)],
            "writing": list(self._writing),
            "ended": {e.scan_id: "accepted" if e.accepted else "failed" for e in self._ended},
            "unreadable_messages": self._intake.unreadable,
            "last_unreadable": self._intake.last_problem,
        }


@click.command()
@config_option
def sync(config_path: Path | None) -> None:
    """Match the cameras' frames and write scans; `station run` starts it.

    \b
    Examples:
      station sync --config booth.toml
    """
    config = load_config(find_config(config_path))
    with only_process(config.runtime.folder, "sync") as log:
        SyncProcess(config, log).run(stop_event())
