"""Checks of the lenses and of a calibration with a ChArUco board in infrared images.

Free intrinsics can give the same reprojection error as the factory's and yet put points centimetres
off. So they are taken only when two halves of the views agree about them in millimetres where the
person stands, and when they predict views that were held out better than the factory's do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.errors import CalibrationError
from station.core.geometry import rigid, so3_exp, transform
from station.core.lens import pixel_rays, project
from station.core.rig import CameraCalibration, Rig

Array = NDArray[np.float64]

WORKING_DISTANCE_M = 1.7
"""Distance of the person from a camera."""
_MIN_CORNERS = 8
_MIN_MARKERS = 4
_MIN_VIEWS = 12
_OTHER_LAYOUT_PX = 6.0
_CERTAIN_M = 0.0015
"""A lens has to be known so well, in 95 % of the image, at the working distance."""
_BETTER = 0.9
"""Held-out errors have to fall below this share of the factory's."""
_OTHER_SENSOR = 0.03
"""A unit's focal length varies by less; colour and depth differ by more."""
_SIZE_TOLERANCE = 0.02
_HELD_OUT_EVERY = 3
_FIXED = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST


@dataclass(frozen=True, slots=True)
class Board:
    """A printed ChArUco board: squares across and down, their size, the markers in them."""

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_4X4_100"

    def printed(self) -> Any:
        """OpenCV's board.

        Raises:
            CalibrationError: no such board can be printed.
        """
        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or number is None:
            raise CalibrationError(
                f"there is no marker dictionary {self.dictionary}; DICT_4X4_100 is one"
            )
        if min(self.columns, self.rows) < 3 or not 0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"a board of {self.columns} x {self.rows} squares of {self.square_m} m with "
                f"markers of {self.marker_m} m is not possible: use at least 3 x 3 squares, and "
                "markers smaller than the squares"
            )
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        if dictionary.bytesList.shape[0] < self.columns * self.rows // 2:
            raise CalibrationError(
                f"{self.dictionary} has too few markers for {self.columns} x {self.rows} squares"
            )
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, dictionary
        )

    def corners_m(self) -> Array:
        """(n, 3) inner corners by id, in the board's plane."""
        return np.asarray(self.printed().getChessboardCorners(), np.float64)


@dataclass(frozen=True, slots=True)
class BoardView:
    """The board in one image."""

    moment: str
    """The image's name: images of the same name were taken at the same time."""
    ids: NDArray[np.int64]
    """(n,) corners seen."""
    pixels: Array
    """(n, 2)"""


@dataclass(frozen=True, slots=True)
class LensReport:
    """The judgement of a camera's lens from its views."""

    camera: str
    views: int
    factory_m: float
    """Held-out error of the factory's lens on the board, rms."""
    free_m: float
    """The same of the lens that the views give."""
    certain_m: float
    """Uncertainty of the lens in 95 % of the image at 1.7 m: how far two
    halves of them disagree."""
    lens: CameraCalibration | None
    """The camera with the new lens where it is to be trusted more."""

    def words(self) -> str:
        start = f"camera {self.camera}: {self.views} views"
        if self.views < _MIN_VIEWS:
            return f"{start}; the factory's lens is kept, {_MIN_VIEWS} are needed to judge it"
        figures = (
            f"held-out corners {1e3 * self.factory_m:.2f} mm off with the factory's lens, "
            f"{1e3 * self.free_m:.2f} mm with one from the board, which is certain to "
            f"{1e3 * self.certain_m:.1f} mm at {WORKING_DISTANCE_M} m"
        )
        if self.lens is not None:
            return f"{start}; {figures}: the board's lens is used"
        if self.certain_m > _CERTAIN_M:
            return (
                f"{start}; {figures}: they do not constrain the lens, the factory's is kept "
                "(tilt the board more, show it in the image's corners)"
            )
        return f"{start}; {figures}: the factory's lens is kept"


def find_board(image: NDArray[np.uint8], board: Board, moment: str) -> BoardView | None:
    """The board's corners in a grey image (h, w); None where too few are seen.

    Raises:
        CalibrationError: it is a board of another layout.
    """
    printed = board.printed()
    corners, ids, markers, marker_ids = cv2.aruco.CharucoDetector(printed).detectBoard(image)
    if np.size(marker_ids) > 1:
        numbers = np.array(marker_ids, np.int64).ravel()
        _check_layout(board, moment, np.array(markers, np.float64), numbers)
    if np.size(ids) < _MIN_CORNERS:
        return None
    return BoardView(
        moment, np.asarray(ids, np.int64).ravel(), np.asarray(corners, np.float64).reshape(-1, 2)
    )


def _check_layout(board: Board, moment: str, pixels: Array, ids: NDArray[np.integer[Any]]) -> None:
    """Markers (n, 1, 4, 2) have to lie where the board's own do."""
    another = (
        f"it is a board of another size than {board.columns} x {board.rows} squares; give its own "
        "with --squares"
    )
    printed = board.printed()
    places = dict(zip(np.asarray(printed.getIds()).ravel(), printed.getObjPoints(), strict=True))
    strange = sorted(set(ids.tolist()) - set(places))
    if len(strange) > 1:
        raise CalibrationError(
            f"image {moment} shows markers {strange[0]}, {strange[1]}: {another}"
        )
    known = [index for index, number in enumerate(ids.tolist()) if number in places]
    if len(known) < _MIN_MARKERS:
        return
    flat = np.concatenate([np.asarray(places[ids[index]])[:, :2] for index in known])
    seen = pixels[known].reshape(-1, 2)
    mapping, _ = cv2.findHomography(flat.astype(np.float64), seen, cv2.LMEDS)
    off = seen - cv2.perspectiveTransform(flat[:, None].astype(np.float64), mapping)[:, 0]
    if float(np.percentile(np.linalg.norm(off, axis=1), 90)) > _OTHER_LAYOUT_PX:
        raise CalibrationError(f"image {moment}: its markers are arranged differently, {another}")


def judge_lens(camera: CameraCalibration, views: Sequence[BoardView], board: Board) -> LensReport:
    """Judge whether the views give a better lens than the factory's, on held-out views."""
    if len(views) < _MIN_VIEWS:
        return LensReport(camera.name, len(views), np.nan, np.nan, np.nan, None)
    held_out = views[::_HELD_OUT_EVERY]
    used = [view for index, view in enumerate(views) if index % _HELD_OUT_EVERY]
    free = _fitted(camera, used, board)
    halves = [_fitted(camera, used[start::2], board) for start in (0, 1)]
    report = LensReport(
        camera=camera.name,
        views=len(views),
        factory_m=_held_out_m(camera, held_out, board),
        free_m=_held_out_m(free, held_out, board),
        # Each half has so much more variance than the whole, and their difference twice that.
        certain_m=_apart_m(*halves) * float(np.sqrt(0.25 * len(used) / len(views))),
        lens=None,
    )
    if report.certain_m > _CERTAIN_M or report.free_m >= _BETTER * report.factory_m:
        return report
    lens = _fitted(camera, views, board)
    apart = float(np.abs(np.diag(lens.K)[:2] / np.diag(camera.K)[:2] - 1.0).max())
    if apart > _OTHER_SENSOR:
        raise CalibrationError(
            f"camera {camera.name}: the images' focal length is {100 * apart:.0f} % off its depth "
            "lens: give infrared images, colour ones have another lens"
        )
    return replace(report, lens=lens)


def _fitted(
    camera: CameraCalibration, views: Sequence[BoardView], board: Board
) -> CameraCalibration:
    """The camera with the intrinsics that the views fit best (Zhang 2000), started from its own."""
    corners = board.corners_m().astype(np.float32)
    _, K, distortion, _, _ = cv2.calibrateCamera(
        [corners[view.ids] for view in views],
        [view.pixels.astype(np.float32) for view in views],
        (camera.width, camera.height),
        camera.K.copy(),
        camera.distortion.copy(),
        flags=_FIXED,
    )
    return replace(
        camera, K=np.array(K, np.float64), distortion=np.array(distortion, np.float64).ravel()[:5]
    )


def _held_out_m(camera: CameraCalibration, views: Sequence[BoardView], board: Board) -> float:
    """Rms distance on the board between corners and where the other half of them predicts them."""
    off = []
    for view in views:
        for half in (0, 1):
            chosen = np.arange(len(view.ids)) % 2 == half
            if chosen.sum() < 4:
                continue
            camera_from_board = _placed(camera, view, board, chosen)
            rest = board.corners_m()[view.ids[~chosen]]
            there = transform(camera_from_board, rest)
            error_px = np.linalg.norm(project(camera, there) - view.pixels[~chosen], axis=1)
            off.append(error_px * there[:, 2] / camera.K[0, 0])
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _placed(
    camera: CameraCalibration,
    view: BoardView,
    board: Board,
    chosen: NDArray[np.bool_] | None = None,
) -> Array:
    """camera_from_board (4, 4) of the chosen corners."""
    kept = slice(None) if chosen is None else chosen
    _, turn, shift = cv2.solvePnP(
        board.corners_m()[view.ids[kept]],
        view.pixels[kept],
        camera.K,
        camera.distortion,
        flags=cv2.SOLVEPNP_IPPE,
    )
    return rigid(so3_exp(turn.ravel()), shift.ravel())


def _apart_m(one: CameraCalibration, other: CameraCalibration) -> float:
    """Distance between the points that two lenses give a pixel at 1.7 m, 95th percentile."""
    u, v = np.meshgrid(np.linspace(0, one.width - 1, 17), np.linspace(0, one.height - 1, 13))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    ahead = [pixel_rays(camera, pixels) for camera in (one, other)]
    return float(
        WORKING_DISTANCE_M * np.percentile(np.linalg.norm(ahead[0] - ahead[1], axis=1), 95)
    )


@dataclass(frozen=True, slots=True)
class AgreementReport:
    """Agreement of two cameras on the board's position through a calibration."""

    pairs: Mapping[tuple[str, str], float]
    """Rms distance between the two cameras' places of the board's corners, metres."""
    size_ratio: float
    """The board's size as the calibration has it, by the size that was given; NaN if no two
    cameras see it at once."""


def check_agreement(
    rig: Rig, views: Mapping[str, Sequence[BoardView]], board: Board
) -> AgreementReport:
    """Compare the board as two cameras see it at the same moment, through a calibration.

    Raises:
        CalibrationError: the board is of another size than given.
    """
    pairs: dict[tuple[str, str], float] = {}
    steps, gaps = [], []
    seen = [name for name in views if name in rig.cameras]
    for one, other in combinations(seen, 2):
        places = [
            _shared(rig, one, a, other, b, board) for a, b in _together(views[one], views[other])
        ]
        if not places:
            continue
        # Corners as seen from either camera's centre, turned into the world's axes.
        ours, theirs = (np.concatenate(parts) for parts in zip(*places, strict=True))
        gap = (
            rig.cameras[other].world_from_camera[:3, 3] - rig.cameras[one].world_from_camera[:3, 3]
        )
        pairs[one, other] = float(np.sqrt(np.mean(np.sum((ours - theirs - gap) ** 2, axis=1))))
        steps.append(ours - theirs)
        gaps.append(np.broadcast_to(gap, ours.shape))
    if not pairs:
        return AgreementReport(pairs, float("nan"))
    step, wanted = np.concatenate(steps), np.concatenate(gaps)
    ratio = float(np.sum(step * wanted) / np.sum(step * step))
    if abs(ratio - 1.0) > _SIZE_TOLERANCE:
        raise CalibrationError(
            f"the board's squares measure {1e3 * ratio * board.square_m:.1f} mm by the cameras' "
            f"calibration, not {1e3 * board.square_m:.1f} mm: it is a board of another size, give "
            "its own with --square"
        )
    return AgreementReport(pairs, ratio)


def _together(
    ours: Sequence[BoardView], theirs: Sequence[BoardView]
) -> list[tuple[BoardView, BoardView]]:
    """Views of the same moment."""
    by_moment = {view.moment: view for view in theirs}
    return [(view, by_moment[view.moment]) for view in ours if view.moment in by_moment]


def _shared(
    rig: Rig, one: str, a: BoardView, other: str, b: BoardView, board: Board
) -> tuple[Array, Array]:
    """The board's corners from either camera's centre, along the world's axes.

    They need not see the same ones: each sees where the whole board is.
    """
    places = []
    for name, view in ((one, a), (other, b)):
        camera = rig.cameras[name]
        in_camera = transform(_placed(camera, view, board), board.corners_m())
        places.append(in_camera @ camera.world_from_camera[:3, :3].T)
    return places[0], places[1]
