"""A sensor that this tree has never heard of: its driver comes from a package of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq

from station.core.config_file import load_config
from station.core.errors import ConfigError
from station.messaging.messages import DesiredState, FrameHeader
from station.messaging.transport import publisher, subscriber

_PYPROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "pretend-sensor"
version = "1"
[project.entry-points."body_booth.drivers"]
pretend = "pretend_sensor:PretendDriver"
broken = "pretend_sensor:Missing"
[tool.setuptools]
py-modules = ["pretend_sensor"]
"""
_MODULE = '''
"""A sensor of 8 x 6 pixels at 100 Hz that sees a wall."""
import time

import numpy as np
from pydantic import Field

from station.core.drivers import CameraConfig, ConfigPath
from station.sensors.base import DepthFrame, DeviceInfo


class PretendCamera(CameraConfig):
    wall_m: float = Field(gt=0.0, description="how far the wall is")
    table: ConfigPath | None = None


class PretendDriver:
    Config = PretendCamera

    def __init__(self, camera: PretendCamera) -> None:
        self._wall_m, self._sequence = camera.wall_m, 0

    def open(self) -> DeviceInfo:
        K = np.array([[8.0, 0.0, 3.5], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]])
        return DeviceInfo("P1", "pretend", 8, 6, K, np.zeros(5), 0.001, 1e6, 32)

    def read(self, timeout_s: float) -> DepthFrame | None:
        time.sleep(0.01)
        self._sequence += 1
        depth = np.full((6, 8), round(1000 * self._wall_m), np.uint16)
        now_s = time.monotonic()
        return DepthFrame(depth, int(1e6 * now_s) % 2**32, now_s, self._sequence)

    def close(self) -> None:
        pass
'''
_BOOTH = '[[cameras]]\nname = "a"\ndriver = "pretend"\nwall_m = 1.5\ntable = "table.npz"\n'


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the package was installed into."""
    source = tmp_path_factory.mktemp("source")
    (source / "pyproject.toml").write_text(_PYPROJECT)
    (source / "pretend_sensor.py").write_text(_MODULE)
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    subprocess.run(
        [*pip, "--no-build-isolation", "--target", str(target), str(source)],
        check=True, capture_output=True,
    )  # fmt: skip
    return target


@pytest.fixture
def config_path(tmp_path: Path, installed: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(installed))
    path = tmp_path / "booth.toml"
    path.write_text(_BOOTH)
    return path


def test_its_section_is_checked_by_its_own_class(config_path: Path) -> None:
    camera = load_config(config_path).camera("a")
    assert type(camera).__name__ == "PretendCamera"
    assert camera.model_dump()["table"] == config_path.parent / "table.npz"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("wall_m", "wall_mm"), "cameras[1].wall_m is missing"),
        (('"a"', '"a"\ncolour = 1'), "allowed here: name, driver, wall_m, table"),
        (("1.5", "-1.5"), "cameras[1].wall_m: must be greater than 0"),
        (('"pretend"', '"broken"'), "the driver broken (pretend_sensor:Missing) cannot be loaded"),
        (('"pretend"', '"other"'), "installed: broken, "),
    ],
)
def test_its_keys_are_as_strict_as_all_others(
    config_path: Path, change: tuple[str, str], words: str
) -> None:
    config_path.write_text(_BOOTH.replace(*change))
    with pytest.raises(ConfigError) as raised:
        load_config(config_path)
    assert words in str(raised.value)


def test_a_driver_that_plays_no_recordings_says_so(config_path: Path) -> None:
    with pytest.raises(ConfigError, match="the driver pretend cannot play recordings"):
        load_config(config_path).camera("a").replaying(Path("somewhere"))


def test_station_capture_publishes_its_frames(installed: Path, config_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    capture = subprocess.Popen(
        [sys.executable, "-m", "station.cli", "capture", "a", "--config", str(config_path)],
        env=environment,
    )
    folder = config_path.parent / "run"
    try:
        with zmq.Context() as context:
            wishes = publisher(context, folder, "desired", "desired")
            frames = subscriber(context, folder, ["camera-a"], ["depth"])
            deadline_s = time.monotonic() + 30.0
            while not frames.poll(100):
                assert time.monotonic() < deadline_s
                assert capture.poll() is None
                wishes.send_multipart([b"desired", DesiredState(True).pack()])
            topic, packed, pixels = frames.recv_multipart()
            wishes.close()
            frames.close()
    finally:
        capture.terminate()
        capture.wait(timeout=10)
    header = FrameHeader.unpack(packed)
    assert topic == b"depth/a"
    assert (header.serial, header.width, header.height) == ("P1", 8, 6)
    assert pixels == (1500).to_bytes(2, "little") * 48
