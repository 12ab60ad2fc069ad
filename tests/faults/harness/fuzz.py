"""Messages that nobody in their right mind would send."""

from __future__ import annotations

import random
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import msgpack
import zmq
from strange import STRANGE
from table import Row

from station.core.errors import BoothError
from station.messaging.intake import FrameIntake
from station.messaging.messages import (
    CameraHealth,
    DesiredState,
    FrameHeader,
    Message,
    Reply,
    Request,
    ScanEvent,
    SensorInfo,
)
from station.messaging.topics import TOPICS
from station.messaging.transport import publisher

_MAX_GROWTH_MB = 20.0
_WHOLE: tuple[Message, ...] = (
    Request("scan", "20260101T000000Z-0001", "Order 1", 5.0),
    Reply(True, "", {"a": [1]}),
    ScanEvent("s", "capturing", 1, 10),
    DesiredState(True),
    FrameHeader("a", "A1", 640, 480, 1e-4, 7, 6e7, 5.0, 5.0, 1, 0),
    CameraHealth("a", "streaming", "", 5, 0, 0),
    SensorInfo("a", "A1", "k", 640, 480, [[1.0] * 3] * 3, [0.0] * 5, 1e-4, 6e7, 32),
)
_PACKED = [message.pack() for message in _WHOLE]
_KINDS = [type(message) for message in _WHOLE]


def message_rows(count: int, seed: int) -> list[Row]:
    """Damage messages and unpack them: each is taken or refused with words."""
    rng = random.Random(seed)
    deaths, before_kb = 0, _peak_kb()
    for _ in range(count):
        data = _damaged(rng, rng.choice(_PACKED))
        try:
            rng.choice(_KINDS).unpack(data)
        except BoothError as error:
            deaths += "\n" in str(error)
        except Exception as error:
            deaths += 1
            print(f"        {type(error).__name__}: {error!a:.200}", flush=True)
    grown_mb = (_peak_kb() - before_kb) / 1024
    return [
        Row(
            "fuzzed messages",
            "0 deaths, 0 growth, words in one line",
            f"{count}, {deaths} deaths, {grown_mb:.1f} MB more",
            deaths == 0 and grown_mb < _MAX_GROWTH_MB,
        )
    ]


def intake_rows(count: int, seed: int) -> list[Row]:
    """Damaged frames, health and sensors through a real socket into what sync reads them with."""
    rng = random.Random(seed)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    sent = 0
    with tempfile.TemporaryDirectory() as name:
        source = publisher(context, Path(name), "camera-a", "depth")
        intake = FrameIntake(context, Path(name), ["a"])
        time.sleep(0.2)
        while sent < count:
            # No more than may wait in a socket, so that none is lost.
            for _ in range(TOPICS["depth"].high_water_mark):
                topic = rng.choice([b"depth/a", b"health/a", b"sensor/a", b"depth", b"health\xff"])
                parts = [_damaged(rng, rng.choice(_PACKED)) for _ in range(rng.randrange(3))]
                source.send_multipart([topic, *parts])
                sent += 1
            for _ in intake.frames(0.01):
                pass
        read = intake.unreadable
    context.destroy(linger=0)
    return [
        Row(
            "fuzzed messages through sync's intake",
            "0 deaths",
            f"{sent} sent, {read} refused, 0 deaths",
            read > 0,
        )
    ]


def _damaged(rng: random.Random, data: bytes) -> bytes:
    way = rng.randrange(4)
    if way == 0:
        return data[: rng.randrange(len(data))]
    if way == 1:
        spoilt = bytearray(data)
        for _ in range(rng.randrange(1, 6)):
            spoilt[rng.randrange(len(spoilt))] = rng.randrange(256)
        return bytes(spoilt)
    if way == 2:
        return rng.randbytes(rng.randrange(200))
    content: dict[Any, Any] = msgpack.unpackb(data)
    key = rng.choice([*content, "more", 7, b"raw"])
    content[key] = rng.choice([*STRANGE, b"\x00\xff"])
    try:
        packed: bytes = msgpack.packb(content)
    except (ValueError, OverflowError, UnicodeEncodeError):
        return b""
    return packed


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
