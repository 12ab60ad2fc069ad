"""Clocks that jump midway are told from cameras that see the ball in turn."""

import numpy as np
import pytest

from station.calibration.solve.jumps import large_jump
from station.calibration.solve.pairwise import Track, estimate_pairs


def track(times_s: np.ndarray, late_s: np.ndarray | float = 0.0) -> Track:
    """Track of a ball that is waved slowly, timed by a clock that is late."""
    turns = 2.0 * np.pi * np.outer(times_s, (0.06, 0.04, 0.05))
    return Track(
        np.asarray(times_s + late_s), np.array((0.5, 0.4, 0.7)) * np.sin(turns) + (0.0, 0.0, 1.7)
    )


def seen(start_s: float, end_s: float) -> np.ndarray:
    return np.arange(start_s, end_s, 1 / 15)


def test_a_jump_is_found_and_its_camera_named() -> None:
    times = seen(0.0, 40.0)
    late = np.where(times > 20.0, 0.7, 0.0)
    tracks = {"a": track(times), "b": track(times + 0.02), "c": track(times, late)}
    jump = large_jump(tracks, estimate_pairs(tracks))
    assert jump is not None
    assert jump.camera == "c"
    assert abs(jump.jump_s) == pytest.approx(0.7, abs=0.2)


def test_cameras_that_see_the_ball_in_turn_have_sound_clocks() -> None:
    """With too little seen at one time for a comparison, a small shift made it comparable: of a
    slow ball that agreed as well, and a sound booth was refused."""
    first = np.concatenate([seen(0.0, 20.0), seen(24.0, 24.9), seen(28.0, 28.9)])
    second = np.concatenate([seen(0.0, 20.0), seen(24.25, 26.0), seen(28.25, 30.0)])
    tracks = {"a": track(first), "b": track(second)}
    assert large_jump(tracks, estimate_pairs(tracks)) is None
