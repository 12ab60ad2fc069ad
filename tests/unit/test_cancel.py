"""A scan that is cancelled while it is taken, stored, or on its way to sync."""

from __future__ import annotations

import errno
import logging
import math
import os
import time
from pathlib import Path

import pytest
from sync_process import sync_of
from waiting import wait_until

from station.booth import control as control_module
from station.booth.collection import Order
from station.booth.control import ControlProcess
from station.booth.sync import SyncProcess
from station.core.config import BoothConfig
from station.core.scans import CANCELLED, ScanNote, boot_id, scan_id_of
from station.core.spool import Spool
from station.messaging.messages import Reply, Request


def test_a_scan_that_is_being_stored_is_told_as_such(one_camera: BoothConfig) -> None:
    """It was said not to be taken, while status had it."""
    with sync_of(one_camera) as sync:
        scan_id = scan_id_of("one")
        sync._writing[scan_id] = Order(scan_id, "", math.inf)
        reply = sync._cancel(scan_id)
        assert (reply.ok, reply.error) == (
            False,
            "scan one is being stored: it is too late to cancel",
        )


@pytest.mark.parametrize("late", [False, True])
def test_a_cancel_that_overtakes_its_order_cancels_it(one_camera: BoothConfig, late: bool) -> None:
    """While sync restarted, the operator was told that the scan was not being taken; then it was
    taken, or said to have failed because its order came late."""
    later_s = time.monotonic() + 60.0
    comes_s = 1.0 if late else later_s
    notes = Spool(one_camera.spool.folder).notes
    with sync_of(one_camera) as sync:
        scan_id = scan_id_of("one")
        notes.write(
            ScanNote(scan_id, "armed", valid_until_s=later_s, boot=boot_id()), durable=False
        )
        assert not sync._reply(Request("cancel", scan_id)).ok
        assert sync._reply(Request("cancel", scan_id, valid_until_s=later_s)).ok
        assert sync._reply(Request("scan", scan_id, valid_until_s=comes_s)).ok
        # The writer tells of it a moment after the note.
        wait_until(lambda: _told(sync), "the end of the scan")
        note = notes.read(scan_id)
        assert note is not None
        assert (note.stage, note.reason) == ("failed", CANCELLED)
        # It has ended: no order of it comes.
        assert not sync._reply(Request("cancel", scan_id, valid_until_s=later_s)).ok
        assert sync._cancelled == set()


def _told(sync: SyncProcess) -> bool:
    """Whether sync has heard of the end of all scans that were cancelled."""
    for event in sync._writer.events():
        sync._handle(event)
    return not sync._cancelled


def test_a_disk_that_cannot_be_read_is_not_in_the_way(
    one_camera: BoothConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sync, which has the scan, was not asked."""

    def torn(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    asked: list[Request] = []

    def sync_answers(_: Path, __: str, request: Request, ___: float) -> Reply:
        asked.append(request)
        return Reply(ok=True)

    control = ControlProcess(one_camera, tmp_path / "booth.toml", logging.getLogger("control"))
    monkeypatch.setattr(control_module, "ask", sync_answers)
    monkeypatch.setattr(control._spool.notes, "read", torn)
    try:
        reply = control._reply(Request("cancel", "one"))
    finally:
        control._context.destroy(linger=0)
    assert (reply.ok, reply.content["reason"]) == (True, CANCELLED)
    assert [(request.command, request.scan_id) for request in asked] == [("cancel", "one")]
