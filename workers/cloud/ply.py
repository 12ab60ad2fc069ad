"""PLY files checked value by value: common readers crash on torn ones, or make up what lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.core.files import read_regular

Array = NDArray[np.float64]

MAX_BYTES = 1 << 29
"""A scanner's raw cloud has tens of MB."""
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(slots=True)
class _Element:
    """One kind of row, as the file's head describes it."""

    name: str
    count: int
    scalars: list[tuple[str, str]] = field(default_factory=list)
    """Name and numpy's type of each single value."""
    lists: list[tuple[str, str]] = field(default_factory=list)
    """Types of a list's length and of its values."""


def read_points(path: Path) -> tuple[Array, Array | None]:
    """Points (n, 3) of a PLY file and their normals (n, 3), where it has them.

    Raises:
        ValueError: it is no such file, or is torn.
        OSError: the disk does not give it.
    """
    order, elements, body = _parted(path)
    rows, _ = _vertices(order, elements[0], body)
    names = [name for name, _ in elements[0].scalars]
    normals = _columns(rows, names, ("nx", "ny", "nz")) if "nx" in names else None
    return _columns(rows, names, ("x", "y", "z")), normals


def read_triangles(path: Path) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (n, 3) and triangles (m, 3) of a PLY file.

    Raises:
        ValueError: it is no such file, is torn, or its corners are no vertices.
        OSError: the disk does not give it.
    """
    order, elements, body = _parted(path)
    rows, rest = _vertices(order, elements[0], body)
    points = _columns(rows, [name for name, _ in elements[0].scalars], ("x", "y", "z"))
    faces = elements[1] if len(elements) > 1 else _Element("face", 0)
    if faces.name != "face" or len(faces.lists) != 1 or faces.scalars:
        raise ValueError("it has no list of triangles: fit a cloud of points first")
    if order:
        size, corner = (order + kind for kind in faces.lists[0])
        layout = np.dtype([("size", size), ("corners", corner, (3,))])
        found = _records(rest, layout, faces.count)
        sizes, corners = found["size"], found["corners"].astype(np.float64)
    else:
        table = _table(rest.split(), faces.count, 4)
        sizes, corners = table[:, 0], table[:, 1:]
    if (sizes != 3).any():
        raise ValueError("a face is no triangle")
    if not ((corners >= 0) & (corners < len(points))).all():
        raise ValueError("a corner is no vertex")
    return points, corners.astype(np.int32)


def _parted(path: Path) -> tuple[str, list[_Element], bytes]:
    """Byte order (empty for text), elements, and what follows the head."""
    head, end, body = read_regular(path.resolve(), MAX_BYTES).partition(b"\nend_header")
    if not head:
        raise ValueError("the file is empty")
    lines = [line.split() for line in head.decode("ascii", errors="replace").split("\n")]
    if not end or lines[0] != ["ply"] or len(lines) < 2:
        raise ValueError("it is not a PLY file")
    order, elements = "", list[_Element]()
    for words in lines[1:]:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, _] if kind in _ORDERS and not elements:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isdecimal() and len(count) < 12:
                elements.append(_Element(name, int(count)))
            case ["property", "list", size, value, _] if elements and {size, value} <= set(_TYPES):
                elements[-1].lists.append((_TYPES[size], _TYPES[value]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].scalars.append((name, _TYPES[kind]))
            case _:
                raise ValueError(f"its head has the line {' '.join(words)!a:.80}")
    if not elements or elements[0].name != "vertex" or elements[0].lists:
        raise ValueError("its first part is not a list of vertices")
    names = [name for name, _ in elements[0].scalars]
    if len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise ValueError("its vertices have no x, y, z, or a value twice")
    return order, elements, body[body.find(b"\n") + 1 :]


def _vertices(order: str, vertex: _Element, body: bytes) -> tuple[Array, bytes]:
    """A row of values for each vertex, and what follows them."""
    width = len(vertex.scalars)
    if order:
        layout = np.dtype([(name, order + kind) for name, kind in vertex.scalars])
        rows = _records(body, layout, vertex.count)
        table = np.empty((len(rows), width))
        for column, (name, _) in enumerate(vertex.scalars):
            table[:, column] = rows[name]
        return table, body[rows.nbytes :]
    words = body.split(maxsplit=vertex.count * width)
    rest = words.pop() if len(words) > vertex.count * width else b""
    return _table(words, vertex.count, width), rest


def _records(body: bytes, layout: np.dtype[np.void], count: int) -> NDArray[np.void]:
    needed = count * layout.itemsize
    if len(body) < needed:
        raise ValueError(f"it is torn: {needed} bytes of values were promised, {len(body)} came")
    return np.frombuffer(body, layout, count)


def _table(words: Sequence[bytes], count: int, width: int) -> Array:
    if len(words) < count * width:
        raise ValueError(f"it is torn: {count * width} values were promised, {len(words)} came")
    return np.array(words[: count * width], np.float64).reshape(count, width)


def _columns(table: Array, names: list[str], wanted: Sequence[str]) -> Array:
    if not set(wanted) <= set(names):
        raise ValueError(f"its vertices lack one of {', '.join(wanted)}")
    return np.ascontiguousarray(table[:, [names.index(name) for name in wanted]])
