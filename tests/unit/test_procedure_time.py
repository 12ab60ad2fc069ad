"""The duration of a calibration, as the benchmark adds it up from the guide's steps."""

import pytest
from procedure_time import BAR_S, procedure_seconds

from station.core.config import CalibrateConfig


def test_every_step_of_the_guide_is_charged() -> None:
    """A walk before the empty booth and the ball, four places where the ball is laid; two stands
    and three boards more."""
    countdown_s = CalibrateConfig().countdown_s
    assert procedure_seconds(extras=False)["countdowns"] == (0.5 * 2 + 4) * countdown_s
    whole = procedure_seconds(extras=True)
    assert whole["countdowns"] == (0.5 * 7 + 4) * countdown_s
    assert whole["looking and waving"] > CalibrateConfig().waving_s
    assert whole["stand and board"] == 2 * 15.0 + 3 * 10.0


@pytest.mark.parametrize("extras", [False, True])
def test_one_person_is_done_within_six_minutes(extras: bool) -> None:
    """The same texts were read at each place, and each place was confirmed twice: 468 s."""
    assert sum(procedure_seconds(extras=extras).values()) < BAR_S
