"""The duration of a calibration, as the benchmark adds it up from the guide's steps."""

import pytest
from procedure_time import BAR_S, procedure_seconds

from station.core.config import CalibrateConfig


def test_every_step_of_the_guide_is_charged() -> None:
    """A walk before the empty booth and the ball, four places where the ball is laid; two heights
    and three boards more."""
    countdown_s = CalibrateConfig().countdown_s
    assert procedure_seconds(extras=False)["countdowns"] == (0.5 * 2 + 4) * countdown_s
    whole = procedure_seconds(extras=True)
    assert whole["countdowns"] == (0.5 * 7 + 4) * countdown_s
    assert whole["looking and waving"] > CalibrateConfig().waving_s
    assert whole["ball and board"] == 2 * 15.0 + 3 * 10.0
    hung = procedure_seconds(extras=True, hangs=True)
    assert hung["ball and board"] == 2 * 20.0 + 3 * 10.0
    assert hung["looking and waving"] > whole["looking and waving"]


@pytest.mark.parametrize(("extras", "hangs"), [(False, False), (True, False), (True, True)])
def test_one_person_is_done_within_six_minutes(extras: bool, hangs: bool) -> None:
    """The same texts were read at each place, and each place was confirmed twice: 468 s."""
    assert sum(procedure_seconds(extras=extras, hangs=hangs).values()) < BAR_S
