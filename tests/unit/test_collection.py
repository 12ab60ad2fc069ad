"""Reasons why a scan got too few framesets name what can be done about it."""

from __future__ import annotations

import pytest

from station.booth.collection import check_words, too_slow_words, went_silent_words


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
