"""The operator's endpoint: start, stop, scan, status. Every command is answered, and twice the same
does no harm."""

from __future__ import annotations

import json
import logging
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import zmq

from station.booth.retention import expire_old
from station.booth.session import CANCELLED, ON_DISK, Session, advance, expire
from station.core.config import BoothConfig, find_config, load_config
from station.core.errors import BoothError
from station.core.files import private_folder, write_json
from station.core.service import notify, set_up_logs, stop_event
from station.core.spool import REASON, Spool, count_scans
from station.messaging.messages import DesiredState, Reply, Request, ScanEvent
from station.messaging.topics import TOPICS
from station.messaging.transport import ask, publisher, server, subscriber

_POLL_MS = 50
_SYNC_TIMEOUT_S = 2.0
_GRACE_S = 4.0
"""Beyond a scan's longest duration: writing the bundle and the news of it."""
_SESSIONS_KEPT = 200
_TIDY_PERIOD_S = 3600.0


class ControlProcess:
    """Holds what the operator wants, and what became of each scan."""

    def __init__(self, config: BoothConfig, log: logging.Logger) -> None:
        self._config, self._log = config, log
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._folder = config.runtime.folder
        self._requests = server(self._context, self._folder, "control")
        self._wishes = publisher(self._context, self._folder, "desired", "desired")
        self._events = subscriber(self._context, self._folder, ["events"], ["scan"])
        self._spool = Spool(config.spool.folder)
        self._sessions: dict[str, Session] = {}
        self._memory = private_folder(self._folder) / "desired.json"
        self._streaming = self._remembered()
        self._wished_s = 0.0
        self._tidied_s = -_TIDY_PERIOD_S

    def run(self, stop: threading.Event) -> None:
        """Until told to stop."""
        poller = zmq.Poller()
        poller.register(self._requests, zmq.POLLIN)
        poller.register(self._events, zmq.POLLIN)
        self._spool.sweep()
        notify("READY=1")
        while not stop.is_set():
            ready = dict(poller.poll(_POLL_MS))
            if self._events in ready:
                event = ScanEvent.unpack(self._events.recv_multipart()[1])
                self._hear(event)
            if self._requests in ready:
                self._answer()
            now_s = time.monotonic()
            if now_s - self._wished_s > 1.0 / TOPICS["desired"].rate_hz:
                self._wish()
            if now_s - self._tidied_s > _TIDY_PERIOD_S:
                self._tidied_s = now_s
                for folder in expire_old(self._spool, self._config.retention, time.time()):
                    self._log.info("removed %s: its retention period is over", folder)
        self._context.destroy(linger=0)

    def _remembered(self) -> bool:
        """The operator's last order: a restarted control must not stop the sensors."""
        try:
            return bool(json.loads(self._memory.read_text())["streaming"])
        except (OSError, ValueError, KeyError):
            return False

    def _wish(self) -> None:
        self._wished_s = time.monotonic()
        self._wishes.send_multipart([b"desired", DesiredState(self._streaming).pack()])
        notify("WATCHDOG=1")

    def _hear(self, event: ScanEvent) -> None:
        session = self._sessions.get(event.scan_id)
        if session is None or event.state not in ("capturing", "accepted", "failed"):
            return
        self._sessions[event.scan_id] = advance(
            session,
            event.state,  # type: ignore[arg-type]  # narrowed by the line above
            framesets=event.framesets,
            wanted=event.wanted,
            reason=event.reason,
        )

    def _answer(self) -> None:
        *route, packed = self._requests.recv_multipart()
        try:
            reply = self._reply(Request.unpack(packed))
        except (BoothError, OSError) as error:
            reply = Reply(ok=False, error=str(error))
        self._requests.send_multipart([*route, reply.pack()])

    def _reply(self, request: Request) -> Reply:
        if request.command in ("start", "stop"):
            self._streaming = request.command == "start"
            write_json(self._memory, {"streaming": self._streaming})
            self._wish()
            return Reply(ok=True, content={"streaming": self._streaming})
        if request.command == "scan":
            return self._scan(request)
        if request.command == "cancel":
            return self._cancel(request)
        if request.command == "scan-status":
            return Reply(ok=True, content=self._scan_status(request.scan_id))
        if request.command == "status":
            return Reply(ok=True, content=self._status())
        return Reply(ok=False, error=f"control knows no command {request.command!r}")

    def _scan(self, request: Request) -> Reply:
        if request.scan_id in self._sessions or self._spool.where(request.scan_id):
            return Reply(ok=True, content=self._scan_status(request.scan_id))
        if not self._streaming:
            return Reply(ok=False, error="the sensors are stopped; run station start first")
        answer = ask(self._folder, "sync", request, _SYNC_TIMEOUT_S)
        if not answer.ok:
            return answer
        self._sessions[request.scan_id] = Session(request.scan_id, request.label, time.monotonic())
        for old in list(self._sessions)[:-_SESSIONS_KEPT]:
            del self._sessions[old]
        return Reply(ok=True, content=self._scan_status(request.scan_id))

    def _cancel(self, request: Request) -> Reply:
        """Give a scan up while it is taken or waits; later there is a result, to be purged."""
        scan_id = request.scan_id
        place = self._spool.where(scan_id)
        status = self._scan_status(scan_id)
        if status["state"] == "failed":
            return Reply(ok=True, content=status)
        if place is None:
            answer = ask(self._folder, "sync", request, _SYNC_TIMEOUT_S)
            if not answer.ok:
                return answer
            self._sessions[scan_id] = advance(self._sessions[scan_id], "failed", reason=CANCELLED)
        elif place != "queue" or not self._spool.withdraw(scan_id, CANCELLED):
            return Reply(
                ok=False,
                error=f"scan {scan_id} is past cancelling (it is {status['state']}); "
                f"delete it when it is done: station purge {scan_id}",
            )
        return Reply(ok=True, content=self._scan_status(scan_id))

    def _scan_status(self, scan_id: str) -> dict[str, Any]:
        """A scan's state; of accepted ones the disk is the truth.

        Raises:
            BoothError: nobody knows the scan.
        """
        place = self._spool.where(scan_id)
        session = self._sessions.get(scan_id)
        if session is None:
            if place is None:
                raise BoothError(f"scan {scan_id} is unknown here; see station status")
            session = Session(scan_id, "", time.monotonic(), "accepted")
        session = self._with_disk(session, place)
        if place is None and session.state not in ON_DISK:
            limit_s = self._config.scan.max_duration_s + _GRACE_S
            session = expire(session, time.monotonic(), limit_s)
        self._sessions[scan_id] = session
        return {**asdict(session), "path": str(self._spool.path(place, scan_id)) if place else ""}

    def _with_disk(self, session: Session, place: str | None) -> Session:
        if place == "queue":
            return advance(session, "accepted")
        if place == "work":
            return advance(session, "reconstructing")
        if place == "failed":
            return advance(session, "failed", reason=self._reason(session.scan_id))
        if place == "outbox":
            result = json.loads(
                (self._spool.path(place, session.scan_id) / "result.json").read_text()
            )
            if result["status"] == "ok":
                return advance(session, "delivered")
            return advance(session, "rescan", reason="; ".join(result["reasons"]))
        return session

    def _reason(self, scan_id: str) -> str:
        try:
            return str(
                json.loads((self._spool.path("failed", scan_id) / REASON).read_text())["reason"]
            )
        except (OSError, ValueError, KeyError):
            return "unknown; see the workers' log"

    def _status(self) -> dict[str, Any]:
        try:
            sync = ask(self._folder, "sync", Request("status"), _SYNC_TIMEOUT_S)
            sensed: dict[str, Any] = sync.content
        except BoothError as error:
            sensed = {"error": str(error)}
        return {
            "streaming": self._streaming,
            "spool": count_scans(self._spool.folder),
            "sync": sensed,
        }


@click.command()
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
def control(config_path: Path | None) -> None:
    """Answer the operator's commands; `station run` starts it.

    \b
    Examples:
      station control --config booth.toml
    """
    config = load_config(find_config(config_path))
    ControlProcess(config, set_up_logs("control")).run(stop_event())
