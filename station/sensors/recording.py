"""Recordings in the format of libfreenect's replay library.

A folder with INDEX.txt, one file name a line; depth frames are d-<seconds>-<ticks>-<number>.pgm,
each a one-line header `P5 640 480 65535` and little-endian 16-bit raw 11-bit disparities.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.core.errors import FormatError
from station.core.kinect_v1 import HEIGHT, TICK_BITS, TICK_HZ, WIDTH

INDEX = "INDEX.txt"
_HEADER = f"P5 {WIDTH} {HEIGHT} 65535\n".encode()
_SHAPE = (HEIGHT, WIDTH)
_OTHER_PATH = (
    "correct the recording's path in booth.toml or after --recordings; station record-virtual "
    "--out FOLDER makes recordings"
)
_HALF_TURN_S = 0.5 * 2**TICK_BITS / TICK_HZ
"""Within half a turn of the counter no ticks come again; after a whole one they may."""


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """One depth frame of a recording."""

    seconds: float
    """Time at which it was received; the replay library uses it for pacing."""
    ticks: int
    """Device timestamp, 32 bits."""
    raw: NDArray[np.uint16]
    """(480, 640) raw 11-bit disparity, 2047 = no reading."""


def write_recording(
    folder: Path, frames: Iterable[RecordedFrame], *, tick_hz: float, passes: int = 1
) -> int:
    """Write a recording, replacing one of the same name; returns how many frames it holds.

    Further passes repeat the frames with times and ticks that go on. Equal frames are hard links: a
    minute takes no more disk than its first seconds.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    first: list[tuple[float, int, str]] = []
    written: dict[bytes, str] = {}
    for frame in frames:
        name = _name(frame.seconds, frame.ticks, len(first))
        data = _HEADER + frame.raw.astype("<u2").tobytes()
        digest = hashlib.sha256(data).digest()
        if digest in written:
            os.link(folder / written[digest], folder / name)
        else:
            (folder / name).write_bytes(data)
            written[digest] = name
        first.append((frame.seconds, frame.ticks, name))
    names = [name for _, _, name in first]
    span_s = first[-1][0] - first[0][0]
    period_s = span_s + span_s / max(len(first) - 1, 1)
    for again in range(1, passes):
        later_s = again * period_s
        for seconds, ticks, original in first:
            name = _name(seconds + later_s, (ticks + round(later_s * tick_hz)) % 2**32, len(names))
            os.link(folder / original, folder / name)
            names.append(name)
    (folder / INDEX).write_text("".join(f"{name}\n" for name in names))
    return len(names)


def _name(seconds: float, ticks: int, number: int) -> str:
    return f"d-{seconds:.6f}-{ticks}-{number:06d}.pgm"


def check_recording(folder: Path) -> list[tuple[float, int, Path]]:
    """The depth frames (seconds, ticks, file) that a recording's index lists.

    Raises:
        FormatError: naming the file that is missing, torn or misnamed.
    """
    index = folder / INDEX
    try:
        lines = index.read_text().splitlines()
    except OSError as cause:
        gone = isinstance(cause, FileNotFoundError) and not folder.is_dir()
        what = (
            f"there is no recording {folder}"
            if gone
            else f"{index} cannot be read ({cause.strerror})"
        )
        raise FormatError(f"{what}; {_OTHER_PATH}") from None
    except UnicodeDecodeError as cause:
        raise FormatError(f"{index} is not text ({cause}); record again") from None
    frames: list[tuple[float, int, Path]] = []
    known: dict[int, tuple[int, float]] = {}
    for number, line in enumerate(lines, 1):
        name, where = line.strip(), f"{index}, line {number}"
        if not name.startswith("d-"):
            continue
        path = folder / name
        try:
            _, before, after, _ = name.split("-", 3)
            seconds, ticks = float(before), int(after)
            if not math.isfinite(seconds) or ticks >= 1 << TICK_BITS:
                raise ValueError
            size = path.stat().st_size
        except ValueError:
            raise FormatError(
                f"{where}: {name!a:.120} is not d-<seconds>-<ticks of {TICK_BITS} bits>-...pgm; "
                "record again"
            ) from None
        except OSError:
            raise FormatError(f"{path} is missing; record again") from None
        if size != len(_HEADER) + 2 * _SHAPE[0] * _SHAPE[1]:
            raise FormatError(f"{path} is torn ({size} bytes); record again")
        # A calibration finds a frame's time and file by its ticks.
        same, then = known.get(ticks, (0, -math.inf))
        if abs(seconds - then) < _HALF_TURN_S:
            raise FormatError(f"{where}: its ticks are those of line {same}; record again")
        known[ticks] = number, seconds
        frames.append((seconds, ticks, path))
    if not frames:
        raise FormatError(f"{index} lists no depth frame; record again")
    # Ticks may start over, as those of a sensor that was plugged in again. Times may not: a replay
    # takes the length of a pass from them.
    if frames[-1][0] < frames[0][0]:
        raise FormatError(f"{index}: its last frame is earlier than its first; record again")
    return frames


def read_raw(path: Path) -> NDArray[np.uint16]:
    """The raw disparities (480, 640) of one frame file."""
    data = path.read_bytes()
    if not data.startswith(_HEADER):
        raise FormatError(f"{path} does not start with {_HEADER!r}; record again")
    return np.frombuffer(data, "<u2", offset=len(_HEADER)).reshape(_SHAPE)
