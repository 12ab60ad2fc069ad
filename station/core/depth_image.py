"""Depth images: inverse depth, discontinuities, smooth fields over image and inverse depth, and
16-bit PNG files (W3C, Portable Network Graphics, third edition).

OpenCV is loaded where it is needed: a process that only reads the calibration does without its
60 MB.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

Image = NDArray[np.float32]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
JUMP_RATIO = 0.02
"""Neighbouring readings of one surface differ by less than this share of their depth a pixel."""
_MAX_CONTROL_POINTS = 64
"""Along an axis of a depth field; the solution uses less than twenty."""
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
_UNFILTERED, _SUB = 0, 1
"""Filters of a row: its bytes, or their differences from the pixel before, which OpenCV writes
unless it is told otherwise."""


def inverse_depth(depth_m: Image) -> Image:
    """1/z of depths (h, w) in metres; 0 (no reading) stays 0."""
    return np.divide(np.float32(1.0), depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)


def jumps(depth_m: Image, radius_px: int = 2) -> NDArray[np.bool_]:
    """Pixels within a radius of a depth discontinuity, where readings mix two surfaces."""
    import cv2

    window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    seen = depth_m > 0
    far = cv2.dilate(depth_m, window)
    near = cv2.erode(np.where(seen, depth_m, np.float32(99.0)), window)
    return np.asarray(seen & (far - near > JUMP_RATIO * radius_px * depth_m))


def quadratic_basis(at: Array, count: int) -> tuple[Indices, Array]:
    """First control point (n,) and the weights (n, 3) of it and the next two, at -1 to 1."""
    t = np.clip(0.5 * (at + 1.0), 0.0, 1.0) * (count - 2)
    first = np.minimum(t.astype(np.int64), count - 3)
    s = t - first
    return first, np.stack([0.5 * (1.0 - s) ** 2, 0.5 + s - s * s, 0.5 * s * s], axis=-1)


def linear_basis(at: Array, knots: Array) -> tuple[Indices, Array]:
    """First knot (n,) and the weights (n, 2) of it and the next one."""
    first = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    s = np.clip((at - knots[first]) / (knots[first + 1] - knots[first]), 0.0, 1.0)
    return first, np.stack([1.0 - s, s], axis=-1)


@dataclass(frozen=True, slots=True)
class DepthField:
    """A smooth field in 1/m, a tensor product of B-splines.

    f(x, y, w) = sum_kji c[k, j, i] L_k(w) Q_j(y) Q_i(x), with uniform quadratic B-splines Q over
    x, y from -1 to 1 (the image's width and height) and linear B-splines L with given knots in
    inverse depth w, constant beyond the outermost knots.
    """

    knots: tuple[float, ...]
    """(k,) inverse depths, 1/m, increasing; at least two."""
    control: Array
    """(k, j, i), 1/m."""

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> DepthField:
        """The field of a camera's depth_correction in calibration.json.

        Raises:
            KeyError: a key is missing.
            ValueError: it is no field of finite numbers, or has too many.
        """
        knots = np.asarray(fields["inverse_depth_per_m"], np.float64)
        control = np.asarray(fields["control_per_m"], np.float64)
        if (
            control.ndim != 3
            or knots.shape != control.shape[:1]
            or min(control.shape) < 2
            or min(control.shape[1:]) < 3
            or max(control.shape) > _MAX_CONTROL_POINTS
            or not np.isfinite(control).all()
            or not np.isfinite(knots).all()
            or not (np.diff(knots) > 0.0).all()
        ):
            raise ValueError("the field of depth_correction is not usable")
        return cls(tuple(float(knot) for knot in knots), control)

    def at(self, inverse: Array, x: Array, y: Array) -> Array:
        """Values (n,) at inverse depths and image positions (n,)."""
        k, weight_k = linear_basis(inverse, np.array(self.knots))
        j, weight_j = quadratic_basis(y, self.control.shape[1])
        i, weight_i = quadratic_basis(x, self.control.shape[2])
        total = np.zeros(np.shape(inverse))
        for a in range(2):
            for b in range(3):
                for c in range(3):
                    weight = weight_k[..., a] * weight_j[..., b] * weight_i[..., c]
                    total += weight * self.control[k + a, j + b, i + c]
        return total

    def over(self, inverse: Image) -> Image:
        """Values (h, w) at a whole image of inverse depths."""
        layers = _layers(self.control.tobytes(), self.control.shape, *inverse.shape)
        total = np.zeros_like(inverse)
        knots = self.knots
        for k, layer in enumerate(layers):
            # The hat function of knot k, constant beyond the ends.
            weight = np.ones_like(inverse)
            if k > 0:
                weight = np.clip((inverse - knots[k - 1]) / (knots[k] - knots[k - 1]), 0.0, 1.0)
            if k + 1 < len(knots):
                falling = (knots[k + 1] - inverse) / (knots[k + 1] - knots[k])
                weight = np.minimum(weight, np.clip(falling, 0.0, 1.0))
            total += weight * layer
        return np.asarray(total, np.float32)


@lru_cache(maxsize=16)
def _layers(control: bytes, shape: tuple[int, int, int], height: int, width: int) -> Image:
    """The field at each knot over the whole image, (k, height, width)."""
    values = np.frombuffer(control).reshape(shape)
    across, down = _basis_matrix(width, shape[2]), _basis_matrix(height, shape[1])
    return np.asarray(np.einsum("vj,kji,ui->kvu", down, values, across, optimize=True), np.float32)


def _basis_matrix(pixels: int, count: int) -> Array:
    first, weight = quadratic_basis(np.linspace(-1.0, 1.0, pixels), count)
    matrix = np.zeros((pixels, count))
    for k in range(3):
        matrix[np.arange(pixels), first + k] = weight[:, k]
    return matrix


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
        image = _unfiltered(by_row[:, 0], by_row[:, 1:])
        if image is not None:
            return image
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
