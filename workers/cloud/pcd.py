"""PCD files checked before they are read: common readers make up the points that a torn one lacks.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np

from station.core.files import read_regular
from workers.cloud.ply import MAX_BYTES

_KINDS = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
"""Types of a value and the bytes that it may take."""
_DIGITS = 12
"""A number of points has fewer."""
_LARGEST_RATIO = 88
"""LZF packs at most 264 bytes into 3."""
_MOST_KEYS = 16
"""Kinds of lines in a head: there are ten."""
_SIZES = struct.Struct("<II")
"""Bytes of the packed and of the unpacked points, ahead of packed ones."""


def check_pcd(path: Path) -> None:
    """Make sure that a PCD file holds the points that its head promises.

    Raises:
        ValueError: it is no such file, or is torn.
        OSError: the disk does not give it.
    """
    head, body = _parted(read_regular(path.resolve(), MAX_BYTES))
    points, values, row_bytes = _promised(head)
    kind = head["DATA"][0]
    if kind == "ascii":
        _check_rows(body, points, values)
        return
    if kind == "binary_compressed":
        if len(body) < _SIZES.size:
            raise ValueError("it is torn: no packed points follow its head")
        packed, unpacked = _SIZES.unpack_from(body)
        if unpacked != points * row_bytes or unpacked > _LARGEST_RATIO * packed:
            raise ValueError(
                f"its head promises {points} points of {row_bytes} bytes, and its data {unpacked} "
                f"bytes, packed into {packed}"
            )
        needed = _SIZES.size + packed
    else:
        needed = points * row_bytes
    if len(body) < needed:
        raise ValueError(f"it is torn: {needed} bytes of points were promised, {len(body)} came")


def _check_rows(body: bytes, points: int, values: int) -> None:
    rows = np.empty((0, values))
    try:
        # It warns of text without a row.
        if body.strip():
            rows = np.loadtxt(io.BytesIO(body), comments=None, ndmin=2)
    except ValueError as cause:
        # Behind the semicolon is advice to programmers.
        raise ValueError(f"it is torn, or no cloud: {str(cause).partition(';')[0]}") from None
    if len(rows) < points:
        raise ValueError(f"it is torn: {points} points were promised, {len(rows)} came")
    if rows.shape[1] != values:
        raise ValueError(f"its rows do not have the {values} values that its head names")


def _parted(content: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The words of each line of the head, by its first one, and what follows the head."""
    head, at = dict[str, list[str]](), 0
    while "DATA" not in head:
        end = content.find(b"\n", at)
        if end < 0 or len(head) > _MOST_KEYS:
            raise ValueError("it is not a PCD file")
        words = content[at:end].decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
        at = end + 1
    if head["DATA"] not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise ValueError(f"its data are {' '.join(head['DATA'])!a:.80}")
    return head, content[at:]


def _promised(head: dict[str, list[str]]) -> tuple[int, int, int]:
    """Points, values of each, and bytes of each, after a file's head."""
    fields, sizes, kinds = (head.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = head.get("COUNT", ["1"] * len(fields))
    points = head.get("POINTS", [])
    # Others may come twice: "_" is the name of padding.
    if [fields.count(name) for name in "xyz"] != [1, 1, 1]:
        raise ValueError("its points have no x, y, z, or a value twice")
    if not len(fields) == len(sizes) == len(kinds) == len(counts) or len(points) != 1:
        raise ValueError("its head lacks one of SIZE, TYPE, COUNT and POINTS, or a part of one")
    if not all(count.isdecimal() and len(count) < _DIGITS for count in (*points, *counts)):
        raise ValueError("its head has numbers of points or values that cannot be")
    if any(size not in _KINDS.get(kind, ()) for kind, size in zip(kinds, sizes, strict=True)):
        raise ValueError("its head has values of an unknown SIZE and TYPE")
    # Open3D takes them for 0.
    if head["DATA"] != ["ascii"] and "8" in (sizes[fields.index(name)] for name in "xyz"):
        raise ValueError("its x, y, z are numbers of 8 bytes; save them as 4 or as text")
    values = [int(count) for count in counts]
    row_bytes = sum(int(size) * count for size, count in zip(sizes, values, strict=True))
    return int(points[0]), sum(values), row_bytes
