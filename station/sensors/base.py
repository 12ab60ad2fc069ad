"""The interface of depth sensor drivers.

A driver is a class with these three methods, made from its camera's section of booth.toml. It is
found through an entry point, see `station.core.drivers`; no other code refers to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """A sensor as it was opened."""

    serial: str
    """Serial number as the sensor reports it; a recording has a name with a colon instead."""
    model: str
    width: int
    height: int
    K: NDArray[np.float64]
    """Intrinsics of the depth image, 3x3, pixels."""
    distortion: NDArray[np.float64]
    """(k1, k2, p1, p2, k3) after OpenCV."""
    depth_scale_m: float
    """Metres per unit of the depth frames."""
    tick_hz: float
    """Nominal rate of the device clock."""
    tick_bits: int
    """The device clock wraps after 2 ** tick_bits ticks."""


def is_serial(text: str) -> bool:
    """Whether a serial number identifies a device; a recording's name does not."""
    return bool(text) and ":" not in text


@dataclass(frozen=True, slots=True)
class DepthFrame:
    """One depth image as the sensor sent it."""

    depth: NDArray[np.uint16]
    """(height, width) in units of ``DeviceInfo.depth_scale_m``; 0 = no reading."""
    device_ticks: int
    received_s: float
    """Time at which it reached the host, on the host's monotonic clock."""
    sequence: int
    """Counts the frames that the sensor delivered; a gap is a loss."""


class DepthDriver(Protocol):
    """Life cycle of a sensor: open, read, close. All three are called from one thread."""

    def open(self) -> DeviceInfo:
        """Start the sensor.

        Raises:
            DriverError: naming the sensor's serial (or recording) and the remedy.
        """
        ...

    def read(self, timeout_s: float) -> DepthFrame | None:
        """The next frame, or None if none came within the time.

        Raises:
            DriverError: the sensor is disconnected and has to be opened again.
        """
        ...

    def close(self) -> None:
        """Stop the sensor; harmless when it was never opened."""
        ...
