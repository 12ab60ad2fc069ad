import msgpack
import pytest

from station.core.errors import FormatError
from station.messaging.messages import (
    CameraHealth,
    DesiredState,
    Reply,
    Request,
    ScanEvent,
    SensorInfo,
)

_EXAMPLES = [
    CameraHealth("front", "lost", "unplugged", 10, 1, 0),
    SensorInfo("front", "A1", "kinect-v1", 2, 1, [[1.0, 0.0, 0.5]], [0.0], 1e-4, 6e7, 32),
    DesiredState(True),
    Request("scan", "20260101T000000Z-0001", "Zoë", 5.0),
    Reply(ok=False, error="no", content={"a": [1, 2]}),
    ScanEvent("s", "capturing", 3, 10),
]


@pytest.mark.parametrize("message", _EXAMPLES, ids=lambda message: type(message).__name__)
def test_round_trip(message: Request) -> None:
    assert type(message).unpack(message.pack()) == message


def _changed(**changes: object) -> bytes:
    content = msgpack.unpackb(Request("scan").pack())
    packed: bytes = msgpack.packb({**content, **changes})
    return packed


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\xc1", "torn"),
        (msgpack.packb([1]), "expected"),
        (DesiredState(True).pack(), "not 'DesiredState'"),
        (_changed(version=9), "run the same release"),
        (_changed(version=True), "run the same release"),
        (_changed(extra=1), "fields"),
        (_changed(scan_id=7), "scan_id is 7, not str"),
        (_changed(valid_until_s=float("nan")), "valid_until_s"),
        (_changed(label="x" * 20_000), "label"),
        (msgpack.packb({"type": "Request", "version": 2, 3: 1, b"x": 2}), "torn"),
        (msgpack.packb({"type": "Request", "version": 2, "x": 1, b"x": 2}), "fields"),
        (msgpack.packb({"type": [1], "version": 2}), "was expected"),
        (b"\x91" * 5000, "torn"),
    ],
)
def test_a_stranger_is_refused_with_words(data: bytes, words: str) -> None:
    with pytest.raises(FormatError, match=words):
        Request.unpack(data)
