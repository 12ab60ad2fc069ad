"""Disk operations of taking a scan: notes on orders, bundles, outcomes.

Everything here runs in one thread beside the frames: a stalled disk delays an outcome, but loses no
frame and changes no outcome. The collecting thread is informed through `events`.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from station.booth.collection import LATE, Collection, Order
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.store import CalibrationStore
from station.calibration.moves.look import Look, compared
from station.calibration.moves.motion import CameraMove, depths_words
from station.core.bundle import CapturedFrame, write_bundle
from station.core.config import BoothConfig
from station.core.errors import BoothError, CalibrationError
from station.core.files import utc_now
from station.core.rig import Rig
from station.core.scans import ScanId, ScanNote, boot_id
from station.core.spool import Spool
from station.sensors.identity import calibrated_serials, configured_serials, mismatch

T = TypeVar("T")
_DISK_RETRY_S = 0.5
_STALLED_S = 3.0
"""A bundle is written in less than one, a verdict in milliseconds."""
_DISK_LATE = (
    "the spool's disk answered too late, and the scan was not started; check it with station "
    "status and scan again"
)
_ENDED = "the station was interrupted during the scan; scan again"


@dataclass(frozen=True, slots=True)
class Started:
    """An order is recorded: its frames may be collected."""

    order: Order
    rig: Rig


@dataclass(frozen=True, slots=True)
class Ended:
    """A scan has its outcome."""

    scan_id: ScanId
    accepted: bool
    reason: str


class ScanWriter:
    """Processes orders and collections one after another."""

    def __init__(self, config: BoothConfig, drift: DriftWatch, log: logging.Logger) -> None:
        self._config, self._drift, self._log = config, drift, log
        self._names = [camera.name for camera in config.cameras]
        self._spool = Spool(config.spool.folder)
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._events: queue.SimpleQueue[Started | Ended] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._begun_s: float | None = None
        """Start of the task that is being done."""
        self._remarks: list[tuple[str, str]] = []
        """Date of the calibration that the words refer to, and the words."""
        self._thread = threading.Thread(target=self._run, name="scan writer", daemon=True)
        self._thread.start()
        self._tasks.put(self._settle_abandoned)
        if config.drift.refuse_scans:
            self._tasks.put(partial(self._prepare_check, self._names))

    def begin(self, order: Order) -> None:
        """Record that an order is started; `Started` or `Ended` follows."""
        self._tasks.put(partial(self._guarded, order, partial(self._begin, order)))

    def refuse(self, order: Order, reason: str) -> None:
        """Record that an order was refused."""
        self._tasks.put(partial(self._refuse, order, reason))

    def fail(self, order: Order, reason: str) -> None:
        """Record that a scan failed while it was being collected."""
        self._tasks.put(partial(self._failed, order, reason))

    def write(self, collection: Collection) -> None:
        """Write a complete collection's bundle; `Ended` follows."""
        self._tasks.put(partial(self._guarded, collection.order, partial(self._write, collection)))

    def events(self) -> Iterator[Started | Ended]:
        """Events since the last call."""
        while True:
            try:
                yield self._events.get_nowait()
            except queue.Empty:
                return

    def close(self) -> None:
        """End after the current write."""
        self._tasks.put(None)
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while (task := self._tasks.get()) is not None:
            self._begun_s = time.monotonic()
            try:
                task()
            except Exception:
                self._log.exception("the outcome of a scan could not be recorded")
            finally:
                self._begun_s = None
                # A finished scan's frames must not stay in memory until the next one comes.
                del task

    def remarks(self, rig: Rig | None) -> list[str]:
        """Words on the sensors, from the last scan's background, if they were calibrated so."""
        return [words for created, words in self._remarks if rig and rig.created == created]

    def stalled(self, now_s: float) -> str:
        """The disk's delay in words, once it is long; empty otherwise."""
        begun_s = self._begun_s
        if begun_s is None or now_s - begun_s < _STALLED_S:
            return ""
        return f"the spool's disk has not answered for {now_s - begun_s:.0f} s"

    def _guarded(self, order: Order, task: Callable[[], None]) -> None:
        """Run a task; an error becomes the scan's outcome, unless it was accepted anyway."""
        try:
            task()
        except BoothError as error:
            self._failed(order, str(error))
        except OSError as error:
            self._failed(
                order,
                f"the scan could not be stored in the spool ({error.strerror or error}); check "
                "its disk with station status, then scan again",
            )
        except Exception as error:
            self._log.exception("scan %s", order.scan_id, extra={"scan": order.scan_id})
            self._failed(order, f"the scan could not be written ({error}); scan again")

    def _begin(self, order: Order) -> None:
        spool = self._spool
        note = spool.notes.read(order.scan_id)
        accepted = spool.where(order.scan_id) is not None
        if accepted or (note is not None and note.stage != "armed"):
            # A repeated order: its outcome stands.
            refused = not accepted and note is not None and note.stage == "failed"
            reason = note.reason if refused and note is not None else ""
            self._events.put(Ended(order.scan_id, not refused, reason))
            return
        spool.check_space(self._config.spool.min_free_mb)
        rig = booth_rig(self._config)
        note = ScanNote(
            order.scan_id,
            "capturing",
            label=order.label,
            valid_until_s=order.valid_until_s,
            boot=boot_id(),
        )
        spool.notes.write(note, durable=False)
        if order.late(time.monotonic()):
            raise BoothError(_DISK_LATE)
        self._events.put(Started(order, rig))

    def _refuse(self, order: Order, reason: str) -> None:
        spool = self._spool
        note = self._retried(partial(spool.notes.read, order.scan_id))
        if note is None or note.stage == "armed":
            self._failed(order, reason)

    def _write(self, collection: Collection) -> None:
        order, rig = collection.order, collection.rig
        if self._config.drift.refuse_scans:
            # Seconds where many cameras moved, in which no disk is waited for.
            self._begun_s = None
            try:
                rig = self._checked(collection)
            finally:
                self._begun_s = time.monotonic()
        spool = self._spool
        temporary = spool.temporary(order.scan_id)
        write_bundle(
            temporary,
            scan_id=order.scan_id,
            created=utc_now(),
            label=order.label,
            booth=self._config.name,
            depth_scale_m=collection.depth_scale_m(),
            rig=rig,
            frames={name: _captured(collection, name) for name in self._names},
            spread_s_max=max(found.spread_s for found in collection.sets),
        )
        spool.submit(temporary, order.scan_id)
        self._log.info(
            "scan %s written %.2f s after its last frameset",
            order.scan_id,
            time.monotonic() - collection.complete_s,
            extra={"scan": order.scan_id},
        )
        self._end(order.scan_id, True, "")

    def _prepare_check(self, cameras: Sequence[str]) -> None:
        """Prepare the check for moved cameras, which the first scan would wait a second for.

        One camera a task, so that an order that comes meanwhile waits for one.
        """
        if not cameras:
            return
        try:
            camera = booth_rig(self._config).cameras[cameras[0]]
            self._begun_s = None  # on a busy computer it lasts, and no disk is waited for
            self._drift.prepare(camera)
        except (BoothError, OSError):
            return  # a scan will say why
        self._tasks.put(partial(self._prepare_check, cameras[1:]))

    def _checked(self, collection: Collection) -> Rig:
        """The calibration for the sensors as they are at this scan, whose depths may have changed.

        A scan with a wrong one is useless: report it while the person is still there.

        Raises:
            CalibrationError: naming the cameras that moved.
        """
        rig, looks = collection.rig, dict[str, Look]()
        for name in self._names:
            look = self._drift.look(
                rig.cameras[name],
                [found.frames[name].depth for found in collection.sets],
                collection.sets[0].frames[name].header.depth_scale_m,
            )
            if look is not None:
                looks[name] = look
        changed, moves = compared(looks, self._names)
        self._remarks = [(rig.created, changed.words())] if changed else []
        moved: list[CameraMove] = []
        for move in moves:
            if self._drift.confirmed(move):
                moved.append(move)
            elif move.moved:
                self._log.warning("the next scan decides: %s", move.words())
        if len(moved) == len(self._names) and (words := depths_words(moved)):
            raise CalibrationError(words)
        if moved:
            raise CalibrationError(
                f"{'; '.join(move.words() for move in moved)}; put the camera back and run station "
                "check, or run station calibrate"
            )
        if changed and changed.too_large:
            raise CalibrationError(changed.words())
        return changed.corrected(rig) if changed else rig

    def _failed(self, order: Order, reason: str) -> None:
        """The scan failed, unless its bundle got into the queue before the error."""
        spool = self._spool
        if self._retried(partial(spool.where, order.scan_id)) is not None:
            self._end(order.scan_id, True, "")
            return
        note = ScanNote(order.scan_id, "failed", label=order.label, reason=reason, boot=boot_id())
        self._retried(partial(spool.notes.write, note, durable=False))
        self._end(order.scan_id, False, reason)

    def _end(self, scan_id: ScanId, accepted: bool, reason: str) -> None:
        verdict = "accepted" if accepted else "failed"
        self._log.info("scan %s %s %s", scan_id, verdict, reason, extra={"scan": scan_id})
        self._events.put(Ended(scan_id, accepted, reason))

    def _settle_abandoned(self) -> None:
        """Fail the scans that an earlier sync process left unfinished: nobody collects them."""
        spool = self._spool
        try:
            spool.sweep()
        except OSError as error:
            self._log.warning("what was left unfinished could not be removed: %s", error)
        for scan_id in self._retried(spool.notes.ids):
            try:
                note = spool.notes.read(scan_id)
            except OSError as error:
                # One file that cannot be read must not keep all scans waiting.
                self._log.warning("the note of scan %s cannot be read: %s", scan_id, error)
                continue
            if note is None or note.stage not in ("armed", "capturing"):
                continue
            same_boot = note.boot == boot_id()
            order = Order(scan_id, note.label, note.valid_until_s)
            if note.stage == "armed" and same_boot and not order.late(time.monotonic()):
                continue
            if self._retried(partial(spool.where, scan_id)) is None:
                # It may have been delivered and taken away between the two reads.
                again = self._retried(partial(spool.notes.read, scan_id))
                if again is not None and again.stage in ("armed", "capturing"):
                    self._failed(order, _ENDED if note.stage == "capturing" else LATE)

    def _retried(self, call: Callable[[], T]) -> T:
        """Retry a disk operation until it succeeds: an outcome must not depend on a passing
        fault."""
        told = False
        while True:
            try:
                return call()
            except OSError as error:
                if self._stop.is_set():
                    raise
                if not told:
                    self._log.warning("waiting for the spool's disk: %s", error)
                told = True
                self._stop.wait(_DISK_RETRY_S)


def _captured(collection: Collection, name: str) -> list[CapturedFrame]:
    """A camera's frames of all framesets."""
    frames = [found.frames[name] for found in collection.sets]
    return [
        CapturedFrame(
            frame.depth,
            frame.header.device_ticks,
            frame.header.tick_hz,
            frame.header.host_time_s,
            frame.header.sequence,
        )
        for frame in frames
    ]


def booth_rig(config: BoothConfig) -> Rig:
    """The calibration in use, which is of the booth's cameras and sensors and no others.

    Raises:
        BoothError: it is not, or cannot be read.
    """
    rig = CalibrationStore.of(config).rig_in_use()
    if words := mismatch(calibrated_serials(rig.cameras), configured_serials(config.cameras)):
        raise CalibrationError(words)
    return rig
