"""A scan's state follows from its folder and its note, and never goes back."""

from itertools import product
from typing import get_args

import pytest

from station.booth.session import FINAL, ON_DISK, overdue, state_of
from station.core.scans import ScanId, ScanNote, Stage

_ID = ScanId("s")
_PLACES = (None, "queue", "work", "outbox", "failed")


@pytest.mark.parametrize(("stage", "place"), list(product(get_args(Stage), _PLACES)))
def test_an_accepted_scan_is_never_said_to_have_failed_by_its_note(
    stage: Stage, place: str | None
) -> None:
    """The operator was told to scan again, and the result came all the same."""
    state = state_of(ScanNote(_ID, stage), place)
    assert state is not None
    if place in ("queue", "work", "outbox"):
        assert state in ON_DISK
    if place is None and stage in ("armed", "capturing"):
        assert state not in FINAL


def test_a_result_that_was_moved_away_stays_delivered() -> None:
    assert state_of(ScanNote(_ID, "delivered", verdict="ok"), None) == "delivered"
    assert state_of(ScanNote(_ID, "delivered", verdict="rescan"), None) == "rescan"
    assert state_of(None, None) is None


def test_time_alone_fails_no_order() -> None:
    """A stalled disk made control say "failed"; the scan was delivered a moment later."""
    note = ScanNote(_ID, "armed", valid_until_s=5.0, boot="b")
    assert overdue(note, 6.0, "b")
    assert state_of(note, None) == "armed"
    assert not overdue(note, 4.0, "b")
