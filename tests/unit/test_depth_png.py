"""16-bit PNG files as other programs write them, and torn ones."""

import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from station.core.depth.png import image_of_png, png_of, png_size

Writer = Callable[[NDArray[np.uint16]], bytes]
RNG = np.random.default_rng(0)
DEPTH = (2000 + np.add.outer(np.arange(48), 3 * np.arange(64))).astype(np.uint16)
DEPTH[RNG.random(DEPTH.shape) < 0.2] = 0
WRITERS: dict[str, Writer] = {
    "booth": png_of,
    "OpenCV": lambda image: cv2.imencode(".png", image)[1].tobytes(),
    "changing filters": lambda image: cv2.imencode(
        ".png",
        image,
        [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_ALL_FILTERS],
    )[1].tobytes(),
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("size", [(48, 64), (1, 1), (7, 3)])
def test_whoever_wrote_it(writer: str, size: tuple[int, int]) -> None:
    image = np.ascontiguousarray(DEPTH[: size[0], : size[1]])
    content = WRITERS[writer](image)
    assert png_size(content) == size
    found = image_of_png(content)
    assert found is not None
    assert found.dtype == np.uint16
    assert np.array_equal(found, image)


def test_the_writers_differ() -> None:
    """Unfiltered rows, differences from the pixel before, and a filter for each row."""
    kinds = [
        set(zlib.decompress(_rows(writer(DEPTH)))[:: 1 + 2 * 64]) for writer in WRITERS.values()
    ]
    assert kinds[:2] == [{0}, {1}]
    assert len(kinds[2]) > 1


@pytest.mark.parametrize("writer", WRITERS)
def test_no_changed_byte_goes_unnoticed(writer: str) -> None:
    content = WRITERS[writer](DEPTH)
    for at in range(33, len(content) - 12, 37):
        torn = bytearray(content)
        torn[at] ^= 0x10
        assert image_of_png(bytes(torn)) is None


@pytest.mark.parametrize("rows", [0, 20, 47, 49])
def test_an_image_has_all_of_its_rows_and_no_more(rows: int) -> None:
    """A sound file whose rows are fewer than its header says would be black below."""
    plain = np.zeros((rows, 1 + 2 * 64), np.uint8).tobytes()
    assert image_of_png(_file(64, 48, zlib.compress(plain))) is None


@pytest.mark.parametrize("packed", [b"", b"no zlib", zlib.compress(bytes(48 * 129))[:-8]])
def test_what_cannot_be_inflated_is_torn(packed: bytes) -> None:
    assert image_of_png(_file(64, 48, packed)) is None


_ROWS = bytes(48 * 129)
_HEADER = struct.pack(">IIBBBBB", 64, 48, 16, 0, 0, 0, 0)
_PACKED = zlib.compress(_ROWS)


def _open_stream() -> bytes:
    stream = zlib.compressobj()
    return stream.compress(_ROWS) + stream.flush(zlib.Z_SYNC_FLUSH)


@pytest.mark.parametrize(
    "chunks",
    [
        [(b"IDAT", _PACKED[:-4])],
        [(b"IDAT", _open_stream())],
        [(b"IDAT", _PACKED + b"more")],
        [(b"IHDR", _HEADER), (b"IDAT", _PACKED)],
        [(b"IDAT", _PACKED[:9]), (b"tEXt", b"a\0b"), (b"IDAT", _PACKED[9:])],
        [(b"IDAT", _PACKED), (b"IEND", b"")],
        [(b"ABCD", b""), (b"IDAT", _PACKED)],
        [(b"acTL", bytes(8)), (b"IDAT", _PACKED)],
        [],
    ],
    ids=[
        "no checksum", "no end", "more behind", "two headers", "chunk between", "two ends",
        "unknown", "animated", "no image",
    ],
)  # fmt: skip
def test_what_no_program_writes_is_not_read(chunks: list[tuple[bytes, bytes]]) -> None:
    """Only OpenCV refused some of these, or read another picture from them."""
    assert image_of_png(_chunks([(b"IHDR", _HEADER), *chunks, (b"IEND", b"")])) is None


def test_an_interlaced_image_with_a_wrong_checksum_is_torn() -> None:
    """OpenCV reads it without a word, in other depths."""
    header = struct.pack(">IIBBBBB", 1, 1, 16, 0, 0, 0, 1)
    packed = bytearray(zlib.compress(b"\0\x10\x20"))
    for wrong in (0, 1):
        packed[-1] ^= wrong
        content = _chunks([(b"IHDR", header), (b"IDAT", bytes(packed)), (b"IEND", b"")])
        assert (image_of_png(content) is None) == bool(wrong)


def test_the_shortest_files_are_no_images() -> None:
    assert png_size(b"\x89PNG\r\n\x1a\nIENDIHDR") is None


@pytest.mark.parametrize(
    "image", [np.zeros((2, 2), np.float32), np.zeros((0, 2), np.uint16), np.zeros(4, np.uint16)]
)
def test_only_depths_are_written(image: NDArray[np.uint16]) -> None:
    with pytest.raises(ValueError, match="no image of 16-bit values"):
        png_of(image)


def test_eight_bits_are_left_to_who_asks() -> None:
    """A bundle refuses them; it says what it found."""
    found = image_of_png(cv2.imencode(".png", DEPTH.astype(np.uint8))[1].tobytes())
    assert found is not None
    assert found.dtype == np.uint8


def _file(width: int, height: int, packed: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return _chunks([(b"IHDR", header), (b"IDAT", packed), (b"IEND", b"")])


def _chunks(chunks: list[tuple[bytes, bytes]]) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _rows(content: bytes) -> bytes:
    at, packed = 8, b""
    while at < len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        if content[at + 4 : at + 8] == b"IDAT":
            packed += content[at + 8 : at + 8 + length]
        at += 12 + length
    return packed


@pytest.mark.parametrize("name", [b"iCCP", b"tIME", b"PLTE"])
def test_nothing_is_said_of_what_else_a_file_holds(
    name: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    """Warnings of a library stood on the terminal, between the steps of a fit."""
    content = WRITERS["changing filters"](DEPTH)
    found = image_of_png(content[:33] + _chunk(name, b"odd") + content[33:])
    assert found is not None
    assert np.array_equal(found, DEPTH)
    assert capfd.readouterr() == ("", "")


def test_an_unknown_filter_is_torn(capfd: pytest.CaptureFixture[str]) -> None:
    assert image_of_png(_file(64, 48, zlib.compress(b"\5".ljust(129, b"\0") * 48))) is None
    assert capfd.readouterr() == ("", "")
