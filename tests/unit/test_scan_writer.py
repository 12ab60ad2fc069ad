"""The thread that writes scans keeps nothing of a scan once it has its outcome."""

from __future__ import annotations

import logging
import time
import weakref

import numpy as np

from station.booth.collection import Collection, Order
from station.booth.frameset import Frameset
from station.booth.scan_writer import Ended, ScanWriter, Started
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.store import CalibrationStore
from station.core.config import BoothConfig
from station.core.scans import ScanId
from station.messaging.intake import LiveFrame
from station.messaging.messages import FrameHeader
from station.simulation.scene import default_rig

_HEADER = FrameHeader("front-lower", "V1", 640, 480, 1e-4, 7, 6e7, 5.0, 5.0, 1, 0)


def test_frames_of_a_finished_scan_leave_the_memory(one_camera: BoothConfig) -> None:
    store = CalibrationStore(one_camera.calibrate.folder, one_camera.calibration)
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
        deadline_s = time.monotonic() + 20.0
        while kept() is not None and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert kept() is None
    finally:
        writer.close()


def _events(writer: ScanWriter) -> list[Started | Ended]:
    deadline_s = time.monotonic() + 20.0
    while not (events := list(writer.events())) and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return events
