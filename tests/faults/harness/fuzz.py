"""Messages and bundles that nobody in their right mind would send."""

from __future__ import annotations

import json
import random
import resource
import shutil
import tempfile
from pathlib import Path
from typing import Any

import msgpack
from table import Row

from station.core.bundle import read_bundle
from station.core.errors import BoothError
from station.messaging.messages import DesiredState, FrameHeader, Reply, Request, ScanEvent

_STRANGE: tuple[Any, ...] = (
    None, True, -1, 0, 2**63, 1e308, float("nan"), float("inf"), "", "x" * 300, b"\x00\xff",
    [], {}, [[]], {"a": {"b": []}}, "../../escape", "\x1b[2J\n", "é" * 70, 4_000_000_000, "0\x00",
)  # fmt: skip
_MAX_GROWTH_MB = 20.0
_MESSAGES = (Request, Reply, ScanEvent, DesiredState, FrameHeader)


def message_rows(count: int, seed: int) -> list[Row]:
    """Damage messages and unpack them: each is taken or refused with words."""
    rng = random.Random(seed)
    header = FrameHeader("a", "A1", 640, 480, 1e-4, 7, 6e7, 5.0, 5.0, 1, 0)
    whole = [
        Request("scan", "20260101T000000Z-0001", "Order 1", 5.0).pack(),
        Reply(True, "", {"a": [1]}).pack(),
        ScanEvent("s", "capturing", 1, 10).pack(),
        DesiredState(True).pack(),
        header.pack(),
    ]
    deaths, before_kb = 0, _peak_kb()
    for _ in range(count):
        data = _damaged(rng, rng.choice(whole))
        try:
            rng.choice(_MESSAGES).unpack(data)
        except BoothError as error:
            deaths += "\n" in str(error)
        except Exception:
            deaths += 1
    grown_mb = (_peak_kb() - before_kb) / 1024
    return [
        Row(
            "fuzzed messages",
            "0 deaths, 0 growth, words in one line",
            f"{count}, {deaths} deaths, {grown_mb:.1f} MB more",
            deaths == 0 and grown_mb < _MAX_GROWTH_MB,
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
    content = msgpack.unpackb(data)
    content[rng.choice([*content, "more"])] = rng.choice(_STRANGE)
    try:
        packed: bytes = msgpack.packb(content)
    except (ValueError, OverflowError):
        return b""
    return packed


def bundle_rows(bundle: Path, count: int, seed: int) -> list[Row]:
    """Damage a bundle's documents and frames and read it."""
    rng = random.Random(seed)
    deaths = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "scan"
        shutil.copytree(bundle, folder)
        files = [p for p in folder.rglob("*") if p.is_file()]
        documents = [path for path in files if path.suffix == ".json"]
        for _ in range(count):
            path = rng.choice(documents if rng.random() < 0.7 else files)
            whole = path.read_bytes()
            path.write_bytes(_spoilt_file(rng, path, whole))
            try:
                read = read_bundle(folder)
                camera = rng.choice(list(read.frames))
                read.read_frame(camera, rng.choice(read.frames[camera]))
            except BoothError as error:
                deaths += "\n" in str(error)
            except Exception:
                deaths += 1
            path.write_bytes(whole)
    peak_gb = _peak_kb() / 1e6
    return [
        Row(
            "fuzzed bundles and calibrations",
            "0 deaths, clear words, < 2 GB",
            f"{count}, {deaths} deaths, peak {peak_gb:.2f} GB",
            deaths == 0 and peak_gb < 2.0,
        )
    ]


def _spoilt_file(rng: random.Random, path: Path, whole: bytes) -> bytes:
    if path.suffix == ".json" and rng.random() < 0.8:
        document = json.loads(whole)
        _spoil(rng, document)
        return json.dumps(document).encode()
    spoilt = bytearray(whole)
    for _ in range(rng.randrange(1, 9)):
        spoilt[rng.randrange(min(len(spoilt), 4096))] = rng.randrange(256)
    return bytes(spoilt[: rng.randrange(len(spoilt))]) if rng.random() < 0.3 else bytes(spoilt)


def _spoil(rng: random.Random, document: Any) -> None:
    """Put something strange somewhere into a JSON document."""
    while True:
        keys = list(document) if isinstance(document, dict) else list(range(len(document)))
        if not keys:
            return
        key = rng.choice(keys)
        if isinstance(document[key], dict | list) and document[key] and rng.random() < 0.8:
            document = document[key]
            continue
        value = rng.choice(_STRANGE)
        document[key] = value if not isinstance(value, bytes) else None
        return


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
