"""Infrared images of a ChArUco board: lenses, and the calibration in use, judged by them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from station.calibration.detect.board import (
    Board,
    BoardView,
    check_agreement,
    find_board,
    judge_lens,
)
from station.calibration.guide.attempt import Attempt
from station.calibration.guide.seen import Lens
from station.calibration.guide.session import Session
from station.core.errors import CalibrationError
from station.core.rig import Rig

_IMAGES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif")


def judge_lenses(attempt: Attempt, images: Path, printed: Board) -> None:
    """Say what images DIR/<camera>/<moment>.png tell of each lens, and keep better ones.

    Raises:
        CalibrationError: no image has the board, or one cannot be read.
    """
    session = attempt.session()
    views: dict[str, list[BoardView]] = {}
    for name in session.cameras:
        views[name] = _board_views(images / name, printed, session, name)
        count = len(views[name])
        images_words = "1 image" if count == 1 else f"{count} images"
        attempt.guide.say(f"camera {name}: the board is seen in {images_words}")
    if not any(views.values()):
        raise CalibrationError(
            f"{images} has no image of the board: DIR/<camera>/<moment>.png, cameras "
            f"{', '.join(session.cameras)}"
        )
    if attempt.store.in_use.exists():
        ties = check_agreement(Rig.load(attempt.store.in_use), views, printed)
        for (one, other), off_m in ties.pairs.items():
            attempt.guide.say(
                f"{one} and {other} see the board's corners {1e3 * off_m:.1f} mm apart "
                "through the calibration in use"
            )
    found: dict[str, Lens | None] = {}
    for name, seen in views.items():
        report = judge_lens(session.cameras[name], seen, printed)
        attempt.guide.say(report.words())
        lens = report.lens
        found[name] = None if lens is None else Lens(lens.K.tolist(), lens.distortion.tolist())
    session.record_lenses(found)


def _board_views(folder: Path, printed: Board, session: Session, name: str) -> list[BoardView]:
    camera = session.cameras[name]
    views = []
    for path in sorted(folder.glob("*")) if folder.is_dir() else []:
        if path.suffix.lower() not in _IMAGES:
            continue
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CalibrationError(f"{path} cannot be read as an image; remove it")
        if image.shape != (camera.height, camera.width):
            raise CalibrationError(
                f"{path} is {image.shape[1]} x {image.shape[0]}; camera {name} has "
                f"{camera.width} x {camera.height}"
            )
        view = find_board(np.asarray(image, np.uint8), printed, path.stem)
        if view is not None:
            views.append(view)
    return views
