"""The last check of the cameras, from a terminal or from the page, kept for the page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from station.calibration.moves.motion import CameraMove
from station.core.files import private_folder, utc_now, write_json

_FILE = "last-check.json"


def keep_check(folder: Path, moves: Sequence[CameraMove], depths: str = "") -> None:
    """Write down, in the console's folder, what a check has found now.

    Args:
        depths: words on depths that changed.
    """
    found = {
        "time": utc_now(),
        "moved": [move.camera for move in moves if move.moved or move.lost],
        "moves": [move.words() for move in moves if move.moved or move.lost],
        "changed": [move.camera for move in moves if move.changed],
        "depths": depths,
    }
    write_json(private_folder(folder) / _FILE, found)


def last_check(folder: Path) -> dict[str, Any] | None:
    """Time and findings of the last check; None if there was none."""
    try:
        document = json.loads((folder / _FILE).read_text())
    except (OSError, ValueError):
        return None
    return document if isinstance(document, dict) else None
