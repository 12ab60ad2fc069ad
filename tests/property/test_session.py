from typing import get_args

from hypothesis import given
from hypothesis import strategies as st

from station.booth.session import FINAL, ON_DISK, Session, State, advance, expire


@given(events=st.lists(st.sampled_from(get_args(State)), max_size=20))
def test_a_scan_never_goes_back(events: list[State]) -> None:
    session = Session("s", "", 0.0)
    accepted = False
    for event in events:
        before = session
        session = advance(session, event)
        if before.state in FINAL:
            assert session == before
        accepted = accepted or session.state in ON_DISK
        if accepted:
            assert session.state not in ("armed", "capturing")


def test_an_accepted_scan_never_expires() -> None:
    """A slow worker once made the operator scan a customer twice."""
    session = advance(Session("s", "", 0.0), "accepted")
    assert expire(session, 1e6, 5.0) == session
    forgotten = expire(Session("s", "", 0.0), 6.0, 5.0)
    assert forgotten.state == "failed"
    assert "scan again" in forgotten.reason
