"""Scans in the console's countdown, as the booth's other processes know of them.

The station gets the order when the countdown ends; until then the spool has nothing of the scan,
and commands would not find it. So the console keeps a file in the runtime folder:

    countdown/<scan id>.json        label, when the countdown ends
    countdown/<scan id>.cancelled   nothing

Control takes the first away when it gets the order. It refuses that of a scan that was cancelled
before, which may be on its way already.
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
    # One console, and one countdown at a time: what is there is over.
    for path in entries_of(folder):
        path.unlink(missing_ok=True)
    document = {"label": label, "ends_s": ends_s, "boot": boot_id()}
    write_json(_path(runtime_folder, scan_id), document, durable=False)


def end_countdown(runtime_folder: Path, scan_id: str) -> bool:
    """End the countdown, if it has one, of a scan that is ordered; whether nobody cancelled it."""
    _path(runtime_folder, scan_id).unlink(missing_ok=True)
    return not is_cancelled(runtime_folder, scan_id)


def cancel_countdown(runtime_folder: Path, scan_id: str) -> bool:
    """Cancel a scan in its countdown; whether it is cancelled, now or before."""
    path, cancelled = (_path(runtime_folder, scan_id, kind) for kind in ("json", "cancelled"))
    try:
        path.rename(cancelled)
    except FileNotFoundError:
        return is_cancelled(runtime_folder, scan_id)
    with suppress(OSError):  # its label is kept no longer than needed
        os.truncate(cancelled, 0)
    return True


def is_cancelled(runtime_folder: Path, scan_id: str) -> bool:
    """Whether a scan was cancelled in its countdown."""
    return os.path.lexists(_path(runtime_folder, scan_id, "cancelled"))


def counting_down(runtime_folder: Path) -> dict[str, str]:
    """Scans whose countdown runs, with their labels."""
    found = {}
    for path in entries_of(runtime_folder / _FOLDER):
        if path.suffix != ".json":
            continue
        with suppress(OSError, ValueError, KeyError, TypeError):
            document = read_bounded_json(path, _MAX_BYTES)
            over_s = time.monotonic() - float(document["ends_s"])
            if document["boot"] == boot_id() and over_s < _LATE_S:
                found[path.stem] = str(document["label"])
    return found


def _path(runtime_folder: Path, scan_id: str, kind: str = "json") -> Path:
    return runtime_folder / _FOLDER / f"{scan_id}.{kind}"
