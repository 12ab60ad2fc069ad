"""The thread that writes scans keeps nothing of a scan once it has its outcome."""

from __future__ import annotations

import logging
import queue
import threading
import time
import weakref
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from waiting import wait_until

from station.booth import scan_writer
from station.booth.collection import Collection, Order
from station.booth.frameset import Frameset
from station.booth.scan_writer import Ended, ScanWriter, Started
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.store import CalibrationStore
from station.calibration.moves.look import Look
from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.rig import CameraCalibration, Rig
from station.core.scans import ScanId
from station.messaging.intake import LiveFrame
from station.messaging.messages import FrameHeader
from station.simulation.scene import default_rig

_HEADER = FrameHeader("front-lower", "V1", 640, 480, 1e-4, 7, 6e7, 5.0, 5.0, 1, 0)


def test_frames_of_a_finished_scan_leave_the_memory(one_camera: BoothConfig) -> None:
    store = CalibrationStore.of(one_camera)
    writer = ScanWriter(one_camera, DriftWatch(store), logging.getLogger())
    try:
        depth = np.zeros((480, 640), np.uint16)
        found = Frameset({"front-lower": LiveFrame(_HEADER, depth)}, 5.0, 0.0)
        order = Order(ScanId("a"), "", 1e9)
        writer.write(Collection(order, default_rig(), 1, 1e9, [found]))
        kept = weakref.ref(depth)
        del depth, found
        [ended] = _events(writer)
        # There is no calibration to check against.
        assert isinstance(ended, Ended)
        assert not ended.accepted
        wait_until(lambda: kept() is None, "the frame is forgotten")
    finally:
        writer.close()


def test_a_repeated_order_of_a_refused_scan_is_not_told_as_accepted(
    one_camera: BoothConfig,
) -> None:
    """The page of an accepted scan, /person, says that the person may leave."""
    writer = ScanWriter(
        one_camera, DriftWatch(CalibrationStore.of(one_camera)), logging.getLogger()
    )
    try:
        order = Order(ScanId("a"), "", 1e9)
        writer.refuse(order, "the booth is empty")
        assert _events(writer) == [Ended(ScanId("a"), False, "the booth is empty")]
        writer.begin(order)
        assert _events(writer) == [Ended(ScanId("a"), False, "the booth is empty")]
    finally:
        writer.close()


class _LongCheck(DriftWatch):
    """A check for moved cameras that lasts until it is told to end."""

    def __init__(self, store: CalibrationStore) -> None:
        super().__init__(store)
        self.begun, self.end = threading.Event(), threading.Event()

    def look(
        self, camera: CameraCalibration, frames: Sequence[NDArray[np.uint16]], scale_m: float
    ) -> Look | None:
        self.begun.set()
        assert self.end.wait(20.0)
        return super().look(camera, frames, scale_m)


def test_a_long_check_for_moved_cameras_is_no_slow_disk(one_camera: BoothConfig) -> None:
    check = _LongCheck(CalibrationStore.of(one_camera))
    writer = ScanWriter(one_camera, check, logging.getLogger())
    try:
        depth = np.zeros((480, 640), np.uint16)
        found = Frameset({"front-lower": LiveFrame(_HEADER, depth)}, 5.0, 0.0)
        order = Order(ScanId("a"), "", 1e9)
        writer.write(Collection(order, default_rig(), 1, 1e9, [found]))
        assert check.begun.wait(20.0)
        assert writer.stalled(time.monotonic() + 60.0) == ""
        check.end.set()
        assert _events(writer)
    finally:
        check.end.set()
        writer.close()


class _Prepared(DriftWatch):
    """A check that notes which cameras it was prepared for."""

    def __init__(self, store: CalibrationStore) -> None:
        super().__init__(store)
        self.cameras: queue.SimpleQueue[str] = queue.SimpleQueue()

    def prepare(self, camera: CameraCalibration) -> None:
        self.cameras.put(camera.name)
        super().prepare(camera)


def test_the_check_for_moved_cameras_is_prepared_before_a_scan(one_camera: BoothConfig) -> None:
    """The first scan after a start waited for it, a second with four cameras."""
    store, rig = CalibrationStore.of(one_camera), default_rig()
    alone = {"front-lower": rig.cameras["front-lower"]}
    replace(rig, cameras=alone, reference="front-lower").save(store.in_use)
    check = _Prepared(store)
    writer = ScanWriter(one_camera, check, logging.getLogger())
    try:
        assert check.cameras.get(timeout=20.0) == "front-lower"
    finally:
        writer.close()


class _Paused(_Prepared):
    """A preparation that goes on with each camera when it is told to."""

    def __init__(self, store: CalibrationStore) -> None:
        super().__init__(store)
        self.goes_on = threading.Semaphore(0)

    def prepare(self, camera: CameraCalibration) -> None:
        super().prepare(camera)
        assert self.goes_on.acquire(timeout=20.0)


def test_an_order_waits_for_one_camera_of_the_preparation(tmp_path: Path) -> None:
    rig, path = default_rig(), tmp_path / "booth.toml"
    cameras = [
        f'[[cameras]]\nname = "{n}"\ndriver = "recorded"\nrecording = "{n}"\n' for n in rig.cameras
    ]
    path.write_text("".join(cameras))
    config = load_config(path)
    store, names = CalibrationStore.of(config), list(rig.cameras)
    rig.save(store.in_use)
    check = _Paused(store)
    writer = ScanWriter(config, check, logging.getLogger())
    try:
        assert check.cameras.get(timeout=20.0) == names[0]
        writer.begin(Order(ScanId("a"), "", 1e9))
        assert writer.stalled(time.monotonic() + 60.0) == ""
        check.goes_on.release()
        assert check.cameras.get(timeout=20.0) == names[1]
        assert [type(event) for event in writer.events()] == [Started]
        check.goes_on.release(len(names))
        assert [check.cameras.get(timeout=20.0) for _ in names[2:]] == names[2:]
    finally:
        check.goes_on.release(len(names))
        writer.close()


def test_a_disk_that_hangs_at_the_preparation_is_told(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Orders that waited for it were not told why."""
    begun, end = threading.Event(), threading.Event()

    def hanging(_: BoothConfig) -> Rig:
        begun.set()
        end.wait(20.0)
        raise OSError("it is gone")

    monkeypatch.setattr(scan_writer, "booth_rig", hanging)
    check = DriftWatch(CalibrationStore.of(one_camera))
    writer = ScanWriter(one_camera, check, logging.getLogger())
    try:
        assert begun.wait(20.0)
        assert "the spool's disk has not answered" in writer.stalled(time.monotonic() + 60.0)
    finally:
        end.set()
        writer.close()


def _events(writer: ScanWriter) -> list[Started | Ended]:
    deadline_s = time.monotonic() + 20.0
    while not (events := list(writer.events())) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return events
