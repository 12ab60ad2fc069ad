"""Sensors whose patterns overlap disturb each other there, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from station.core.kinect_v1 import NO_READING
from station.simulation import violations
from station.simulation.round_objects import ball, overlay
from station.simulation.scene import Mesh, VirtualScene, box
from station.simulation.sensor import SimulatedBooth, VirtualCamera

BOARD = box((-0.6, -0.01, 0.0), (0.6, 0.01, 2.1))
DISTURBED = SimulatedBooth(
    seed=5, sway_m=0.0, walls=False, violations=frozenset({violations.INTERFERENCE})
)
ALONE = replace(DISTURBED, violations=frozenset())


def _frame(booth: SimulatedBooth, body: Mesh = BOARD) -> NDArray[np.uint16]:
    return next(VirtualCamera(booth, "front-upper", body).frames(1)).raw


def _lost(raw: NDArray[np.uint16], rows: slice) -> float:
    """Share of the board's pixels without a reading."""
    return float(np.mean(raw[rows, 240:400] == NO_READING))


UPPER_HALF, OVERLAP = slice(90, 200), slice(360, 470)
"""Rows that the lower sensor does not reach, and rows that both look at."""


def test_readings_are_lost_where_another_pattern_shines_and_only_there() -> None:
    raw = _frame(DISTURBED)
    assert _lost(raw, UPPER_HALF) < 0.002
    assert 0.02 < _lost(raw, OVERLAP) < 0.4
    assert _lost(_frame(ALONE), OVERLAP) < 0.002


def test_most_of_it_stays_from_frame_to_frame() -> None:
    first, second = (
        frame.raw[OVERLAP, 240:400] == NO_READING
        for frame in VirtualCamera(DISTURBED, "front-upper", BOARD).frames(2)
    )
    assert np.mean(second[first]) > 2.0 * np.mean(second)


def test_at_the_images_border_the_own_light_is_as_bright_as_beside_it() -> None:
    """The projector stands beside the camera: a strip of the image, which it lights, was taken for
    dark, and foreign light for 13 times as bright."""
    camera = DISTURBED.rig.cameras["front-upper"]
    wide = box((-4.0, -0.01, 0.0), (4.0, 0.01, 2.1))
    others = DISTURBED.disturbing("front-upper")
    view = VirtualScene([wide]).view(camera, camera.world_from_camera, others)
    assert view.foreign is not None
    border, beside = (np.median(view.foreign[OVERLAP, u : u + 3]) for u in (0, 50))
    assert beside > 0.2
    assert border == pytest.approx(beside, rel=0.4)


def test_what_stands_in_the_light_disturbs_nothing_behind_it() -> None:
    shade = box((0.1, -1.45, 0.3), (0.8, -1.44, 1.0))
    assert _lost(_frame(replace(DISTURBED, clutter=[shade])), OVERLAP) < 0.002


def test_a_dead_sensor_disturbs_nobody() -> None:
    lower = replace(DISTURBED, dead_cameras=("front-lower",))
    assert _lost(_frame(lower), OVERLAP) < 0.002


def test_a_waved_ball_is_lit_by_all_around_it() -> None:
    camera = DISTURBED.rig.cameras["front-upper"]
    others = DISTURBED.disturbing("front-upper")
    still = VirtualScene([BOARD]).view(camera, camera.world_from_camera, others)
    for height_m, least, most in ((1.0, 0.3, 3.0), (1.8, 0.0, 0.0)):
        center = np.array([0.0, -0.4, height_m])
        drawn = overlay(still, camera, [ball(center, 0.1)], others)
        assert drawn is not None
        view, _ = drawn
        assert view.foreign is not None
        on_ball = (view.depth_m > 0.0) & (view.depth_m < 1.25) & (view.incidence_rad < 0.8)
        assert on_ball.sum() > 100
        assert least <= float(np.median(view.foreign[on_ball])) <= most


def test_without_it_frames_stay_as_they_are() -> None:
    assert ALONE.disturbing("front-upper") == []
    assert VirtualCamera(ALONE, "front-upper", BOARD).unit.error.interference is None
    assert np.mean(_frame(ALONE) != _frame(DISTURBED)) == pytest.approx(0.1, abs=0.1)
