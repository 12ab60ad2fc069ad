"""The watch over scans follows the calibration that is in use."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from station.calibration.detect.scene import static_view
from station.calibration.drift.watch import Doubts, DriftWatch
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.calibration.moves.motion import QUIET_M, CameraMove
from station.calibration.moves.reference import DriftReference
from station.core.errors import CalibrationError
from station.simulation.scene import default_rig

CAMERA = default_rig().cameras["front-lower"]


def _frames(depth: int) -> list[np.ndarray]:
    """A slanted wall, so that there is something to see."""
    slant = np.linspace(0, 4000, 640).astype(np.uint16)[None, :]
    return [np.broadcast_to(depth + slant, (480, 640)).astype(np.uint16)] * 3


def _move(watch: DriftWatch, depth: int) -> CameraMove:
    look = watch.look(CAMERA, _frames(depth), 1e-4)
    assert look is not None
    return look.move()


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    store = CalibrationStore(tmp_path / "calibrations", tmp_path / "calibration.json")
    for day, depth in ((1, 20000), (2, 30000)):
        session = Session.begin(store.unfinished, "2026", 0.1, default_rig().cameras)
        session.record_empty({"front-lower": static_view(_frames(depth), 1e-4)}, [])
        store.finish(replace(default_rig(), created=f"2026-11-0{day}T10:00:00Z"), {})
    return store


def test_another_calibration_brings_its_own_empty_booth(store: CalibrationStore) -> None:
    watch = DriftWatch(store)
    store.use("20261101T100000Z")
    move = _move(watch, 20000)
    assert not move.moved
    assert watch.look(default_rig().cameras["back-upper"], _frames(20000), 1e-4) is None
    move = _move(watch, 30000)
    assert move.lost or move.moved
    store.use("20261102T100000Z")
    move = _move(watch, 30000)
    assert not move.moved
    assert not move.lost


def test_what_is_prepared_is_not_prepared_by_a_scan(
    store: CalibrationStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first scan of a day waited for it, a second with four cameras."""
    store.use("20261101T100000Z")
    watch = DriftWatch(store)
    watch.prepare(CAMERA)
    watch.prepare(default_rig().cameras["back-upper"])  # nothing was stored of it
    with monkeypatch.context() as again:
        again.delattr(DriftReference, "prepare")
        assert watch.look(CAMERA, _frames(20000), 1e-4)
    store.use("20261102T100000Z")
    move = _move(watch, 30000)
    assert not move.moved


def test_images_of_another_size_are_refused(store: CalibrationStore) -> None:
    store.use("20261101T100000Z")
    watch = DriftWatch(store)
    with pytest.raises(CalibrationError, match="camera front-lower gives images of 320 x 240"):
        watch.look(CAMERA, [frame[::2, ::2] for frame in _frames(20000)], 1e-4)


def test_a_torn_scene_refuses_scans_until_it_is_whole(store: CalibrationStore) -> None:
    store.use("20261101T100000Z")
    path = store.folder / "20261101T100000Z/scene/front-lower.npz"
    whole = path.read_bytes()
    path.write_bytes(b"torn")
    watch = DriftWatch(store)
    for _ in range(2):
        with pytest.raises(
            CalibrationError, match=r"checked for moved .*front-lower.npz cannot be read"
        ):
            watch.look(CAMERA, _frames(20000), 1e-4)
    path.write_bytes(whole)
    assert watch.look(CAMERA, _frames(20000), 1e-4)


@pytest.mark.parametrize("code", [errno.EIO, errno.EACCES])
@pytest.mark.parametrize("place", ["", "20261101T100000Z", "20261101T100000Z/scene"])
def test_a_folder_that_cannot_be_read_is_not_taken_for_an_empty_one(
    store: CalibrationStore, monkeypatch: pytest.MonkeyPatch, code: int, place: str
) -> None:
    store.use("20261101T100000Z")
    watch = DriftWatch(store)
    with monkeypatch.context() as disk:
        _break(disk, store.folder / place, code)
        with pytest.raises(CalibrationError, match="could not be checked for moved cameras"):
            watch.look(CAMERA, _frames(20000), 1e-4)
    assert watch.look(CAMERA, _frames(20000), 1e-4)


def _break(disk: pytest.MonkeyPatch, folder: Path, code: int) -> None:
    """Let every look into a folder, or at what is in it, fail."""

    def failing(whole: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *rest: Any, **options: Any) -> Any:
            if isinstance(path, str | Path) and folder in (Path(path), Path(path).parent):
                raise OSError(code, os.strerror(code), str(path))
            return whole(path, *rest, **options)

        return call

    for name in ("listdir", "scandir", "stat"):
        disk.setattr(os, name, failing(getattr(os, name)))


def test_without_a_stored_scene_there_is_nothing_to_check(store: CalibrationStore) -> None:
    store.use("20261101T100000Z")
    shutil.rmtree(store.folder)
    assert DriftWatch(store).look(CAMERA, _frames(20000), 1e-4) is None


def _estimate(size: float, camera: str = "a") -> CameraMove:
    """Estimate of a camera's move forward that is ``size`` times what alarms."""
    sigma_m = 4e-4
    xi = np.array([0.0, 0.0, 0.0, 0.0, 0.0, QUIET_M + 2.0 * sigma_m * size])
    return CameraMove(camera, xi, sigma_m**2 * np.diag([1e-4] * 3 + [1.0] * 3), 1.0)


def test_a_slight_alarm_waits_for_the_next_scan() -> None:
    """Three of 102 scans by cameras that stood still were refused, each hardly above the limit."""
    doubts = Doubts()
    assert not doubts.confirmed(_estimate(1.2))
    assert not doubts.confirmed(_estimate(0.5))
    assert not doubts.confirmed(_estimate(1.2))
    assert not doubts.confirmed(_estimate(1.2, "b"))
    assert doubts.confirmed(_estimate(1.3))
    assert doubts.confirmed(_estimate(1.1))


@pytest.mark.parametrize(("slid_m", "moved"), [(0.037, False), (0.08, True)])
def test_unseen_directions_alarm_late(slid_m: float, moved: bool) -> None:
    """Edges on a bare wall that lost pixels were taken for a camera that slid along it by 37 mm."""
    variances = np.array([1e-4, 1e-4, 1e-4, 5.0, 1.0, 1.0]) ** 2 * np.array([1.0] * 3 + [1e-6] * 3)
    slid = CameraMove("a", np.array([0.0, 0.0, 0.0, slid_m, 0.0, 0.0]), np.diag(variances), 1.0)
    assert slid.moved == moved
    assert any("sideways" in words for words in slid.unseen_words())


def test_a_clear_alarm_does_not_wait() -> None:
    doubts = Doubts()
    assert doubts.confirmed(_estimate(1.6))
    assert doubts.confirmed(CameraMove("b", np.zeros(6), np.eye(6), 0.01))
    assert not doubts.confirmed(CameraMove("b", np.zeros(6), np.eye(6), 1.0))


def test_a_view_that_is_hardly_met_waits_for_the_next_scan() -> None:
    """A person and a chair near the camera left 13 % of the background; nothing had moved."""
    doubts, filled = Doubts(), CameraMove("a", np.zeros(6), np.eye(6), 0.13)
    assert not doubts.confirmed(filled)
    assert not doubts.confirmed(_estimate(0.0))
    assert not doubts.confirmed(filled)
    assert doubts.confirmed(filled)


def test_two_alarms_that_contradict_each_other_are_no_move() -> None:
    doubts = Doubts()
    assert not doubts.confirmed(_estimate(1.2))
    assert not doubts.confirmed(_estimate(-1.2))


def test_doubts_end_with_their_calibration(store: CalibrationStore) -> None:
    watch = DriftWatch(store)
    store.use("20261101T100000Z")
    watch.look(CAMERA, _frames(20000), 1e-4)
    assert not watch.confirmed(_estimate(1.2))
    store.use("20261102T100000Z")
    watch.look(CAMERA, _frames(20000), 1e-4)
    assert not watch.confirmed(_estimate(1.2))
