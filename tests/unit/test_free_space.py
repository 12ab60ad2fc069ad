"""Skin where a camera saw the booth behind it."""

import numpy as np

from station.core.geometry import transform
from station.core.lens import rays
from station.simulation.scene import default_rig
from workers.cloud.observed import CameraView
from workers.scape.evidence.free_space import FreeSpace

CAMERA = default_rig().cameras["front-upper"]
PERSON_PX = np.s_[200:280, 300:340]
"""The only part of the image that does not show the wall."""


def _view() -> CameraView:
    depth = np.full((CAMERA.height, CAMERA.width), 4.0, np.float32)
    background = np.ones(depth.shape, bool)
    background[PERSON_PX] = False
    return CameraView("front-upper", CAMERA, depth, ~background, background)


def _at(u: int, v: int, depth_m: float) -> np.ndarray:
    local = rays(CAMERA)[v, u].astype(np.float64) * depth_m
    return transform(CAMERA.world_from_camera, local[None])[0]


def test_skin_before_the_booth_is_not_there_however_deep() -> None:
    places = np.stack(
        [
            _at(320, 240, 2.0),
            _at(342, 240, 2.0),
            _at(350, 240, 2.0),
            _at(450, 240, 2.0),
            _at(450, 240, 5.0),
        ]
    )
    space = FreeSpace.build([_view()])
    pose = [CAMERA.world_from_camera]
    seen_through = space.seen_through(pose, places)
    # On the person; as near to the outline as coarse fits end; beside it; a metre away; behind.
    assert seen_through.tolist() == [False, False, True, True, False]


def test_skin_near_the_outline_is_moved_back_into_it() -> None:
    space = FreeSpace.build([_view()])
    places = np.stack([_at(350, 240, 2.0), _at(450, 240, 2.0)])
    found = space.intrusions([CAMERA.world_from_camera], places)
    assert found.vertex.tolist() == [0]
    back = places[0] - found.depth_m[0] * found.direction[0]
    # The outline is 10.5 px away, 1.5 of which are its flicker.
    assert np.linalg.norm(back - _at(341, 240, 2.0)) < 0.004


def test_what_is_beyond_the_image_is_no_background() -> None:
    # Near the upper border, 30 pixels beside what is not background: the limb may be beyond it.
    view = _view()
    view.background[:60, 350:380] = False
    space = FreeSpace.build([view])
    places = np.stack([_at(320, 5, 2.0), _at(320, 25, 2.0), _at(320, 32, 2.0)])
    found = space.intrusions([CAMERA.world_from_camera], places)
    assert found.vertex.tolist() == [2]
    back = places[2] - found.depth_m[0] * found.direction[0]
    assert np.linalg.norm(back - _at(348, 32, 2.0)) < 0.006
    # The border is nearer than anything else: no reason to move anything out of the image.
    assert not len(FreeSpace.build([_view()]).intrusions([CAMERA.world_from_camera], places).vertex)
