"""Messages of strangers end no reader."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from station.messaging.intake import FrameIntake
from station.messaging.messages import CameraHealth, FrameHeader
from station.messaging.transport import publisher, socket_folder

_HEADER = FrameHeader("a", "A1", 8, 6, 1e-3, 7, 6e7, 5.0, 5.0, 1, 0)
_PIXELS = np.arange(48, dtype=np.uint16).tobytes()


@pytest.fixture
def booth(tmp_path: Path) -> Iterator[tuple[zmq.Socket[bytes], FrameIntake]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    out = publisher(context, tmp_path, "camera-a", "depth")
    intake = FrameIntake(context, tmp_path, ["a"])
    for _ in range(200):
        out.send_multipart([b"health/a", CameraHealth("a", "opening", "", 0, 0, 0).pack()])
        list(intake.frames(0.05))
        if intake.health:
            break
    yield out, intake
    context.destroy(linger=0)


def test_a_sensor_that_is_switched_off_is_known(
    booth: tuple[zmq.Socket[bytes], FrameIntake],
) -> None:
    out, intake = booth
    assert intake.off() == set()
    out.send_multipart([b"health/a", CameraHealth("a", "off", "", 0, 0, 0).pack()])
    for _ in range(200):
        list(intake.frames(0.05))
        if intake.off():
            break
    assert intake.off() == {"a"}


def _changed(**changes: object) -> bytes:
    packed: bytes = msgpack.packb({**msgpack.unpackb(_HEADER.pack()), **changes})
    return packed


@pytest.mark.parametrize(
    "parts",
    [
        [b"depth/a"],
        [b"depth/a", b"\xc1", _PIXELS],
        [b"depth/a", _changed(version=1), _PIXELS],
        [b"depth/a", _changed(camera=b"a"), _PIXELS],
        [b"depth/a", _changed(camera="b"), _PIXELS],
        [b"depth/a", _changed(width=-8), _PIXELS],
        [b"depth/a", _changed(width=10**9), _PIXELS],
        [b"depth/a", _changed(tick_hz=0.0), _PIXELS],
        [b"depth/a", _HEADER.pack(), _PIXELS[:-1]],
        [b"depth/a", _HEADER.pack()],
        [b"health/a", _HEADER.pack()],
        [b"sensor/a", b""],
    ],
)
def test_a_bad_message_is_counted_and_the_next_frame_taken(
    booth: tuple[zmq.Socket[bytes], FrameIntake], parts: list[bytes]
) -> None:
    """One capture process of another release ended sync again and again."""
    out, intake = booth
    out.send_multipart(parts)
    out.send_multipart([b"depth/a", _HEADER.pack(), _PIXELS])
    taken = []
    for _ in range(100):
        taken += list(intake.frames(0.05))
        if taken:
            break
    assert intake.unreadable == 1
    assert intake.last_problem
    assert taken[0].depth[5, 7] == 47


@pytest.mark.parametrize("length", [60, 70, 80, 90, 100, 140])
def test_sockets_fit_into_folders_with_paths_of_any_length(tmp_path: Path, length: int) -> None:
    """The kernel takes 107 bytes; a folder that is good for one name must be so for all."""
    runtime = tmp_path / ("x" * max(1, length - len(str(tmp_path)) - 1))
    runtime.mkdir()
    name = "notify-capture-" + "c" * 40
    folder = socket_folder(runtime, name)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
            bound.bind(str(folder / name))
    finally:
        shutil.rmtree(folder)
