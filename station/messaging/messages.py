"""Every message that crosses a socket: fields, units, version.

A message is a msgpack map with its type and version. One of another type or version is refused
with words; nothing is ever unpickled.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, Self

import msgpack

from station.core.errors import FormatError


@dataclass(frozen=True, slots=True)
class Message:
    """Packing and checking that all messages share."""

    VERSION: ClassVar[int] = 1

    def pack(self) -> bytes:
        content = {"type": type(self).__name__, "version": self.VERSION, **asdict(self)}
        packed: bytes = msgpack.packb(content)
        return packed

    @classmethod
    def unpack(cls, data: bytes | memoryview) -> Self:
        """The message of packed bytes.

        Raises:
            FormatError: it is torn, of another type or of another version.
        """
        try:
            content = msgpack.unpackb(data)
        except (ValueError, msgpack.UnpackException) as cause:
            raise FormatError(f"a message is torn ({cause})") from None
        if not isinstance(content, dict) or content.get("type") != cls.__name__:
            found = content.get("type") if isinstance(content, dict) else type(content).__name__
            raise FormatError(f"a {cls.__name__} message was expected, {found!r} came")
        if content.get("version") != cls.VERSION:
            raise FormatError(
                f"{cls.__name__} has version {content.get('version')!r}, this program speaks "
                f"{cls.VERSION}; run the same release everywhere"
            )
        known = {item.name for item in fields(cls)}
        values = {key: value for key, value in content.items() if key not in ("type", "version")}
        if set(values) != known:
            raise FormatError(
                f"{cls.__name__} has the fields {sorted(values)}, not {sorted(known)}"
            )
        return cls(**values)


@dataclass(frozen=True, slots=True)
class FrameHeader(Message):
    """Precedes the raw bytes of one depth frame (uint16, row by row)."""

    VERSION: ClassVar[int] = 2

    camera: str
    serial: str
    width: int
    height: int
    depth_scale_m: float
    device_ticks: int
    tick_hz: float
    host_time_s: float
    """Time at which it was taken: the host's monotonic clock, by the clock model."""
    received_s: float
    """Time at which it reached the host, same clock."""
    sequence: int
    clock_resets: int
    """Resets of the sensor's clock so far: times before and after one have nothing in common."""


@dataclass(frozen=True, slots=True)
class CameraHealth(Message):
    """The state of a sensor, sent by its capture process twice a second."""

    camera: str
    state: str
    """"off", "opening", "streaming" or "lost"."""
    detail: str
    frames: int
    lost: int
    clock_resets: int


@dataclass(frozen=True, slots=True)
class SensorInfo(Message):
    """The sensor of a camera, with the lens that its driver knows; sent beside its health."""

    camera: str
    serial: str
    model: str
    width: int
    height: int
    K: list[list[float]]
    """Intrinsics of the depth image, 3x3, pixels."""
    distortion: list[float]
    """(k1, k2, p1, p2, k3) after OpenCV."""
    depth_scale_m: float
    tick_hz: float
    tick_bits: int


@dataclass(frozen=True, slots=True)
class DesiredState(Message):
    """The operator's order, repeated: capture processes follow it, however often it comes."""

    streaming: bool


@dataclass(frozen=True, slots=True)
class Request(Message):
    """A command to control or sync; the same scan id twice is the same scan."""

    command: str
    """"start", "stop", "scan", "cancel", "scan-status" or "status"."""
    scan_id: str = ""
    label: str = ""


@dataclass(frozen=True, slots=True)
class Reply(Message):
    """Its answer."""

    ok: bool
    error: str = ""
    content: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ScanEvent(Message):
    """Progress of a scan that sync collects."""

    scan_id: str
    state: str
    """"capturing", "accepted" or "failed"."""
    framesets: int
    wanted: int
    reason: str
