"""Recordings read without libfreenect, with their own timing, over and over."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from pydantic import Field

from station.core.drivers import CameraConfig, ConfigPath
from station.core.errors import DriverError, FormatError
from station.core.kinect_v1 import (
    DEPTH_SCALE_M,
    FRAME_RATE_HZ,
    HEIGHT,
    TICK_BITS,
    TICK_HZ,
    WIDTH,
    depth_of_raw,
    nominal_intrinsics,
)
from station.sensors.base import DepthFrame, DeviceInfo
from station.sensors.recording import check_recording, read_raw


def kinect_v1(serial: str) -> DeviceInfo:
    """A Kinect v1 with nominal intrinsics; the calibration holds the real ones."""
    return DeviceInfo(
        serial=serial,
        model="kinect-v1",
        width=WIDTH,
        height=HEIGHT,
        K=nominal_intrinsics(),
        distortion=np.zeros(5),
        depth_scale_m=DEPTH_SCALE_M,
        tick_hz=TICK_HZ,
        tick_bits=TICK_BITS,
    )


class RecordedCamera(CameraConfig):
    """A camera whose recording is read from disk, without libfreenect."""

    driver: str = "recorded"
    recording: ConfigPath = Field(description="a recording folder (INDEX.txt)")
    serial: str = Field(default="", description="the serial number it is said to have")

    def replaying(self, recording: Path) -> CameraConfig:
        return self.model_copy(update={"recording": recording})


class RecordedDriver:
    """Plays a recording folder; after the last frame it starts over, as a replayed sensor does."""

    Config = RecordedCamera

    def __init__(self, camera: RecordedCamera) -> None:
        self._recording, self._serial = camera.recording, camera.serial
        self._frames: list[tuple[float, int, Path]] = []
        self._sequence = 0
        self._start_s = 0.0

    def open(self) -> DeviceInfo:
        try:
            self._frames = check_recording(self._recording)
        except FormatError as cause:
            raise DriverError(str(cause)) from None
        self._start_s = time.monotonic()
        self._sequence = 0
        return kinect_v1(self._serial or f"recorded:{self._recording.name}")

    def read(self, timeout_s: float) -> DepthFrame | None:
        first_s, last_s = self._frames[0][0], self._frames[-1][0]
        passes, index = divmod(self._sequence, len(self._frames))
        period_s = (last_s - first_s) * (1.0 + 1.0 / max(len(self._frames) - 1, 1))
        period_s = max(period_s, 1.0 / FRAME_RATE_HZ)  # a single frame
        seconds, ticks, path = self._frames[index]
        wait_s = self._start_s + passes * period_s + seconds - first_s - time.monotonic()
        time.sleep(max(0.0, min(wait_s, timeout_s)))
        if wait_s > timeout_s:
            return None
        try:
            depth = depth_of_raw(read_raw(path))
        except (OSError, ValueError, FormatError) as cause:
            raise DriverError(f"{path} cannot be read ({cause}); record again") from None
        frame = DepthFrame(depth, ticks, time.monotonic(), self._sequence)
        self._sequence += 1
        return frame

    def close(self) -> None:
        self._frames = []
