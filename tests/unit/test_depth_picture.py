"""Depth pictures as an operator reads them: the person in colours, everything else in grey."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from station.console.live.picture import STRIDE_PX, PictureMaker
from station.core.config import Volume
from station.core.depth.correction import DepthCorrection
from station.core.rig import CameraCalibration

_SHAPE = (480, 640)
_PERSON, _WALL, _NOTHING, _FLOOR = (300, 320), (40, 60), (100, 600), (460, 320)


@pytest.fixture
def camera() -> CameraCalibration:
    """Camera one metre high and two metres before the mark, looking level at it."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    pose[:3, 3] = [0.0, -2.0, 1.0]
    K = np.array([[580.0, 0, 320], [0, 580, 240], [0, 0, 1]])
    return CameraCalibration(
        name="front",
        serial="A",
        model="kinect-v1",
        width=640,
        height=480,
        K=K,
        distortion=np.zeros(5),
        depth_correction=DepthCorrection(),
        world_from_camera=pose,
    )


@pytest.fixture
def depth() -> NDArray[np.uint16]:
    """Wall at four metres, a person at two, the floor in front, and no reading on the right."""
    depth = np.full(_SHAPE, 4000, np.uint16)
    depth[150:400, 280:360] = 2000
    rows = np.arange(400, 480)
    depth[400:] = (1000 / ((rows - 240) / 580)).astype(np.uint16)[:, None]
    depth[:, 580:] = 0
    return depth


def _at(picture: NDArray[np.uint8], spot: tuple[int, int]) -> list[int]:
    return [int(value) for value in picture[spot[0] // STRIDE_PX, spot[1] // STRIDE_PX]]


def _is_grey(colour: list[int]) -> bool:
    return len(set(colour)) == 1


def test_the_person_is_coloured_and_outlined(
    camera: CameraCalibration, depth: NDArray[np.uint16]
) -> None:
    picture, somebody = PictureMaker(camera, Volume()).draw(depth, 1e-3)
    assert picture.shape == (240, 320, 3)
    assert somebody
    assert not _is_grey(_at(picture, _PERSON))
    assert _is_grey(_at(picture, _WALL))
    assert _is_grey(_at(picture, _FLOOR))
    assert _at(picture, _NOTHING) not in (_at(picture, _PERSON), _at(picture, _WALL))
    assert [255, 255, 255] in picture[100, 135:145].tolist()


def test_an_empty_booth_has_nobody(camera: CameraCalibration, depth: NDArray[np.uint16]) -> None:
    depth[150:400, 280:360] = 4000
    picture, somebody = PictureMaker(camera, Volume()).draw(depth, 1e-3)
    assert not somebody
    assert _is_grey(_at(picture, _PERSON))


def test_before_the_calibration_everything_is_coloured(depth: NDArray[np.uint16]) -> None:
    picture, somebody = PictureMaker(None, Volume()).draw(depth, 1e-3)
    assert not somebody
    near, far = _at(picture, _PERSON), _at(picture, _WALL)
    assert near != far
    assert not _is_grey(near)


def test_nearer_is_redder(camera: CameraCalibration) -> None:
    maker = PictureMaker(camera, Volume())
    reds = []
    for metres in (1.4, 2.0, 2.6):
        depth = np.full(_SHAPE, round(1000 * metres), np.uint16)
        blue, _, red = _at(maker.draw(depth, 1e-3)[0], (240, 320))
        reds.append(red - blue)
    assert reds == sorted(reds, reverse=True)


def test_the_file_is_a_jpeg(camera: CameraCalibration, depth: NDArray[np.uint16]) -> None:
    packed, somebody = PictureMaker(camera, Volume()).jpeg(depth, 1e-3)
    assert somebody
    image = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (240, 320, 3)
