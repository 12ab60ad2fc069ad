"""Folders of recordings that a technician takes for others."""

from __future__ import annotations

from pathlib import Path

from station.calibration.detect.step_names import EMPTY, HANGING, STAND, raised_step
from station.core.errors import CalibrationError


def check_folder(recordings: Path) -> None:
    """Refuse the folder above that of a calibration's recordings.

    Raises:
        CalibrationError: naming the folder that was meant.
    """
    if (recordings / EMPTY).is_dir():
        return
    meant = sorted(path for path in recordings.iterdir() if (path / EMPTY).is_dir())
    if meant:
        raise CalibrationError(
            f"{recordings} holds no recordings of a calibration, but {meant[0]} does: "
            f"--recordings {meant[0]}"
        )


def check_height(recordings: Path, kind: str, height_m: float) -> None:
    """Refuse a height of the ball on a stand that was recorded as one of the hanging ball, or the
    other way round.

    Raises:
        CalibrationError: naming the option that helps.
    """
    other = HANGING if kind == STAND else STAND
    step = raised_step(other, height_m)
    if (recordings / raised_step(kind, height_m)).is_dir() or not (recordings / step).is_dir():
        return
    remedy = "add --hanging" if other == HANGING else "leave --hanging out"
    raise CalibrationError(
        f"{recordings} holds no recording of the step {raised_step(kind, height_m)}, but {step}: "
        f"{remedy}"
    )
