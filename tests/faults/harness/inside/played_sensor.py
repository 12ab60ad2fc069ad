"""A sensor that plays a recording in real time, and misbehaves as a file says.

The file holds one fault ("silent", "drift 500"), or nothing; it may change at any time. The device
clock wraps within the first seconds after each opening.
"""

from __future__ import annotations

import os
import time

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from station.core.drivers import CameraConfig, ConfigPath
from station.core.errors import DriverError
from station.core.kinect_v1 import FRAME_RATE_HZ, TICK_BITS, TICK_HZ, depth_of_raw
from station.sensors.base import DepthFrame, DeviceInfo
from station.sensors.recorded import kinect_v1
from station.sensors.recording import check_recording, read_raw

_SPAN = 1 << TICK_BITS
_WRAPS_AFTER_S = 4.0


class PlayedCamera(CameraConfig):
    """A camera whose faults are ordered."""

    driver: str = "played"
    recording: ConfigPath = Field(description="a recording folder (INDEX.txt)")
    serial: str = Field(description="the serial number that it reports")
    fault: ConfigPath = Field(description="the file that holds its fault")


class PlayedDriver:
    """Plays the frames of a recording over and over; its clock never starts over by itself."""

    Config = PlayedCamera

    def __init__(self, camera: PlayedCamera) -> None:
        self._camera = camera
        self._pictures: list[NDArray[np.uint16]] = []
        self._fault, self._value, self._changed_ns = "", "", -1
        self._frame = self._sequence = self._sent_ticks = 0
        self._start_s = 0.0
        self._rate = 1.0
        self._base = (0.0, 0.0)
        """Seconds since the start, and the device's ticks then."""

    def open(self) -> DeviceInfo:
        self._look()
        if self._fault == "unplugged":
            raise DriverError(f"camera {self._camera.name} is not connected; check its cable")
        if not self._pictures:
            frames = check_recording(self._camera.recording)
            self._pictures = [depth_of_raw(read_raw(path)) for _, _, path in frames]
        self._start_s, self._frame, self._sequence = time.monotonic(), 0, 0
        self._base = (0.0, _SPAN - _WRAPS_AFTER_S * TICK_HZ)
        return kinect_v1(self._value if self._fault == "swapped" else self._camera.serial)

    def read(self, timeout_s: float) -> DepthFrame | None:
        if self._look():
            self._turn()
        if self._fault == "unplugged":
            raise DriverError(f"camera {self._camera.name} was disconnected; check its cable")
        wait_s = self._start_s + self._frame / FRAME_RATE_HZ - time.monotonic()
        if wait_s > timeout_s or self._fault == "silent":
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        # What nobody fetched in time is gone, as with a real sensor.
        since_s = time.monotonic() - self._start_s
        taken = max(self._frame, int(since_s * FRAME_RATE_HZ))
        self._frame = taken + (2 if self._fault == "half" else 1)
        self._sequence += 1
        if self._fault != "stuck":
            self._sent_ticks = round(self._ticks(taken / FRAME_RATE_HZ)) % _SPAN
        picture = 0 if self._fault == "frozen" else taken % len(self._pictures)
        return DepthFrame(
            self._pictures[picture], self._sent_ticks, time.monotonic(), self._sequence
        )

    def close(self) -> None:
        self._pictures = []

    def _ticks(self, since_s: float) -> float:
        at_s, ticks = self._base
        return ticks + (since_s - at_s) * TICK_HZ * self._rate

    def _look(self) -> bool:
        """Read the fault; whether it is another one."""
        changed_ns = os.stat(self._camera.fault).st_mtime_ns
        if changed_ns == self._changed_ns:
            return False
        self._changed_ns = changed_ns
        before = self._fault, self._value
        self._fault, _, self._value = self._camera.fault.read_text().strip().partition(" ")
        return before != (self._fault, self._value)

    def _turn(self) -> None:
        """Begin a fault of the clock, or end it."""
        since_s = time.monotonic() - self._start_s
        ticks = 0.0 if self._fault == "reset" else self._ticks(since_s)
        self._base = (since_s, ticks)
        self._rate = 1.0 + 1e-6 * float(self._value) if self._fault == "drift" else 1.0
