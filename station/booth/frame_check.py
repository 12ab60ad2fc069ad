"""Checks that a camera's frames come from a working sensor (pure). A sensor that hangs may keep
sending its last picture, or pictures with one time stamp: in a shop those would show the previous
customer. Such frames are not used, and the camera is reported.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import median

import numpy as np
from numpy.typing import NDArray

from station.messaging.messages import FrameHeader
from station.sensors.base import is_serial
from station.sensors.identity import mismatch

MIN_RATE_HZ = 25.0
"""A Kinect sends 30; one that falls back to 15 shares its USB controller."""
_ROWS_LOOKED_AT = 8
"""Every eighth row: two pictures with identical noise in all of them are the same picture."""
_REPEATS_NAMED = 5
"""A sixth of a second; a single frame that comes twice is only left out."""
_REMEMBERED_S = 1.0
_STEPS = 15
"""Half a second of frames: a rate is known before a scan can be ordered."""


@dataclass(slots=True)
class FrameCheck:
    """Plausibility of one camera's frames. Feed it every frame."""

    replays: bool = False
    """The camera plays a recording."""
    _ticks: int | None = None
    _sequence: int = 0
    _picture: int | None = None
    _same_pictures: int = 0
    _same_stamps: int = 0
    _trouble: str = ""
    _trouble_s: float = -1e9
    _steps_s: deque[float] = field(default_factory=lambda: deque(maxlen=_STEPS))
    """Intervals between frames by the device's clock, seconds."""

    def usable(self, header: FrameHeader, depth: NDArray[np.uint16]) -> bool:
        """Whether a frame may enter a frameset."""
        picture = zlib.crc32(np.ascontiguousarray(depth[::_ROWS_LOOKED_AT]).data)
        again = picture == self._picture
        stuck = header.device_ticks == self._ticks
        self._same_pictures = self._same_pictures + 1 if again else 0
        self._same_stamps = self._same_stamps + 1 if stuck else 0
        if self._ticks is not None:
            ticks, frames = header.device_ticks - self._ticks, header.sequence - self._sequence
            # A counter that wrapped or was reset says nothing about the rate.
            if ticks > 0 and frames > 0:
                self._steps_s.append(ticks / header.tick_hz / frames)
        self._picture, self._ticks = picture, header.device_ticks
        self._sequence = header.sequence
        if self._same_stamps >= _REPEATS_NAMED:
            self._name("its time stamps do not advance", header.received_s)
        elif self._same_pictures >= _REPEATS_NAMED:
            self._name("it keeps sending the same picture", header.received_s)
        return not (again or stuck or self._slow())

    def rate_hz(self) -> float | None:
        """Frame rate by the device's own clock; None before enough frames have arrived."""
        return 1.0 / median(self._steps_s) if len(self._steps_s) == _STEPS else None

    def trouble(self, now_s: float) -> str:
        """The problem and its remedy in words; empty when there is none."""
        if now_s - self._trouble_s < _REMEMBERED_S:
            return f"{self._trouble}; {self._remedy('unplug the sensor and plug it in again')}"
        if self._slow():
            rate_hz = self.rate_hz()
            remedy = self._remedy("connect it to a USB controller of its own")
            return (
                f"it sends {rate_hz:.0f} frames per second, {MIN_RATE_HZ:.0f} are needed; {remedy}"
            )
        return ""

    def _remedy(self, of_sensor: str) -> str:
        return "record it again" if self.replays else of_sensor

    def _slow(self) -> bool:
        rate_hz = self.rate_hz()
        return rate_hz is not None and rate_hz < MIN_RATE_HZ

    def _name(self, trouble: str, now_s: float) -> None:
        self._trouble, self._trouble_s = trouble, now_s


def wrong_sensors(found: Mapping[str, str], calibrated: Mapping[str, str]) -> list[str]:
    """Sentences about sensors that are not those of the calibration, each with its remedy.

    Args:
        found: camera -> serial number, of those that have sent frames.
        calibrated: the same when the booth was calibrated.
    """
    wrong = []
    owners: dict[str, str] = {}
    for name, serial in found.items():
        if serial in owners and is_serial(serial):
            wrong.append(
                f"cameras {owners[serial]} and {name} are the same sensor ({serial}); correct the "
                "serial numbers in booth.toml"
            )
        owners[serial] = name
    both = [name for name in found if name in calibrated]
    words = mismatch(
        {name: calibrated[name] for name in both}, {name: found[name] for name in both}
    )
    return [*wrong, words] if words else wrong
