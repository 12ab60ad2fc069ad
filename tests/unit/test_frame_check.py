"""Sensors that send what is not there, or not now, are named and left out."""

from __future__ import annotations

import numpy as np
import pytest

from station.booth.frame_check import FrameCheck, wrong_sensors
from station.messaging.messages import FrameHeader

_HZ = 60_000_000


def _header(index: int, ticks: int, hz: float = 30.0) -> FrameHeader:
    return FrameHeader("a", "A1", 64, 48, 1e-4, ticks, _HZ, index / hz, index / hz, index, 0)


def _picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(8000, 8100, (48, 64), dtype=np.uint16)


def _run(
    truth: FrameCheck, count: int, *, hz: float = 30.0, frozen: bool = False, stuck: bool = False
) -> int:
    """Feed frames; returns how many may enter a frameset."""
    return sum(
        truth.usable(
            _header(i, 7 if stuck else round(i / hz * _HZ), hz), _picture(0 if frozen else i)
        )
        for i in range(1, count + 1)
    )


def test_a_living_sensor_is_believed() -> None:
    truth = FrameCheck()
    assert _run(truth, 40) == 40
    assert truth.trouble(40 / 30) == ""
    assert truth.rate_hz() == pytest.approx(30.0, rel=1e-3)


@pytest.mark.parametrize(
    ("fault", "words"), [("frozen", "same picture"), ("stuck", "time stamps do not advance")]
)
def test_what_repeats_is_named_and_never_used(fault: str, words: str) -> None:
    """Ten identical frames were accepted: in a shop, they are the previous customer's."""
    truth = FrameCheck()
    assert _run(truth, 30, frozen=fault == "frozen", stuck=fault == "stuck") == 1
    assert words in truth.trouble(30 / 30)


def test_a_frame_that_comes_twice_is_only_left_out() -> None:
    truth = FrameCheck()
    _run(truth, 20)
    assert not truth.usable(_header(21, round(20 / 30 * _HZ)), _picture(20))
    assert truth.trouble(21 / 30) == ""


def test_half_the_rate_is_named_and_lost_frames_are_not() -> None:
    slow, lossy = FrameCheck(), FrameCheck()
    # Its first half second tells its rate; none of its frames is used after that.
    assert _run(slow, 30, hz=15.0) == 15
    assert "15 frames per second" in slow.trouble(30 / 15)
    assert "USB" in slow.trouble(30 / 15)
    replayed = FrameCheck(replays=True)
    _run(replayed, 30, hz=15.0)
    assert replayed.trouble(30 / 15).endswith("; record it again")
    rng = np.random.default_rng(0)
    for i in range(1, 200):
        if rng.random() > 0.3:
            lossy.usable(_header(i, round(i / 30 * _HZ)), _picture(i))
    assert lossy.trouble(200 / 30) == ""


def test_sensors_that_changed_places_are_named() -> None:
    calibrated = {"front": "A1", "back": "A2"}
    assert wrong_sensors({"front": "A1", "back": "A2"}, calibrated) == []
    (swapped,) = wrong_sensors({"front": "A2", "back": "A1"}, calibrated)
    assert swapped == (
        "camera front is sensor A2, but A1 was calibrated; camera back is sensor A1, but A2 was "
        "calibrated; put the sensors and booth.toml back as they were, or run station calibrate"
    )
    # The other has not sent a frame yet.
    assert wrong_sensors({"front": "A1"}, calibrated) == []
    [twice] = wrong_sensors({"front": "A1", "back": "A1"}, {"front": "A1"})
    assert "the same sensor (A1)" in twice
    assert wrong_sensors({"front": "recorded:front"}, calibrated) == []
