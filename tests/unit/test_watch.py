"""The watch over scans follows the calibration that is in use."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from station.calibration.detect.scene import static_view
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.core.errors import CalibrationError
from station.simulation.scene import default_rig

CAMERA = default_rig().cameras["front-lower"]


def _frames(depth: int) -> list[np.ndarray]:
    """A slanted wall, so that there is something to see."""
    slant = np.linspace(0, 4000, 640).astype(np.uint16)[None, :]
    return [np.broadcast_to(depth + slant, (480, 640)).astype(np.uint16)] * 3


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    store = CalibrationStore(tmp_path / "calibrations", tmp_path / "calibration.json")
    for day, depth in ((1, 20000), (2, 30000)):
        session = Session.begin(store.unfinished, "2026", 0.1, default_rig().cameras)
        session.keep_empty({"front-lower": static_view(_frames(depth), 1e-4)}, [])
        store.finish(replace(default_rig(), created=f"2026-11-0{day}T10:00:00Z"), {})
    return store


def test_another_calibration_brings_its_own_empty_booth(store: CalibrationStore) -> None:
    watch = DriftWatch(store, logging.getLogger())
    store.use("20261101T100000Z")
    [move] = watch.moves(CAMERA, _frames(20000), 1e-4)
    assert not move.moved
    assert watch.moves(default_rig().cameras["back-upper"], _frames(20000), 1e-4) == []
    [move] = watch.moves(CAMERA, _frames(30000), 1e-4)
    assert move.lost or move.moved
    store.use("20261102T100000Z")
    [move] = watch.moves(CAMERA, _frames(30000), 1e-4)
    assert not move.moved
    assert not move.lost


def test_images_of_another_size_are_refused(store: CalibrationStore) -> None:
    store.use("20261101T100000Z")
    watch = DriftWatch(store, logging.getLogger())
    with pytest.raises(CalibrationError, match="camera front-lower gives images of 320 x 240"):
        watch.moves(CAMERA, [frame[::2, ::2] for frame in _frames(20000)], 1e-4)


def test_a_torn_scene_is_told_and_scans_go_on(
    store: CalibrationStore, caplog: pytest.LogCaptureFixture
) -> None:
    store.use("20261101T100000Z")
    path = store.folder / "20261101T100000Z/scene/front-lower.npz"
    path.write_bytes(b"torn")
    watch = DriftWatch(store, logging.getLogger())
    assert watch.moves(CAMERA, _frames(20000), 1e-4) == []
    assert "front-lower.npz cannot be read" in caplog.text
    shutil.rmtree(store.folder)
    assert DriftWatch(store, logging.getLogger()).moves(CAMERA, _frames(20000), 1e-4) == []
