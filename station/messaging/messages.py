"""Every message that crosses a socket: fields, units, version.

A message is a msgpack map with its type and version. One of another type or version is rejected
with an explanation; nothing is ever unpickled.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from math import isfinite
from typing import Any, ClassVar, Self

import msgpack

from station.core.errors import FormatError

_MAX_PIXELS = 4096
"""On a side of a depth image; no depth sensor has more."""
_MAX_TEXT = 10_000
_KINDS: dict[str, type | tuple[type, ...]] = {
    "str": str,
    "int": int,
    "float": (float, int),
    "bool": bool,
    "list[float]": list,
    "list[list[float]]": list,
    "dict[str, Any]": dict,
}
"""Types that msgpack may give for a field; annotations are strings here."""


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
            FormatError: it is torn, of another type or version, or a value is invalid.
        """
        try:
            content = msgpack.unpackb(data)
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as cause:
            raise FormatError(f"a message is torn ({cause})") from None
        if not isinstance(content, dict) or content.get("type") != cls.__name__:
            found = content.get("type") if isinstance(content, dict) else type(content).__name__
            raise FormatError(f"a {cls.__name__} message was expected, not {found!a:.80}")
        version = content.get("version")
        if version != cls.VERSION or isinstance(version, bool):
            raise FormatError(
                f"{cls.__name__} has version {version!a:.80}, this program uses {cls.VERSION}; "
                "run the same release everywhere"
            )
        values = {key: value for key, value in content.items() if key not in ("type", "version")}
        known = {item.name: str(item.type) for item in fields(cls)}
        if values.keys() != known.keys():
            names = ", ".join(sorted(f"{key!a:.80}" for key in values))
            raise FormatError(f"{cls.__name__} has the fields {names:.400}, not {sorted(known)}")
        for name, kind in known.items():
            if not _is(values[name], kind):
                raise FormatError(f"{cls.__name__}: {name} is {values[name]!a:.80}, not {kind}")
        message = cls(**values)
        if (problem := message.impossible()) is not None:
            raise FormatError(f"{cls.__name__}: {problem}")
        return message

    def impossible(self) -> str | None:
        """Name of a value that is invalid despite its type; None if there is none."""
        return None


def _is(value: object, kind: str) -> bool:
    if isinstance(value, bool) != (kind == "bool") or not isinstance(value, _KINDS[kind]):
        return False
    if kind == "float":
        return isinstance(value, int | float) and isfinite(value)
    if isinstance(value, str):
        return len(value) <= _MAX_TEXT
    if kind == "list[float]":
        return isinstance(value, list) and all(_is(item, "float") for item in value)
    if kind == "list[list[float]]":
        return isinstance(value, list) and all(_is(item, "list[float]") for item in value)
    return True


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
    """Resets of the sensor's clock so far: times before and after one cannot be compared."""

    def impossible(self) -> str | None:
        if not (0 < self.width <= _MAX_PIXELS and 0 < self.height <= _MAX_PIXELS):
            return f"an image of {self.width} x {self.height}"
        if not (0.0 < self.depth_scale_m < 0.1 and self.tick_hz > 0.0):
            return f"depth_scale_m {self.depth_scale_m}, tick_hz {self.tick_hz}"
        if min(self.device_ticks, self.sequence, self.clock_resets) < 0:
            return "a negative count"
        return None


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
    """The operator's start or stop, repeated: capture processes follow it, however often it
    arrives."""

    streaming: bool


@dataclass(frozen=True, slots=True)
class Request(Message):
    """A command to control or sync; the same scan id twice is the same scan."""

    VERSION: ClassVar[int] = 2

    command: str
    """"start", "stop", "scan", "cancel", "scan-status" or "status"."""
    scan_id: str = ""
    label: str = ""
    valid_until_s: float = 0.0
    """Deadline for starting the scan, host's monotonic clock. 0: control sets it."""


@dataclass(frozen=True, slots=True)
class Reply(Message):
    """The reply to a request."""

    ok: bool
    error: str = ""
    content: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ScanEvent(Message):
    """Progress of a scan. The outcome is on disk too; a program that missed it asks control."""

    scan_id: str
    state: str
    """"capturing", "writing", "accepted" or "failed"."""
    framesets: int
    wanted: int
    reason: str = ""
