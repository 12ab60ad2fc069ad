"""Messages to the operator when a camera is not as it should be."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zmq
from live_console import free_port
from running_station import Station

from station.booth.health import booth_health
from station.booth.supervisor import services
from station.core.config_file import load_config
from station.core.errors import BoothError, DriverError
from station.core.files import held, private_folder
from station.core.service import read_health
from station.core.spool import Spool
from station.messaging.messages import CameraHealth, DesiredState
from station.messaging.transport import publisher, subscriber
from station.sensors.freenect import LIBRARY_VARIABLE, FreenectCamera, FreenectDriver
from station.sensors.registry import make_driver

STATION = (sys.executable, "-m", "station.cli")


def _recorded(text: str) -> str:
    return text.replace('"freenect"', '"recorded"')


def test_a_camera_that_goes_silent_is_named_within_a_second(
    make_station: Callable[..., Station],
) -> None:
    station = make_station("[workers]\ncount = 0", _recorded)
    assert station.command("start").returncode == 0
    victim = station.pids("capture", "back-lower")[0]
    os.kill(victim, signal.SIGSTOP)
    time.sleep(1.6)
    status = json.loads(station.command("status", "--json").stdout)
    refused = station.command("scan")
    # On a busy machine the station has ended it meanwhile, as a process that hangs.
    with contextlib.suppress(ProcessLookupError):
        os.kill(victim, signal.SIGCONT)
    assert status["sync"]["silent"] == ["back-lower"]
    rates = {name: camera["rate_hz"] for name, camera in status["sync"]["cameras"].items()}
    assert [name for name, rate in rates.items() if rate is None] == ["back-lower"]
    assert refused.returncode == 1
    assert "camera back-lower sends no frames; scan again" in refused.stderr


def test_a_camera_that_is_tried_again_keeps_its_reason(tmp_path: Path) -> None:
    """It was silent without a reason whenever it was tried."""
    path = tmp_path / "booth.toml"
    path.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "gone"\n')
    folder = private_folder(load_config(path).runtime.folder)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    wishes = publisher(context, folder, "desired", "desired")
    reports = subscriber(context, folder, ["camera-a"], ["health"])
    capture = subprocess.Popen([*STATION, "capture", "a", "--config", str(path)])
    told: list[tuple[str, bool]] = []
    try:
        deadline_s = time.monotonic() + 60.0
        while told.count(("lost", True)) < 12:
            assert time.monotonic() < deadline_s
            wishes.send_multipart([b"desired", DesiredState(True).pack()])
            while reports.poll(100):
                health = CameraHealth.unpack(reports.recv_multipart()[-1])
                told.append((health.state, "gone" in health.detail))
    finally:
        capture.terminate()
        assert capture.wait(60.0) == 0
        context.destroy(linger=0)
    known = told.index(("lost", True))
    assert set(told[:known]) <= {("off", False), ("opening", False)}
    assert set(told[known:]) == {("lost", True)}


def test_an_empty_booth_fails_the_scan_before_the_person_may_leave(
    make_station: Callable[..., Station],
) -> None:
    corner = "[volume]\nmin_m = [0.8, 0.6, 0.0]\nmax_m = [0.95, 0.75, 2.2]\n"
    station = make_station(f"{corner}[workers]\ncount = 0", _recorded)
    assert station.command("start").returncode == 0
    done = station.command("scan")
    assert done.returncode == 1
    assert "the booth is empty" in done.stderr
    assert "may leave" not in done.stdout + done.stderr
    assert not list((station.config.parent / "spool/queue").iterdir())


def test_a_camera_that_dies_in_a_scan_fails_it_by_name(
    make_station: Callable[..., Station],
) -> None:
    station = make_station(
        "[scan]\nframesets = 80\nmax_duration_s = 3.0\n[workers]\ncount = 0", _recorded
    )
    assert station.command("start").returncode == 0
    victim = station.pids("capture", "front-lower")[0]
    timer = threading.Timer(1.0, lambda: os.kill(victim, signal.SIGSTOP))
    timer.start()
    done = station.command("scan")
    timer.join()
    os.kill(victim, signal.SIGCONT)
    assert done.returncode == 1
    assert "failed" in done.stderr
    assert "front-lower" in done.stderr
    assert not list((station.config.parent / "spool/queue").iterdir())


def test_a_camera_absent_from_the_calibration_is_named(
    make_station: Callable[..., Station], booth: Path, tmp_path: Path
) -> None:
    document = json.loads((booth / "calibration.json").read_text())
    del document["cameras"]["back-upper"]
    (tmp_path / "partial.json").write_text(json.dumps(document))
    station = make_station("[workers]\ncount = 0", _recorded)
    text = station.config.read_text()
    station.close()
    station.config.write_text(
        text.replace(f"{booth}/calibration.json", str(tmp_path / "partial.json"))
    )
    again = type(station)(station.config)
    try:
        assert again.command("start").returncode == 0
        refused = again.command("scan")
    finally:
        again.close()
    assert refused.returncode == 1
    assert "camera back-upper is in booth.toml and was not" in refused.stderr


def test_no_sensor_of_that_serial_is_said_with_a_remedy() -> None:
    """Through the real libfreenect: no Kinect is plugged into a test machine."""
    driver = FreenectDriver(FreenectCamera(name="a", serial="A00000000000000A"))
    with pytest.raises(DriverError, match="Kinect A00000000000000A"):
        driver.open()
    driver.close()


def test_a_missing_library_names_the_package(monkeypatch: pytest.MonkeyPatch, booth: Path) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, "/nowhere/libfreenect.so.0.5")
    camera = FreenectCamera(name="a", recording=booth / "front-lower")
    with pytest.raises(DriverError, match=r"apt-get install libfreenect0\.5"):
        make_driver(camera).open()


def _short_recording(booth: Path, folder: Path) -> Path:
    """Three frames of one camera."""
    recording = folder / "short"
    recording.mkdir()
    names = (booth / "front-lower/INDEX.txt").read_text().splitlines()[:3]
    (recording / "INDEX.txt").write_text("\n".join(names) + "\n")
    for name in names:
        shutil.copy(booth / "front-lower" / name, recording)
    return recording


def test_a_recording_that_starts_over_says_nothing_each_time(
    make_station: Callable[..., Station], booth: Path, tmp_path: Path
) -> None:
    """libfreenect's replay library prints a line at its end."""
    short = _short_recording(booth, tmp_path)
    station = make_station(
        "[workers]\ncount = 0",
        lambda text: text.replace(f"{booth}/front-lower", str(short)),
    )
    assert station.command("start").returncode == 0
    runtime = load_config(station.config).runtime.folder
    station.wait_until(
        lambda: read_health(runtime, "capture front-lower").get("frames", 0) > 30,
        "thirty frames of three",
    )
    station.close()
    assert "No more lines" not in station.log.read_text()


def test_a_recording_that_starts_over_loses_no_frames(booth: Path, tmp_path: Path) -> None:
    """Its first frames may come before whoever reopened it goes on."""
    recording = _short_recording(booth, tmp_path)
    driver = FreenectDriver(FreenectCamera(name="a", recording=recording))
    driver.open()
    try:
        sequences: list[int] = []
        deadline_s = time.monotonic() + 60.0
        while len(sequences) < 60:
            assert time.monotonic() < deadline_s
            frame = driver.read(1.0)
            sequences += [frame.sequence] if frame else []
    finally:
        driver.close()
    assert sequences == list(range(60))


def test_status_without_a_station_ends_with_the_remedy(booth: Path, tmp_path: Path) -> None:
    config = tmp_path / "booth.toml"
    config.write_text((booth / "booth.toml").read_text())
    (Spool(tmp_path / "spool").folder / "outbox/20260101T000000Z-0000").mkdir()
    done = subprocess.run(
        [*STATION, "status", "--config", str(config)],
        capture_output=True, text=True, timeout=20, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("error: the booth is not running here; start it with")
    assert done.stdout.startswith("spool: 1 outbox;")
    assert len(done.stdout.splitlines()) == 1


def test_one_station_to_a_runtime_folder(make_station: Callable[..., Station]) -> None:
    station = make_station("[workers]\ncount = 0", _recorded)
    second = subprocess.run(
        [*STATION, "run", "--config", str(station.config)],
        capture_output=True, text=True, timeout=20, check=False,
    )  # fmt: skip
    assert second.returncode == 1
    assert "a station is already running" in second.stderr


def test_status_lists_every_process_and_names_a_console_that_hangs(
    make_station: Callable[..., Station],
) -> None:
    """Console and hand-over were missing: an operator without a page saw a sound booth."""
    extra = (
        f"[workers]\ncount = 0\n[console]\nport = {free_port()}\n"
        '[[deliver]]\nname = "share"\nfolder = "not-mounted"\nrescans = true'
    )
    station = make_station(extra, _recorded)
    config = load_config(station.config)
    result = Spool(config.spool.folder).folder / "outbox/20260101T000000Z-0000"
    result.mkdir()
    (result / "result.json").write_text('{"format": "result", "verdict": "ok"}')

    def told() -> dict[str, dict[str, Any]]:
        return booth_health(config).processes

    def says(words: str) -> Callable[[], bool]:
        return lambda: words in " ".join(booth_health(config).problems)

    station.wait_until(lambda: all(told().values()), "every process tells its health")
    assert list(told()) == [service.name for service in services(config)]
    station.wait_until(says("deliver share: 1 not handed over"), "the lost share is named")
    shown = station.command("status").stdout
    assert "deliver share: 1 to hand over" in shown
    assert "is the share mounted?" in shown
    [victim] = station.pids("station.cli", "console")
    os.kill(victim, signal.SIGSTOP)
    station.wait_until(says("the console process has not reported"), "the hung console is named")
    station.wait_until(
        lambda: told()["console"].get("pid") not in (None, victim),
        "the hung console is replaced",
    )


@pytest.mark.parametrize("process", ["control", "sync", "deliver"])
def test_one_process_of_a_kind_to_a_runtime_folder(tmp_path: Path, process: str) -> None:
    """A second control took the first one's socket away, and left the booth deaf when it ended."""
    config = tmp_path / "booth.toml"
    config.write_text(
        '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
        '[[deliver]]\nname = "share"\nfolder = "results"\n'
    )
    with held(tmp_path / f"run/{process}.lock", BoothError("busy")):
        second = subprocess.run(
            [*STATION, process, "--config", str(config)],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert second.returncode == 1
    assert "is already running here" in second.stderr


@pytest.mark.parametrize("scan_id", ["../../escape", "a\nb", "x" * 65, "\x1b[2J"])
def test_a_strange_scan_id_is_refused_at_the_door(tmp_path: Path, scan_id: str) -> None:
    """A person's bundle was written outside the spool, where no purge finds it."""
    config = tmp_path / "booth.toml"
    config.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    for command in (["scan", "--scan-id"], ["purge"], ["retry"]):
        done = subprocess.run(
            [*STATION, *command, scan_id, "--config", str(config)],
            capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == 1
        assert "not a valid scan id" in done.stderr
        assert "\x1b" not in done.stderr
