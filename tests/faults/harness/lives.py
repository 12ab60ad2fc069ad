"""Lives that are cut at each of their file calls: a scan, a result, a calibration.

A life does as the real processes do, with their own functions. It can be begun again at any point:
a process that finds what another left behind goes on from there.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from station.calibration.detect.detections import BallDetection
from station.calibration.detect.scene import StaticView
from station.calibration.detect.step_names import EMPTY, FRONT, MARK
from station.calibration.guide.seen import Lens
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.core.bundle import CapturedFrame, read_bundle, write_bundle
from station.core.errors import FormatError
from station.core.rig import Rig
from station.core.scans import ScanId, ScanNote
from station.core.spool import Claim, Spool
from station.simulation.scene import default_rig
from workers.reconstruct.pool import CAMERAS, keep_evidence

SCAN = ScanId("20260101T000000Z-0001")
RETRIES = 2


@lru_cache
def _rig() -> Rig:
    return default_rig()


def scan(folder: Path, write_result: Callable[[Path], None]) -> None:
    """A scan's life: order, bundle, claim, result, delivery, evidence about the cameras."""
    spool = Spool(folder / "spool")
    if spool.notes.read(SCAN) is None and spool.where(SCAN) is None:
        spool.notes.write(ScanNote(SCAN, "armed"), durable=False)
    if spool.where(SCAN) is None and spool.note(SCAN).stage in ("armed", "capturing"):
        submit(spool)
    spool.recover(RETRIES)
    while (claim := spool.claim()) is not None:
        result = spool.temporary(SCAN)
        result.mkdir()
        try:
            write_result(result)
            claim.deliver(result, "ok")
            keep_evidence({"format": "booth-camera-evidence"}, spool.folder / CAMERAS)
        except OSError:
            claim.release()
            raise


def submit(spool: Spool) -> None:
    """Take a scan of one frame of each camera, as sync does."""
    spool.notes.write(ScanNote(SCAN, "capturing"), durable=False)
    bundle = spool.temporary(SCAN)
    depth = np.full((480, 640), 2000, np.uint16)
    write_bundle(
        bundle, scan_id=SCAN, created="2026-01-01T00:00:00Z", label="", depth_scale_m=1e-3,
        rig=_rig(), spread_s_max=0.001,
        frames={name: [CapturedFrame(depth, 7, 6e7, 5.0, 1)] for name in _rig().cameras},
    )  # fmt: skip
    spool.submit(bundle, SCAN)


def deliver_small(claim: Claim) -> None:
    """Deliver a result of two files."""
    result = claim.spool.temporary(SCAN)
    result.mkdir()
    small_result(result)
    claim.deliver(result, "ok")


def small_result(folder: Path) -> None:
    """Two files in the place of a body's nine."""
    for name in ("mesh.ply", "result.json"):
        (folder / name).write_text("whole" * 50)


def real_result() -> Callable[[Path], None]:
    """The function that writes a body's result, with a body that is fitted now."""
    from workers.export.origin import Origin
    from workers.export.result import write_result
    from workers.export.stopwatch import Stopwatch
    from workers.reconstruct import job

    kept: list[Any] = []

    def keep(_: Path, *content: Any) -> None:
        kept.append(content)

    model = job.warm_up()
    with mock.patch.object(job, "write_result", keep):
        job.reconstruct_cloud(job._mean_cloud(model), SCAN, Path("unused"), model=model)
    model, fit, surface, picture, measured, standing, _, method, _ = kept[0]

    def write(folder: Path) -> None:
        write_result(
            folder, model, fit, surface, picture, measured, standing, Origin(SCAN), method,
            Stopwatch(),
        )  # fmt: skip

    return write


def delivered(folder: Path) -> int:
    """Results in the outbox, moved away as the fitting room does; torn ones count 100."""
    room = folder / "room"
    room.mkdir(exist_ok=True)
    taken = 0
    for result in (folder / "spool/outbox").glob("*"):
        taken += 1 if _whole(result) else 100
        shutil.move(result, room / f"{result.name}.{len(list(room.iterdir()))}")
    return taken


def _whole(result: Path) -> bool:
    try:
        if (result / "mesh.obj").exists():
            document = json.loads((result / "result.json").read_text())
            return all((result / name).stat().st_size for name in document["files"])
        names = {path.name: path.read_text() for path in result.iterdir()}
    except (OSError, ValueError, KeyError):
        return False
    return len(names) == 2 and all(text == "whole" * 50 for text in names.values())


def whole_results(folder: Path) -> bool:
    """Whether all results in the outbox are whole."""
    return all(map(_whole, (folder / "spool/outbox").glob("*")))


def kept_bundles(folder: Path) -> int:
    """Whole bundles under a final name; torn ones count 100."""
    count = 0
    for state in ("queue", "work", "done", "failed"):
        for bundle in (folder / "spool" / state).glob("*"):
            try:
                read = read_bundle(bundle)
                for camera, frames in read.frames.items():
                    read.read_frame(camera, frames[0])
                count += 1
            except FormatError:
                count += 100
    return count


_RUNS = 3
_AROUND = ("around-0", "around-1")
_SEEN_BY = "front-lower"


def calibration(folder: Path) -> None:
    """A calibration's life: begun, seen step by step, finished, put into use."""
    store = CalibrationStore(folder / "calibrations", folder / "calibration.json")
    with store.locked():
        if store.newest() is None:
            session = _session(store)
            _see(session)
            rig = replace(_rig(), created="2026-01-02T00:00:00Z")
            store.finish(rig, {"note": "whole"})
        newest = store.newest()
        assert newest is not None
        store.use(newest)


def _session(store: CalibrationStore) -> Session:
    try:
        return Session.load(store.unfinished)
    except FormatError:
        store.abandon()
        return Session.begin(store.unfinished, "2026-01-02T00:00:00Z", 0.1, _rig().cameras)


def _see(session: Session) -> None:
    if not session.done(EMPTY):
        session.record_empty(dict.fromkeys(_rig().cameras, _view()), [])
    while session.runs < _RUNS:
        session.begin_run()
        session.record_balls([_ball(float(index)) for index in range(5)])
    for step in (MARK, FRONT, *_AROUND):
        if not (session.done(step) if step in (MARK, FRONT) else step in session.around):
            session.record_resting(step, [_ball(0.0)])
    if not session.lenses:
        camera = _rig().cameras[_SEEN_BY]
        lens = Lens(camera.K.tolist(), camera.distortion.tolist())
        session.record_lenses({_SEEN_BY: lens})


def _view() -> StaticView:
    image = np.ones((12, 16), np.float32)
    return StaticView(image, image, 0.01 * image, 0.01 * image, 30)


def _ball(time_s: float) -> BallDetection:
    covariance = np.eye(3) * 1e-6
    return BallDetection(
        _SEEN_BY, time_s, np.array([0.0, 0.0, 2.0]), covariance, 500, 0.1, 1e-3, np.ones((3, 4))
    )


def calibrated(folder: Path) -> bool:
    """Whether the booth's calibration can be read, and so can all that was stored or seen."""
    store = CalibrationStore(folder / "calibrations", folder / "calibration.json")
    try:
        Rig.load(store.in_use)
        for path in store.folder.glob(f"*/{store.in_use.name}"):
            Rig.load(path)
        if (store.unfinished / "session.json").exists():
            Session.load(store.unfinished)
    except FormatError:
        return False
    return True


def finished(folder: Path) -> bool:
    """Whether the new calibration is stored once, whole, and in use."""
    store = CalibrationStore(folder / "calibrations", folder / "calibration.json")
    found = [entry for entry in store.entries() if not entry.name.endswith("-found")]
    if len(found) != 1 or not found[0].in_use:
        return False
    seen = Session.load(found[0].folder)
    views = all(seen.background(camera) for camera in seen.cameras)
    around = views and set(_AROUND) <= seen.around.keys() and _SEEN_BY in seen.lenses
    return (
        around
        and seen.done(MARK)
        and seen.done(FRONT)
        and len(seen.balls) >= 5
        and seen.runs >= _RUNS
    )


def first_calibration(folder: Path) -> None:
    """The calibration that the booth had before."""
    _rig().save(folder / "calibration.json")
