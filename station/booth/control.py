"""The operator's endpoint: start, stop, scan, cancel, status. Every command is answered, and
repeating one is harmless.

Commands are `Request` messages to the socket `control` in the runtime folder, answers `Reply`
messages (`station.messaging`). Their content:

    start, stop          {"streaming": bool}
    scan, scan-status,   {"scan_id", "label", "state", "framesets", "wanted", "reason", "path"};
    cancel               `station.booth.session` names the states. A scan is ordered at once; its
                         state, also a refusal, is asked for with scan-status
    status               `station.booth.health.BoothHealth`

Control keeps no state of scans: orders are notes in the spool, sync decides their outcome, and both
outlive this process. Scans by label and time: `station.archive`.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import OrderedDict
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click
import zmq

from station.booth.health import booth_health
from station.booth.metrics import serve_metrics
from station.booth.retention import Tidying
from station.booth.session import (
    FINAL,
    MAX_LABEL_LENGTH,
    UNSURE,
    Session,
    overdue,
    state_of,
)
from station.core.commands import config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError
from station.core.files import disk_words, private_folder, write_json
from station.core.scans import (
    CANCELLED,
    ScanId,
    ScanNote,
    boot_id,
    failure_reason,
    plain_label,
    scan_id_of,
)
from station.core.service import Heartbeat, only_process, stop_event
from station.core.spool import Spool
from station.messaging.countdowns import cancel_countdown, end_countdown
from station.messaging.messages import DesiredState, Reply, Request, ScanEvent
from station.messaging.topics import TOPICS
from station.messaging.transport import ask, dealer, publisher, server, subscriber

_POLL_MS = 50
_SYNC_TIMEOUT_S = 2.0
_REMIND_PERIOD_S = 0.5
_PROGRESS_KEPT = 100


class ControlProcess:
    """Keeps the desired state of the sensors, and reports the state of each scan."""

    def __init__(self, config: BoothConfig, config_path: Path, log: logging.Logger) -> None:
        self._config, self._config_path, self._log = config, config_path, log
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._folder = config.runtime.folder
        self._requests = server(self._context, self._folder, "control")
        self._wishes = publisher(self._context, self._folder, "desired", "desired")
        self._events = subscriber(self._context, self._folder, ["events"], ["scan"])
        self._orders = dealer(self._context, self._folder, "sync")
        self._spool = Spool(config.spool.folder)
        self._progress: OrderedDict[str, ScanEvent] = OrderedDict()
        self._reminded_s: dict[str, float] = {}
        self._memory = private_folder(self._folder) / "desired.json"
        self._streaming = self._remembered()
        self._wished_s = 0.0
        self._tidying = Tidying(self._spool, config_path, log)
        self._unreadable = 0
        self._heart = Heartbeat(self._folder, "control")

    def run(self, stop: threading.Event) -> None:
        """Run until told to stop."""
        poller = zmq.Poller()
        for socket in (self._requests, self._events, self._orders):
            poller.register(socket, zmq.POLLIN)
        self._heart.ready()
        while not stop.is_set():
            ready = dict(poller.poll(_POLL_MS))
            if self._events in ready:
                self._receive()
            if self._orders in ready:
                self._orders.recv_multipart()  # sync's decision on an order is on disk
            if self._requests in ready:
                self._answer()
            now_s = time.monotonic()
            if now_s - self._wished_s > 1.0 / TOPICS["desired"].rate_hz:
                self._publish_desired()
            self._tidying.look(now_s)
            self._heart.beat()
            if self._heart.due:
                self._heart.report(
                    {"streaming": self._streaming, "unreadable_messages": self._unreadable}
                )
        self._context.destroy(linger=0)

    def _remembered(self) -> bool:
        """The operator's last start or stop: a restarted control process must not stop the
        sensors."""
        try:
            return bool(json.loads(self._memory.read_text())["streaming"])
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def _publish_desired(self) -> None:
        self._wished_s = time.monotonic()
        self._wishes.send_multipart([b"desired", DesiredState(self._streaming).pack()])

    def _receive(self) -> None:
        parts = self._events.recv_multipart()
        try:
            event = ScanEvent.unpack(parts[-1])
        except BoothError:
            self._unreadable += 1
            return
        if not event.wanted:
            return  # a verdict: it is on disk
        self._progress[event.scan_id] = event
        self._progress.move_to_end(event.scan_id)
        while len(self._progress) > _PROGRESS_KEPT:
            self._progress.popitem(last=False)

    def _answer(self) -> None:
        *route, packed = self._requests.recv_multipart()
        try:
            reply = self._reply(Request.unpack(packed))
        except BoothError as error:
            reply = Reply(ok=False, error=str(error))
        except OSError as error:
            reply = Reply(ok=False, error=disk_words(error))
        try:
            self._requests.send_multipart([*route, reply.pack()])
        except zmq.ZMQError as error:
            # The sender is gone, or gave no address to reply to.
            self._log.info("a reply could not be sent (%s)", error)

    def _reply(self, request: Request) -> Reply:
        if request.command in ("start", "stop"):
            self._streaming = request.command == "start"
            write_json(self._memory, {"streaming": self._streaming})
            self._publish_desired()
            return Reply(ok=True, content={"streaming": self._streaming})
        if request.command == "scan":
            return self._scan(request)
        if request.command == "cancel":
            return self._cancel(request)
        if request.command == "scan-status":
            return Reply(ok=True, content=self._scan_status(scan_id_of(request.scan_id)))
        if request.command == "status":
            health = booth_health(self._config, self._config_path)
            return Reply(ok=True, content={**asdict(health), "streaming": self._streaming})
        return Reply(ok=False, error=f"control does not know the command {request.command!a:.80}")

    def _scan(self, request: Request) -> Reply:
        """Record an order and pass it on; only sync decides its outcome."""
        scan_id = scan_id_of(request.scan_id)
        if (known := self._known(scan_id)) is not None:
            return Reply(ok=True, content=known)
        if not end_countdown(self._folder, scan_id):
            return Reply(ok=False, error=CANCELLED)
        label = plain_label(request.label)
        if len(label) > MAX_LABEL_LENGTH:
            return Reply(
                ok=False,
                error=f"the label has {len(label)} characters, {MAX_LABEL_LENGTH} are "
                "allowed; shorten it; no scan was started",
            )
        if not self._streaming:
            return Reply(ok=False, error="the sensors are stopped; run station start first")
        now_s = time.monotonic()
        valid_until_s = request.valid_until_s or now_s + self._config.runtime.command_timeout_s
        if now_s > valid_until_s:
            return Reply(
                ok=False, error=f"the request for scan {scan_id} expired; no scan was started"
            )
        note = ScanNote(
            scan_id,
            "armed",
            label=label,
            valid_until_s=valid_until_s,
            boot=boot_id(),
        )
        self._spool.notes.write(note, durable=False)
        self._pass_on(note)
        return Reply(ok=True, content=self._scan_status(scan_id))

    def _pass_on(self, note: ScanNote) -> None:
        """Send an order to sync, without waiting: sync may be restarting."""
        self._reminded_s = {note.scan_id: time.monotonic()}
        valid_until_s = note.valid_until_s if note.boot == boot_id() else -1.0
        request = Request("scan", note.scan_id, note.label, valid_until_s)
        try:
            self._orders.send_multipart([b"", request.pack()], zmq.NOBLOCK)
        except zmq.Again:
            self._log.warning("sync is not accepting requests at the moment")

    def _cancel(self, request: Request) -> Reply:
        """Cancel a scan in the console's countdown, being taken or waiting; a later one has a
        result, which can be purged."""
        scan_id = scan_id_of(request.scan_id)
        if cancel_countdown(self._folder, scan_id):
            return Reply(ok=True, content=asdict(Session(scan_id, "", "failed", reason=CANCELLED)))
        status = self._scan_status(scan_id)
        if status["state"] == "failed":
            return Reply(ok=True, content=status)
        if status["state"] in ("armed", "capturing"):
            request = replace(request, valid_until_s=self._comes_until_s(scan_id))
            answer = ask(self._folder, "sync", request, _SYNC_TIMEOUT_S)
            if not answer.ok:
                return answer
            # Sync is still writing its decision to disk.
            return Reply(ok=True, content={**status, "reason": CANCELLED})
        withdrawn = status["state"] == "accepted" and self._spool.withdraw(scan_id, CANCELLED)
        status = self._scan_status(scan_id)
        if withdrawn:
            return Reply(ok=True, content=status)
        if status["state"] in FINAL:
            remedy = f"delete it with: station purge {scan_id}"
        else:
            remedy = f"when it is done, delete it with: station purge {scan_id}"
        words = f"scan {scan_id} can no longer be cancelled (its state is {status['state']})"
        return Reply(ok=False, error=f"{words}; {remedy}")

    def _comes_until_s(self, scan_id: ScanId) -> float:
        """Moment until which sync may get a scan's order after its cancel, which overtakes it while
        sync restarts; 0 if it has it, or if the disk does not say."""
        with suppress(OSError):
            note = self._spool.notes.read(scan_id)
            if note is not None and note.stage == "armed" and note.boot == boot_id():
                return note.valid_until_s
        return 0.0

    def _scan_status(self, scan_id: ScanId) -> dict[str, Any]:
        """A scan's state as the disk has it.

        Raises:
            BoothError: there is no such scan.
        """
        status = self._known(scan_id)
        if status is None:
            raise BoothError(f"there is no scan {scan_id}; see station list")
        return status

    def _known(self, scan_id: ScanId) -> dict[str, Any] | None:
        """A scan's state, or None if there is no such scan.

        A disk that cannot be read says neither: a refusal would be untrue, as the scan may go on.
        """
        try:
            session = self._session(scan_id)
        except OSError as error:
            self._log.warning("the state of a scan cannot be read: %s", error)
            session = Session(scan_id, "", "armed", reason=UNSURE)
        return None if session is None else asdict(session)

    def _session(self, scan_id: ScanId) -> Session | None:
        note = self._spool.notes.read(scan_id)
        place = self._spool.where(scan_id)
        if place is None:
            # It may have ended between the two reads.
            note = self._spool.notes.read(scan_id)
        state = state_of(note, place)
        if state is None:
            return None
        reason = "" if note is None or state in ("accepted", "reconstructing") else note.reason
        if place == "failed":
            reason = failure_reason(self._spool.path(place, scan_id))
        if note is not None and place is None and overdue(note, time.monotonic(), boot_id()):
            reason = UNSURE
            if time.monotonic() - self._reminded_s.get(scan_id, 0.0) > _REMIND_PERIOD_S:
                self._pass_on(note)
        progress = self._progress.get(scan_id)
        return Session(
            scan_id,
            "" if note is None else note.label,
            state,
            framesets=progress.framesets if progress else 0,
            wanted=progress.wanted if progress else 0,
            reason=reason,
            path=str(self._spool.path(place, scan_id)) if place else "",
        )


@click.command()
@config_option
def control(config_path: Path | None) -> None:
    """Answer the operator's commands; `station run` starts it.

    \b
    Examples:
      station control --config booth.toml
    """
    path = find_config(config_path)
    config = load_config(path)
    with only_process(config.runtime.folder, "control") as log:
        serve_metrics(config, path.resolve(), log)
        ControlProcess(config, path.resolve(), log).run(stop_event())
