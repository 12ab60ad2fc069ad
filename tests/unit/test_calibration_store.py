"""Dated calibrations: none is lost, none is overwritten."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from seen_balls import CAMERAS, ball

from station.calibration.detect.scene import StaticView, static_view
from station.calibration.detect.step_names import EMPTY
from station.calibration.drift.watch import DriftWatch
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.core.errors import CalibrationError
from station.core.rig import Rig
from station.simulation.scene import default_rig

STARTED = "2026-11-21T10:00:00Z"


def _rig(day: int) -> Rig:
    return replace(default_rig(), created=f"2026-11-{day:02d}T10:00:00Z")


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    return CalibrationStore(tmp_path / "calibrations", tmp_path / "calibration.json")


def _finished(store: CalibrationStore, day: int) -> str:
    session = Session.begin(store.unfinished, STARTED, 0.1, CAMERAS)
    frames = [np.full((480, 640), 20000 + day, np.uint16)] * 2
    session.record_empty({"front-lower": static_view(frames, 1e-4)}, [])
    return store.finish(_rig(day), {"day": day}).name


def test_each_calibration_has_its_folder_and_one_is_in_use(store: CalibrationStore) -> None:
    names = [_finished(store, day) for day in (1, 2)]
    assert names == ["20261101T100000Z", "20261102T100000Z"]
    assert not store.unfinished.exists()
    assert not any(entry.in_use for entry in store.entries())
    store.use(names[1])
    assert Rig.load(store.in_use).created == "2026-11-02T10:00:00Z"
    store.use(names[0])
    assert Rig.load(store.in_use).created == "2026-11-01T10:00:00Z"
    assert [entry.in_use for entry in store.entries()] == [True, False]
    assert json.loads((store.folder / names[1] / "report.json").read_text()) == {"day": 2}
    assert store.scene()["front-lower"].depth_m()[0, 0] == pytest.approx(2.0001)
    with pytest.raises(CalibrationError, match=r"no calibration 1999.*20261101T100000Z, 2026"):
        store.use("1999")


def test_a_damaged_calibration_does_not_hide_the_others(
    store: CalibrationStore, caplog: pytest.LogCaptureFixture
) -> None:
    names = [_finished(store, day) for day in (1, 2, 3)]
    (store.folder / names[1] / "calibration.json").write_text("{")
    assert [entry.name for entry in store.entries()] == [names[0], names[2]]
    (told,) = caplog.messages
    assert f"{names[1]}  cannot be used: " in told
    assert "calibration.json cannot be read as JSON" in told


def test_a_calibration_of_the_same_second_is_not_overwritten(store: CalibrationStore) -> None:
    _finished(store, 1)
    Session.begin(store.unfinished, STARTED, 0.1, CAMERAS)
    with pytest.raises(CalibrationError, match="exists already"):
        store.finish(_rig(1), {})
    assert (store.unfinished / "session.json").exists()


def test_a_file_from_elsewhere_is_kept_when_another_is_put_into_use(
    store: CalibrationStore,
) -> None:
    """A calibration.json made by hand was once replaced for good."""
    found = replace(default_rig(), created="2020-01-01T00:00:00Z")
    found.save(store.in_use)
    name = _finished(store, 1)
    store.use(name)
    store.use(name)
    kept = [entry for entry in store.entries() if entry.name.startswith("20200101")]
    assert [entry.name for entry in kept] == ["20200101T000000Z-found"]
    assert kept[0].rig.created == "2020-01-01T00:00:00Z"
    store.use("20200101T000000Z-found")
    assert store.scene() == {}


def test_a_scan_is_not_compared_with_the_booth_of_another_calibration(
    store: CalibrationStore,
) -> None:
    """A calibration that was put into use between two reads of one scan checked its own views with
    the camera of the one before: this scan's, and all that followed."""
    names = [_finished(store, day) for day in (1, 2)]
    camera = _rig(1).cameras["front-lower"]
    moved = replace(camera, K=camera.K * np.array([[1.01], [1.01], [1.0]]))
    cameras = {**_rig(2).cameras, "front-lower": moved}
    replace(_rig(2), cameras=cameras).save(store.folder / names[1] / "calibration.json")
    store.use(names[0])
    watch = DriftWatch(store)
    watch.prepare(camera)
    store.use(names[1])
    with pytest.raises(CalibrationError, match="another calibration was put into use"):
        watch.look(camera, [np.full((480, 640), 20002, np.uint16)] * 2, 1e-4)
    watch.prepare(moved)


def test_a_calibration_that_is_put_into_use_while_another_is_read_is_noticed(
    store: CalibrationStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [_finished(store, day) for day in (1, 2)]
    store.use(names[0])
    scene = CalibrationStore.scene

    def late(self: CalibrationStore) -> dict[str, StaticView]:
        self.use(names[1])
        return scene(self)

    monkeypatch.setattr(CalibrationStore, "scene", late)
    with pytest.raises(CalibrationError, match="another calibration was put into use"):
        DriftWatch(store).prepare(_rig(1).cameras["front-lower"])


def test_two_do_not_calibrate_at_once(store: CalibrationStore) -> None:
    """Two runs once wrote into one journal, and both waved their own ball."""
    other = CalibrationStore(store.folder, store.in_use)
    with store.locked():
        with pytest.raises(CalibrationError, match="another station calibrate"), other.locked():
            pass
        assert store.entries() == []
    with other.locked():
        pass


def test_an_abandoned_calibration_is_kept(store: CalibrationStore) -> None:
    assert store.abandon() is None
    for number in (1, 2):
        Session.begin(store.unfinished, STARTED, 0.1, CAMERAS)
        assert store.abandon() == store.folder / f"abandoned-{number}"
    assert store.entries() == []


def test_the_calibration_in_use_is_taken_up_again_for_further_steps(
    store: CalibrationStore,
) -> None:
    """A step that was advised after a success began a new calibration without saying so."""
    assert store.resumable() is None
    used, later = (_finished(store, day) for day in (1, 2))
    store.use(used)
    assert store.resumable() == used
    # What a process left that was killed meanwhile, or while it began a calibration.
    for left in (".unfinished.77", "unfinished"):
        (store.folder / left / "scene").mkdir(parents=True)
        (store.folder / left / "scene" / "ghost.npz").touch()
    again = store.reopen(used)
    assert again.adds_to == used
    # Else it was said that what had been taken up a moment ago was as old as the one in use.
    assert again.started != STARTED
    assert not list(store.folder.rglob(".unfinished*"))
    assert [path.name for path in (store.unfinished / "scene").iterdir()] == ["front-lower.npz"]
    assert again.done(EMPTY)
    assert again.background("front-lower") is not None
    again.record_resting("around-0", [ball("front-lower", 1.0)])
    assert store.finish(_rig(3), {}).name == "20261103T100000Z"
    assert not Session.load(store.folder / used).around
    assert {entry.name for entry in store.entries()} == {used, later, "20261103T100000Z"}
