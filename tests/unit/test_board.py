"""ChArUco boards drawn by homography through a known lens."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from station.calibration.detect.board import (
    Board,
    BoardView,
    check_agreement,
    find_board,
    judge_lens,
)
from station.core.errors import CalibrationError
from station.core.geometry import invert, rigid, se3_exp, so3_exp
from station.core.rig import CameraCalibration
from station.simulation.scene import default_rig

BOARD = Board(7, 5, 0.06, 0.045)
_DRAWN_PX = 60
"""Pixels of a square in the drawing."""
_FINER = 3


def _drawing(board: Board = BOARD) -> NDArray[np.uint8]:
    size = (board.columns * _DRAWN_PX, board.rows * _DRAWN_PX)
    return np.asarray(board.printed().generateImage(size, marginSize=0), np.uint8)


def _image(
    camera: CameraCalibration, camera_from_board: NDArray[np.float64], board: Board = BOARD
) -> NDArray[np.uint8]:
    """Image of a board by a camera without distortion."""
    step = board.square_m / _DRAWN_PX
    metres_from_drawing = np.array([[step, 0.0, 0.5 * step], [0.0, step, 0.5 * step], [0, 0, 1.0]])
    plane = camera_from_board[:3, [0, 1, 3]]
    # Drawn finer than the sensor's pixels, which then average.
    half = 0.5 * (_FINER - 1)
    finer = np.array([[_FINER, 0.0, half], [0.0, _FINER, half], [0.0, 0.0, 1.0]])
    size = (camera.width * _FINER, camera.height * _FINER)
    mapping = finer @ camera.K @ plane @ metres_from_drawing
    image = cv2.warpPerspective(_drawing(board), mapping, size, borderValue=90)
    return np.asarray(
        cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8
    )


def _poses(count: int, tilt_rad: float, seed: int = 1) -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    middle = np.array([-3.5, -2.5, 0.0]) * BOARD.square_m
    poses = []
    for _ in range(count):
        turn = so3_exp(rng.uniform(-tilt_rad, tilt_rad, 3))
        shift = np.array([*rng.uniform(-0.17, 0.17, 2), rng.uniform(0.6, 0.9)])
        poses.append(rigid(turn, shift + turn @ middle))
    return poses


def _views(camera: CameraCalibration, poses: list[NDArray[np.float64]]) -> list[BoardView]:
    found = [
        find_board(_image(camera, pose), BOARD, str(index)) for index, pose in enumerate(poses)
    ]
    return [view for view in found if view is not None]


CAMERA = default_rig().cameras["front-upper"]
TRUE_LENS = replace(
    CAMERA, K=CAMERA.K * np.array([[1.02, 1.0, 1.01], [1.0, 1.02, 0.99], [1.0, 1.0, 1.0]])
)


def test_corners_are_found_where_they_are() -> None:
    pose = _poses(1, 0.3)[0]
    view = find_board(_image(CAMERA, pose), BOARD, "a")
    assert view is not None
    corners = BOARD.corners_m()[view.ids]
    there = cv2.projectPoints(
        corners @ pose[:3, :3].T + pose[:3, 3], np.zeros(3), np.zeros(3), CAMERA.K, np.zeros(5)
    )[0][:, 0]
    assert len(view.ids) == 24
    off = np.linalg.norm(there - view.pixels, axis=1)
    assert np.median(off) < 0.3
    assert off.max() < 1.0


def test_an_image_without_a_board_is_no_view() -> None:
    assert find_board(np.full((480, 640), 90, np.uint8), BOARD, "a") is None


def test_a_lens_that_the_board_constrains_is_taken() -> None:
    """The true focal length is 2 % off the factory's."""
    report = judge_lens(CAMERA, _views(TRUE_LENS, _poses(40, 0.7)), BOARD)
    assert report.lens is not None, report.words()
    assert report.lens.K[0, 0] == pytest.approx(TRUE_LENS.K[0, 0], rel=2e-3)
    assert report.free_m < 0.8 * report.factory_m
    assert "the board's lens is used" in report.words()


def test_free_intrinsics_from_frontal_views_are_not_believed() -> None:
    """They once had the better reprojection error and put points centimetres off."""
    report = judge_lens(CAMERA, _views(TRUE_LENS, _poses(24, 0.02)), BOARD)
    assert report.lens is None
    assert "do not constrain the lens" in report.words()


def test_the_factorys_lens_is_kept_when_it_is_right() -> None:
    report = judge_lens(CAMERA, _views(CAMERA, _poses(30, 0.7)), BOARD)
    assert report.lens is None
    assert "factory's" in report.words()
    assert "kept" in report.words()


def test_few_views_judge_nothing() -> None:
    report = judge_lens(CAMERA, _views(CAMERA, _poses(4, 0.5)), BOARD)
    assert report.lens is None
    assert "12 are needed" in report.words()


@pytest.mark.parametrize("printed", [Board(9, 7, 0.06, 0.045), Board(6, 5, 0.06, 0.045)])
def test_a_board_of_other_squares_is_refused(printed: Board) -> None:
    pose = rigid(so3_exp((0.1, 0.2, 0.0)), (-0.25, -0.2, 0.9))
    with pytest.raises(CalibrationError, match="board of another size"):
        find_board(_image(CAMERA, pose, printed), BOARD, "a")


def _pair_views(board: Board) -> dict[str, list[BoardView]]:
    """A board of some true size, seen by both front cameras at once, taken for BOARD."""
    rig = default_rig()
    views: dict[str, list[BoardView]] = {"front-lower": [], "front-upper": []}
    rng = np.random.default_rng(3)
    for moment in range(5):
        turn = so3_exp((-np.pi / 2, 0.0, 0.0)) @ so3_exp(rng.uniform(-0.2, 0.2, 3))
        middle = turn @ np.array([-3.5, -2.5, 0.0]) * board.square_m
        world_from_board = rigid(turn, np.array([rng.uniform(-0.1, 0.1), -0.5, 1.02]) + middle)
        # The board's picture faces the cameras: its x to their right.
        for name in views:
            camera_from_board = invert(rig.cameras[name].world_from_camera) @ world_from_board
            view = find_board(
                _image(rig.cameras[name], camera_from_board, board), BOARD, f"{moment}"
            )
            if view is not None:
                views[name].append(view)
    return views


def test_two_cameras_carry_the_board_from_one_to_the_other() -> None:
    rig = default_rig()
    report = check_agreement(rig, _pair_views(BOARD), BOARD)
    assert report.pairs["front-lower", "front-upper"] < 0.006
    assert report.size_ratio == pytest.approx(1.0, abs=0.01)
    turned = replace(
        rig.cameras["front-lower"],
        world_from_camera=rig.cameras["front-lower"].world_from_camera
        @ se3_exp((0.0, 0.02, 0.0, 0.0, 0.0, 0.0)),
    )
    worse = check_agreement(
        replace(rig, cameras={**rig.cameras, "front-lower": turned}), _pair_views(BOARD), BOARD
    )
    assert worse.pairs["front-lower", "front-upper"] > 0.015


def test_a_board_of_another_square_size_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"measure 66\.\d mm .* not 60\.0 mm"):
        check_agreement(default_rig(), _pair_views(Board(7, 5, 0.066, 0.0495)), BOARD)


@pytest.mark.parametrize(
    "board", [Board(7, 5, 0.06, 0.07), Board(2, 5, 0.06, 0.04), Board(7, 5, 0.06, 0.04, "DICT_X")]
)
def test_an_impossible_board_is_refused(board: Board) -> None:
    with pytest.raises(CalibrationError):
        board.printed()
