"""Depth images as 16-bit PNG files (W3C, Portable Network Graphics, third edition).

OpenCV is loaded where it is needed, as in `station.core.depth.images`.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_START = _PNG_SIGNATURE + b"\0\0\0\x0dIHDR"
"""The first chunk of 13 bytes begins every file."""
_SHORTEST_PNG = 57
"""Bytes of a file whose IDAT chunk is empty."""
_ANIMATED = b"acTL"
_CRITICAL = (b"IHDR", b"PLTE", b"IDAT", b"IEND")
"""Chunks without which an image cannot be read; the names of no others begin with a capital."""
_LARGEST_PIXEL = 8
"""Bytes."""
_PLAIN_GREY16 = bytes([16, 0, 0, 0, 0])
"""Depth, colour, compression, filter method and interlacing of the images that are read here."""
_UNFILTERED, _SUB, _LAST_FILTER = 0, 1, 4
"""Filters of a row: its bytes, or their differences from the pixel before, which OpenCV writes
unless it is told otherwise."""


def png_of(depth: NDArray[np.uint16]) -> bytes:
    """Content of a 16-bit PNG file.

    Raises:
        ValueError: it is no image (h, w) of 16-bit values.
    """
    import cv2

    if depth.dtype != np.uint16 or depth.ndim != 2 or not depth.size:
        raise ValueError(f"{depth.dtype} {depth.shape} is no image of 16-bit values")
    # A sensor has few distinct depths: whole readings repeat, differences of neighbours do not. So
    # files are smaller unfiltered, and quicker to write and to read.
    fast = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)
    done, content = cv2.imencode(".png", depth, fast)
    if not done:
        raise ValueError("cannot be written as a PNG")
    return content.tobytes()


def png_size(data: bytes) -> tuple[int, int] | None:
    """Height and width from a PNG file's first chunk; None if it is torn or not a PNG."""
    if len(data) < _SHORTEST_PNG or not data.startswith(_PNG_START) or data[-8:-4] != b"IEND":
        return None
    width, height = struct.unpack(">II", data[16:24])
    return height, width


def image_of_png(data: bytes) -> NDArray[np.uint8 | np.uint16] | None:
    """The image in a PNG file, whose size was looked at before; None if it is torn.

    The kinds that OpenCV writes are unpacked here: a scan has 40, ISA-L inflates them in a third of
    zlib's time, and then only bytes are swapped. OpenCV reads the others. It silently decodes a
    torn PNG to black rows, so the chunks' checksums are compared first.
    """
    packed = _image_data(data)
    if packed is None:
        return None
    width, height = struct.unpack(">II", data[16:24])
    plain = data[24:29] == _PLAIN_GREY16
    # Twice as much as its rows: interlaced ones have a few bytes more.
    rows = 1 + 2 * width if plain else 2 * (1 + _LARGEST_PIXEL * width)
    content = _inflated(packed, height * rows)
    if content is None:
        return None
    if plain:
        if len(content) != height * rows:
            return None
        by_row = np.frombuffer(content, np.uint8).reshape(height, rows)
        if (by_row[:, 0] > _LAST_FILTER).any():
            return None
        image = _unfiltered(by_row[:, 0], by_row[:, 1:])
        if image is not None:
            return image
    if data[24:26] == _PLAIN_GREY16[:2]:
        # Its reader warns of what other chunks hold, on the terminal.
        data = _PNG_START + data[16:33] + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")
    import cv2

    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return None if found is None else np.asarray(found)


def _image_data(data: bytes) -> bytes | None:
    """The compressed rows, from all IDAT chunks; None if a chunk is torn or out of its order."""
    at, names, pieces = len(_PNG_SIGNATURE), [], []
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        content = data[at + 4 : at + 8 + length]
        if data[at + 8 + length : at + 12 + length] != struct.pack(">I", zlib.crc32(content)):
            return None
        names.append(content[:4])
        if names[-1] == b"IDAT":
            pieces.append(content[4:])
        at += 12 + length
    whole = at == len(data) and names[-1:] == [b"IEND"]
    return b"".join(pieces) if whole and _in_order(names) else None


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)


def _in_order(names: list[bytes]) -> bool:
    """Whether chunks, the first and last of which are known, are those of one still image."""
    first = names.index(b"IDAT") if b"IDAT" in names else 0
    count = names.count(b"IDAT")
    return (
        count > 0
        and names[first : first + count] == [b"IDAT"] * count
        and names.count(b"IHDR") == names.count(b"IEND") == 1
        and _ANIMATED not in names
        and all(name in _CRITICAL for name in names if name[:1].isupper())
    )


def _inflated(packed: bytes, most: int) -> bytes | None:
    """The image's rows, each after the byte of its filter; None if they are torn or too many."""
    stream = isal_zlib.decompressobj()
    try:
        # One byte more than there may be, and never what a small file may claim to hold.
        content = stream.decompress(packed, most + 1)
    except isal_zlib.error:  # type: ignore[misc]  # its stub declares an instance
        return None
    # At its end the stream's checksum has been compared.
    return bytes(content) if stream.eof and not stream.unused_data else None


def _unfiltered(filters: NDArray[np.uint8], pixels: NDArray[np.uint8]) -> NDArray[np.uint16] | None:
    """The image, if all of its rows have the same one of two filters."""
    if (filters == _SUB).all():
        high_and_low = pixels.reshape(len(pixels), -1, 2)
        pixels = np.cumsum(high_and_low, axis=1, dtype=np.uint8).reshape(pixels.shape)
    elif (filters != _UNFILTERED).any():
        return None
    return np.ascontiguousarray(pixels).view(">u2").astype(np.uint16)
