"""Scans in the console's countdown, as the booth's other processes know of them.

The station gets the order when the countdown ends; until then the spool has nothing of the scan,
and commands would not find it. So the console keeps a file in the runtime folder:

    countdown/<scan id>.json   label, when the countdown ends

Whoever removes it, the console at the end or control for a cancel, decides if the scan is taken.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

from station.core.files import entries_of, private_folder, read_bounded_json, write_json
from station.core.scans import boot_id

_FOLDER = "countdown"
_LATE_S = 5.0
"""Time after its end from which a countdown is over although its console left the file."""
_MAX_BYTES = 1 << 16


def begin_countdown(runtime_folder: Path, scan_id: str, label: str, ends_s: float) -> None:
    """Make a countdown known; ``ends_s`` in monotonic seconds."""
    folder = private_folder(runtime_folder / _FOLDER)
    # One console, and one countdown at a time: what is there was left by a console that was killed.
    for path in entries_of(folder):
        path.unlink(missing_ok=True)
    document = {"label": label, "ends_s": ends_s, "boot": boot_id()}
    write_json(folder / f"{scan_id}.json", document, durable=False)


def end_countdown(runtime_folder: Path, scan_id: str) -> bool:
    """End the countdown of a scan; whether it was running, and nobody else has ended it."""
    try:
        (runtime_folder / _FOLDER / f"{scan_id}.json").unlink()
    except FileNotFoundError:
        return False
    return True


def is_counting_down(runtime_folder: Path, scan_id: str) -> bool:
    """Whether nobody has ended the countdown of a scan, as far as the disk says."""
    return os.path.lexists(runtime_folder / _FOLDER / f"{scan_id}.json")


def counting_down(runtime_folder: Path) -> dict[str, str]:
    """Scans whose countdown runs, with their labels."""
    found = {}
    for path in entries_of(runtime_folder / _FOLDER):
        with suppress(OSError, ValueError, KeyError, TypeError):
            document = read_bounded_json(path, _MAX_BYTES)
            over_s = time.monotonic() - float(document["ends_s"])
            if document["boot"] == boot_id() and over_s < _LATE_S:
                found[path.stem] = str(document["label"])
    return found
