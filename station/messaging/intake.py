"""Intake of the capture processes' messages: frames, and the cameras' health.

A message that cannot be read is counted and dropped, whoever sent it: a capture process of another
release must not crash its readers.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from station.core.errors import FormatError
from station.messaging.messages import CameraHealth, FrameHeader, SensorInfo
from station.messaging.transport import subscriber

_MAX_AT_ONCE = 64
"""Frames read at once before the caller can do other work."""


@dataclass(frozen=True, slots=True)
class LiveFrame:
    """A frame as received; the pixels share the message's memory."""

    header: FrameHeader
    depth: NDArray[np.uint16]
    """(height, width) in units of `header.depth_scale_m`, 0 = no reading."""


class FrameIntake:
    """The messages of a booth's capture processes. Use it from one thread."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], runtime_folder: Path, cameras: list[str]
    ) -> None:
        self.socket = subscriber(
            context,
            runtime_folder,
            [f"camera-{name}" for name in cameras],
            ["depth", "health", "sensor"],
        )
        self._cameras = frozenset(cameras)
        self.health: dict[str, CameraHealth] = {}
        self.sensors: dict[str, SensorInfo] = {}
        self.last_frame_s: dict[str, float] = {}
        """Arrival of each camera's last frame, host's monotonic clock."""
        self.told_s: dict[str, float] = {}
        """Arrival of the last message of each camera's process."""
        self.unreadable = 0
        self.last_problem = ""

    def frames(self, timeout_s: float = 0.0) -> Iterator[LiveFrame]:
        """The frames that have arrived; waits for the first message if there is none."""
        wait_ms = int(1000 * timeout_s)
        for _ in range(_MAX_AT_ONCE):
            if not self.socket.poll(wait_ms):
                return
            wait_ms = 0
            parts = self.socket.recv_multipart(copy=False)
            try:
                frame = self._take([part.buffer for part in parts])
            except FormatError as problem:
                self.unreadable += 1
                self.last_problem = str(problem)
                continue
            if frame is not None:
                yield frame

    def silent(self, limit_s: float) -> list[str]:
        """The cameras that have sent no frame for this long."""
        now_s = time.monotonic()
        return sorted(
            name for name in self._cameras if now_s - self.last_frame_s.get(name, -1e9) > limit_s
        )

    def off(self) -> set[str]:
        """The cameras whose processes report that they are switched off."""
        return {name for name, health in self.health.items() if health.state == "off"}

    def why(self, camera: str) -> str:
        """Reason, in brackets, that a camera's process reports for missing frames; may be empty."""
        health = self.health.get(camera)
        if health is None:
            return ""
        # The last that a hanging process reported is no reason.
        why = health.detail or ("" if health.state == "streaming" else health.state)
        return f" ({why})" if why else ""

    def _take(self, parts: list[memoryview]) -> LiveFrame | None:
        if len(parts) < 2:
            raise FormatError(f"a message has {len(parts)} parts, not two or three")
        kind = bytes(parts[0]).split(b"/")[0]
        if kind == b"health":
            health = CameraHealth.unpack(parts[1])
            self.health[self._known(health.camera)] = health
            return None
        if kind == b"sensor":
            sensor = SensorInfo.unpack(parts[1])
            self.sensors[self._known(sensor.camera)] = sensor
            return None
        header = FrameHeader.unpack(parts[1])
        size = 2 * header.width * header.height
        if len(parts) != 3 or parts[2].nbytes != size:
            raise FormatError(f"camera {header.camera}: a frame does not have {size} bytes")
        self.last_frame_s[self._known(header.camera)] = time.monotonic()
        depth = np.frombuffer(parts[2], np.uint16).reshape(header.height, header.width)
        return LiveFrame(header, depth)

    def _known(self, camera: str) -> str:
        if camera not in self._cameras:
            raise FormatError(f"camera {camera!a:.80} is not in the configuration")
        self.told_s[camera] = time.monotonic()
        return camera
