"""Reasons why a scan got too few framesets name what can be done about it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from station.booth.collection import (
    Collection,
    Order,
    check_words,
    too_slow_words,
    went_silent_words,
)
from station.booth.frameset import Frameset
from station.core.errors import BoothError
from station.core.scans import ScanId
from station.messaging.intake import LiveFrame
from station.messaging.messages import FrameHeader


@pytest.mark.parametrize(
    ("wanted", "tolerance_s", "remedy"),
    [
        (10, 0.025, "stop other programs"),
        (10, 0.0001, "sync.tolerance_s"),
        (90, 0.025, "raise scan.max_duration_s in booth.toml, or lower scan.framesets"),
        (100, 0.025, "raise scan.max_duration_s in booth.toml, or lower scan.framesets"),
    ],
)
def test_a_busy_computer_is_blamed_for_nothing_else(
    wanted: int, tolerance_s: float, remedy: str
) -> None:
    words = too_slow_words(0, wanted, 3.0, tolerance_s)
    assert remedy in words
    assert ("too busy" in words) == (remedy == "stop other programs")


def test_recordings_have_no_cables() -> None:
    assert check_words(["a"], {"a", "b"}) == "check the recording"
    assert check_words(["a", "c"], {"a", "b"}) == "check their cables"
    assert "check its cable" in went_silent_words(["a"], set())
    assert "check the recording" in went_silent_words(["a"], {"a"})


def test_several_cameras_are_named_in_the_plural() -> None:
    """It said "camera a, b"."""
    both = went_silent_words(["a", "b"], set())
    assert both == "cameras a, b went silent; check their cables; scan again"
    one = went_silent_words(["a"], set())
    assert one == "camera a went silent; check its cable; scan again"
    assert went_silent_words([], set()) == ""


def test_sensors_that_were_switched_off_need_no_cable() -> None:
    """A scan in which somebody switched them off sent the operator to all cables."""
    assert "sensors were stopped during" in went_silent_words(["a", "b"], set(), {"a", "b"})
    assert "check its cable" in went_silent_words(["a"], set(), {"b"})


def _frame(camera: str, scale_m: float) -> LiveFrame:
    header = FrameHeader(camera, camera, 2, 2, scale_m, 0, 30.0, 0.0, 0.0, 0, 0)
    return LiveFrame(header, np.zeros((2, 2), np.uint16))


def test_a_bundle_has_depths_of_one_unit() -> None:
    """A camera in millimetres among those in tenths of one would be ten times as near."""
    no_rig: Any = None
    scan = Collection(Order(ScanId("a"), "", 0.0), no_rig, 1, 0.0)
    scan.add(Frameset({"a": _frame("a", 1e-4), "b": _frame("b", 1e-4)}, 0.0, 0.0), 0.0)
    assert scan.depth_scale_m() == 1e-4
    scan.add(Frameset({"a": _frame("a", 1e-4), "b": _frame("b", 1e-3)}, 0.0, 0.0), 0.0)
    with pytest.raises(BoothError, match="different units"):
        scan.depth_scale_m()
