"""Folders and cameras as the console watches them, and the answers it passes on."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
import zmq
from waiting import wait_until

from station.archive import index
from station.archive.compare import compare_surfaces
from station.archive.index import ScanIndex
from station.archive.records import PLACES, ScanRecord
from station.archive.surfaces import _FACE
from station.booth.deletion import purge_scans
from station.booth.health import booth_health
from station.booth.retention import Deleted
from station.console.live import watch as watch_module
from station.console.live.cameras import Pictures
from station.console.live.control import NotRunningError
from station.console.live.events import EventLog
from station.console.live.folders import FolderChanges
from station.console.live.tasks import Tasks
from station.console.live.watch import Watch
from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.scans import CANCELLED, ScanId, ScanNote, scan_id_of
from station.core.spool import Spool
from station.messaging.asking import RefusedError
from station.messaging.messages import CameraHealth, FrameHeader
from station.messaging.transport import publisher
from station.simulation.scene import default_rig


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[tuple[Watch, EventLog]]:
    (tmp_path / "booth.toml").write_text(
        '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
    )
    config = load_config(tmp_path / "booth.toml")
    events = EventLog()
    watching = Watch(config, events, logging.getLogger())
    watching.start()
    yield watching, events
    watching.close()


def _states(events: EventLog) -> list[str]:
    return [json.loads(e.data)["state"] for e in events.after(0) if e.kind == "camera"]


def test_changes_of_folders_are_told(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "away").mkdir()
    changes = FolderChanges([tmp_path / "here", tmp_path / "missing"])
    assert not changes.any()
    (tmp_path / "away/result").mkdir()
    assert not changes.any()
    (tmp_path / "away/result").rename(tmp_path / "here/result")
    assert changes.any()
    assert not changes.any()
    (tmp_path / "here/result").rmdir()
    assert changes.any()
    changes.close()


def test_a_cancelled_scan_does_not_count_as_failed(
    watch: tuple[Watch, EventLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    watching, _ = watch
    spool = Spool(watching._config.spool.folder)
    for scan_id in ("a", "b", "c"):
        bundle = spool.temporary(scan_id)
        bundle.mkdir()
        spool.submit(bundle, scan_id)
    assert spool.withdraw(scan_id_of("a"), CANCELLED)
    assert spool.withdraw(scan_id_of("b"), "the bundle is torn")

    def told(*_: object) -> dict[str, Any]:
        return {**asdict(booth_health(watching._config)), "streaming": True}

    monkeypatch.setattr(watch_module, "command", told)

    def counts() -> tuple[int, int, int]:
        booth = watching.booth()
        return booth["failed"], booth["cancelled"], booth["spool"]["failed"]

    wait_until(lambda: counts() == (1, 1, 2))


@pytest.mark.parametrize(
    ("driver", "remedy"),
    [
        ('"recorded"\nrecording = "a"', "check the recording"),
        ('"freenect"\nserial = "A1"', "unplug the camera's USB cable for five seconds"),
    ],
)
def test_the_remedy_for_a_dead_camera_is_one_it_can_have(
    tmp_path: Path, driver: str, remedy: str
) -> None:
    """A recording was to be unplugged."""
    path = tmp_path / "booth.toml"
    path.write_text(f'[[cameras]]\nname = "a"\ndriver = {driver}\n')
    watching = Watch(load_config(path), EventLog(), logging.getLogger())
    watching._set_dead(watching._cameras["a"])
    told = watching.booth()["cameras"][0]["detail"]
    assert told.endswith(f"restarted automatically; if this persists, {remedy}")


def _small_body(result: Path) -> Path:
    """A result with a mesh of a small sphere."""
    result.mkdir()
    mesh = open3d.geometry.TriangleMesh.create_sphere(0.2, 6)
    vertices = np.asarray(mesh.vertices, "<f4")
    faces = np.zeros(len(mesh.triangles), _FACE)
    faces["count"], faces["corners"] = 3, np.asarray(mesh.triangles)
    head = f"ply\nelement vertex {len(vertices)}\nelement face {len(faces)}\nend_header\n"
    (result / "mesh.ply").write_bytes(head.encode() + vertices.tobytes() + faces.tobytes())
    return result


def test_no_distances_of_a_deleted_body_are_kept(watch: tuple[Watch, EventLog]) -> None:
    watching, _ = watch
    spool = Spool(watching._config.spool.folder)
    first, second = (_small_body(spool.path("outbox", name)) for name in ("a", "b"))
    time.sleep(1.5)  # the watch looks again at folders that have just changed
    wait_until(
        lambda: (
            compare_surfaces(first, second).rms_m < 1e-6 and compare_surfaces.cache_info().hits > 0
        )
    )
    purge_scans(spool, ["a"], Deleted())
    wait_until(lambda: compare_surfaces.cache_info().currsize == 0)


def test_a_clock_that_was_put_back_lets_the_watch_rest(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All scans were listed ten times a second until the clock had caught up."""
    spool, looks = Spool(one_camera.spool.folder), list[str]()
    find, names = ScanIndex.find, index._names

    def found(self: ScanIndex, **options: Any) -> list[ScanRecord]:
        looks.append("index")
        return find(self, **options)

    def named(folder: Path) -> list[ScanId]:
        looks.append("folder")
        return names(folder)

    monkeypatch.setattr(ScanIndex, "find", found)
    monkeypatch.setattr(index, "_names", named)
    watching = Watch(one_camera, EventLog(), logging.getLogger())
    for place in PLACES:
        os.utime(spool.folder / place, times=2 * (time.time() + 3600.0,))
    watching._watch_spool(False)
    assert set(looks) == {"index", "folder"}
    looks.clear()
    watching._watch_spool(False)
    assert looks == []
    watching._watch_spool(True)
    assert looks == ["index"]
    spool.path("failed", "a").mkdir()
    watching._watch_spool(False)
    assert set(watching._seen or {}) == {"a"}


def test_a_result_that_is_taken_away_is_not_said_to_be_deleted(
    watch: tuple[Watch, EventLog],
) -> None:
    """The page lost the outcome of a scan as soon as a program had collected its result."""
    watching, events = watch
    spool = Spool(watching._config.spool.folder)
    for scan_id in (ScanId("a"), ScanId("b")):
        spool.path("outbox", scan_id).mkdir()
        spool.notes.write(ScanNote(scan_id, "delivered"), durable=False)
    wait_until(lambda: set(watching._seen or {}) == {"a", "b"})
    spool.path("outbox", "a").rmdir()
    purge_scans(spool, ["b"], Deleted())

    def told() -> dict[str, str]:
        scans = [json.loads(event.data) for event in events.after(0) if event.kind == "scan"]
        return {scan["scan_id"]: scan["state"] for scan in scans}

    wait_until(lambda: told() == {"a": "taken", "b": "deleted"})


def test_what_status_says_is_said_by_the_console(
    watch: tuple[Watch, EventLog], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page showed a healthy booth while every scan was refused."""
    watching, _ = watch
    assert (watching.booth()["problems"], watching.booth()["can_scan"]) == ([], False)

    def answered(problems: Sequence[str], **sync: Any) -> Callable[..., Any]:
        processes = {"control": {"age_s": 0.1}, "workers": {"age_s": 0.1, "compiling": True}}
        told = {"streaming": True, "processes": processes, "free_bytes": 1e12}
        return lambda *_: {**told, "sync": {"silent": [], **sync}, "problems": problems}

    def booth() -> tuple[list[str], bool]:
        told = watching.booth()
        return told["problems"], told["can_scan"]

    words = "the booth is not calibrated, and takes no scans: run station calibrate"
    monkeypatch.setattr(watch_module, "command", answered([words]))
    wait_until(lambda: booth() == ([words], False))
    default_rig().save(watching._config.calibration)
    [camera] = watching._config.cameras
    cameras = [camera.model_copy(update={"name": name}) for name in default_rig().cameras]
    config = watching._config.model_copy(update={"cameras": cameras})
    monkeypatch.setattr(watching, "_config", config)
    monkeypatch.setattr(watch_module, "command", answered([]))
    wait_until(lambda: booth() == ([], True))
    monkeypatch.setattr(watch_module, "command", answered(["camera a: torn"], silent=["a"]))
    wait_until(lambda: booth() == (["camera a: torn"], False))
    assert watching.booth()["compiling"]

    def silent(*_: object) -> None:
        raise NotRunningError("nothing runs")

    monkeypatch.setattr(watch_module, "command", silent)
    wait_until(lambda: booth() == ([], False) and not watching.booth()["compiling"])


def test_the_death_of_a_camera_is_told_once(watch: tuple[Watch, EventLog]) -> None:
    """It hangs, is given up as silent, and its socket closes when it is killed for it."""
    watching, events = watch
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = publisher(context, watching._config.runtime.folder, "camera-a", "health")
    health = CameraHealth("a", "streaming", "", 1, 0, 0)

    def reports() -> bool:
        socket.send_multipart([b"health", health.pack()])
        return "streaming" in _states(events)

    wait_until(reports)
    wait_until(lambda: _states(events)[-1] == "dead")
    context.destroy(linger=0)
    time.sleep(2.0)
    assert _states(events) == ["streaming", "dead"]


_ASKS = """
import json, sys
print(json.dumps({"kind": "height", "text": "how high?"}), flush=True)
print(json.dumps({"kind": "done", "text": sys.stdin.readline().strip()}), flush=True)
"""


def test_a_height_is_answered_by_a_number(tmp_path: Path) -> None:
    tasks = Tasks(tmp_path / "booth.toml", EventLog())
    with pytest.raises(RefusedError, match="nothing is waiting"):
        tasks.answer("1.7")
    tasks._begin("calibrate", "stand", [sys.executable, "-c", _ASKS])
    wait_until(lambda: bool(tasks.state()["waits_for"]))
    assert tasks.state()["question"] == "how high?"
    for word in ("go", "yes"):
        with pytest.raises(RefusedError, match="no answer"):
            tasks.answer(word)
    tasks.answer("1.7")
    wait_until(lambda: not tasks.state()["running"])
    assert tasks.state()["lines"] == ["1.7"]


_TWO_STEPS = """
import json, sys
def say(**words): print(json.dumps(words), flush=True)
say(kind="step", title="Ball", text="", waits=False)
say(kind="line", text="more positions would help")
say(kind="step", title="Ball on the mark", text="", waits=True)
sys.stdin.readline()
say(kind="done", text="the ball at rest is seen by front-lower")
"""


def test_what_a_step_complained_of_is_not_said_of_the_next(tmp_path: Path) -> None:
    tasks = Tasks(tmp_path / "booth.toml", EventLog())
    tasks._begin("calibrate", "all", [sys.executable, "-c", _TWO_STEPS])
    wait_until(lambda: bool(tasks.state()["waits_for"]))
    assert tasks.state()["lines"] == ["more positions would help"]
    assert tasks.state()["step_lines"] == 0
    tasks.answer("go")
    wait_until(lambda: not tasks.state()["running"])
    assert (len(tasks.state()["lines"]), tasks.state()["step_lines"]) == (2, 1)


def test_a_task_outlives_the_thread_of_its_request(tmp_path: Path) -> None:
    tasks = Tasks(tmp_path / "booth.toml", EventLog())
    command = [sys.executable, "-c", _ASKS]
    request = threading.Thread(target=lambda: tasks._begin("calibrate", "stand", command))
    request.start()
    request.join()
    wait_until(lambda: bool(tasks.state()["waits_for"]))
    tasks.answer("1.7")
    wait_until(lambda: not tasks.state()["running"])
    assert tasks.state()["lines"] == ["1.7"]


def test_a_task_that_complains_at_length_ends(tmp_path: Path) -> None:
    """Nobody read its complaints before its end, and it waited for that for ever."""
    script = "import sys; sys.stderr.write(100_000 * 'oh, ' + '\\nerror: no ball\\n'); sys.exit(1)"
    tasks = Tasks(tmp_path / "booth.toml", EventLog())
    tasks._begin("calibrate", "ball", [sys.executable, "-c", script])
    wait_until(lambda: not tasks.state()["running"])
    assert tasks.state()["error"] == "no ball"


def test_bytes_that_are_no_text_end_no_task(tmp_path: Path) -> None:
    """It was in progress for ever, and no other one could begin."""
    script = "import sys; sys.stdout.buffer.write(b'\\xff\\n')"
    tasks = Tasks(tmp_path / "booth.toml", EventLog())
    for _ in range(2):
        tasks._begin("calibrate", "ball", [sys.executable, "-c", script])
        wait_until(lambda: not tasks.state()["running"])


def test_an_answer_to_a_task_that_has_just_died_is_refused(tmp_path: Path) -> None:
    script = _ASKS.partition('print(json.dumps({"kind": "done"')[0]
    hangs = "import os, time; os.close(0); time.sleep(60)"
    tasks = Tasks(tmp_path / "booth.toml", EventLog())
    tasks._begin("calibrate", "stand", [sys.executable, "-c", script + hangs])
    wait_until(lambda: bool(tasks.state()["waits_for"]))
    wait_until(lambda: _refuses(tasks))
    tasks.close()
    wait_until(lambda: not tasks.state()["running"])


def _refuses(tasks: Tasks) -> bool:
    tasks._state["waits_for"] = "height"
    try:
        tasks.answer("1.7")
    except RefusedError as error:
        return "nothing is waiting" in str(error)
    return False


class _Torn(Pictures):
    """Pictures of frames that are all torn."""

    def _packed(self, newest: dict[str, list[zmq.Frame]]) -> bytes:  # noqa: ARG002
        raise ValueError("torn")


def test_a_bad_frame_is_not_told_again_when_nobody_looks(
    one_camera: BoothConfig, caplog: pytest.LogCaptureFixture
) -> None:
    """Whoever had asked and left was waited for, with a line in the log each second."""
    pictures = _Torn(one_camera, logging.getLogger())

    async def leave() -> None:
        asked = asyncio.create_task(pictures.next())
        await asyncio.sleep(0)
        asked.cancel()
        with suppress(asyncio.CancelledError):
            await asked

    asyncio.run(leave())
    pictures.start()
    try:
        wait_until(lambda: "depth pictures: torn" in caplog.text)
        assert not pictures._wanted.is_set()
    finally:
        pictures.close()


def test_a_bad_frame_costs_a_viewer_no_more_than_that_picture(
    one_camera: BoothConfig, caplog: pytest.LogCaptureFixture
) -> None:
    """Whoever had asked for it waited for a minute, and was disconnected."""
    header = FrameHeader("front-lower", "V1", 64, 48, 1e-3, 7, 6e7, 5.0, 5.0, 1, 0)
    pictures = Pictures(one_camera, logging.getLogger())
    pictures.start()

    async def picture(camera: zmq.Socket[bytes]) -> bytes:
        asked, told = asyncio.create_task(pictures.next()), False
        deadline_s = time.monotonic() + 30.0
        while not (told and asked.done()) and time.monotonic() < deadline_s:
            told = "depth pictures" in caplog.text
            if asked.done() and not told:
                asked = asyncio.create_task(pictures.next())
            depth = np.full(48 * 64 if told else 7, 1500, np.uint16)
            camera.send_multipart([b"depth/front-lower", header.pack(), depth.tobytes()])
            await asyncio.sleep(0.02)
        return await asyncio.wait_for(asked, 1.0)

    with zmq.Context() as context:
        camera = publisher(context, one_camera.runtime.folder, "camera-front-lower", "depth")
        try:
            assert b"front-lower" in asyncio.run(picture(camera))
        finally:
            camera.close()
            pictures.close()
    assert "depth pictures" in caplog.text
