"""Reasons why a scan got too few framesets name what can be done about it."""

from __future__ import annotations

import pytest

from station.booth.collection import Collection, Order, check_words, too_slow_words
from station.core.scans import scan_id_of
from station.simulation.scene import default_rig

_ORDER = Order(scan_id_of("a"), "", 1e9)


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
    told = Collection(_ORDER, default_rig(), wanted, 0.0).too_few([], set(), [], 3.0, tolerance_s)
    assert told == words


def test_recordings_have_no_cables() -> None:
    assert check_words(["a"], {"a", "b"}) == "check the recording"
    assert check_words(["a", "c"], {"a", "b"}) == "check their cables"
    collection = Collection(_ORDER, default_rig(), 10, 0.0)
    assert "check its cable" in collection.too_few(["a"], set(), [], 3.0, 0.025)
    assert "check the recording" in collection.too_few(["a"], {"a"}, [], 3.0, 0.025)


def test_several_cameras_are_named_in_the_plural() -> None:
    """It said "camera a, b"."""
    collection = Collection(_ORDER, default_rig(), 10, 0.0)
    both = collection.too_few(["a", "b"], set(), [], 3.0, 0.025)
    assert both == "cameras a, b went silent; check their cables; scan again"
    one = collection.too_few(["a"], set(), [], 3.0, 0.025)
    assert one == "camera a went silent; check its cable; scan again"
