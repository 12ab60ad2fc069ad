"""Folders of recordings, and those that a technician takes for others."""

from __future__ import annotations

import hashlib
from pathlib import Path

from station.calibration.detect.step_names import (
    EMPTY,
    HANGING,
    STAND,
    kind_of,
    raised_height_m,
    raised_step,
)
from station.core.errors import CalibrationError
from station.sensors.recording import INDEX


def check_folder(recordings: Path) -> None:
    """Refuse the folder above that of a calibration's recordings.

    Raises:
        CalibrationError: naming the folder that was meant.
    """
    if (recordings / EMPTY).is_dir():
        return
    if meant := _folders_with(recordings, EMPTY):
        raise CalibrationError(
            f"{recordings} holds no recordings of a calibration, but {meant[0]} does: "
            f"--recordings {meant[0]}"
        )


def step_folder(recordings: Path, step: str) -> Path:
    """The folder of a step's recordings, one in it for each camera.

    Raises:
        CalibrationError: there is none; naming the folder or the option that helps.
    """
    folder = recordings / step
    if folder.is_dir():
        return folder
    missing = f"{recordings} holds no recording of the step {step}"
    if height_m := raised_height_m(step):
        other = raised_step(STAND if kind_of(step) == HANGING else HANGING, height_m)
        remedy = "leave --hanging out" if kind_of(step) == HANGING else "add --hanging"
        if (recordings / other).is_dir():
            raise CalibrationError(f"{missing}, but {other}: {remedy}")
    known = ", ".join(sorted(path.name for path in recordings.iterdir())) or "nothing"
    deeper = _folders_with(recordings, step)
    hint = f" ({deeper[0]} does)" if deeper else ""
    raise CalibrationError(f"{missing}; it holds {known}{hint}")


def fingerprint(folder: Path) -> str:
    """A digest of a step's lists of frames: their times and names differ between recordings."""
    lists = sorted(folder.glob(f"*/{INDEX}"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in lists)).hexdigest()[:16]


def _folders_with(recordings: Path, step: str) -> list[Path]:
    return sorted(path for path in recordings.iterdir() if (path / step).is_dir())
