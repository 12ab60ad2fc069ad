"""The duration of a calibration, as the benchmark adds it up from the guide's steps."""

from procedure_time import BAR_S, procedure_seconds

from station.core.config import CalibrateConfig


def test_every_step_of_the_guide_is_charged() -> None:
    """Empty booth, ball, mark, three places around it; two stands and four boards more."""
    countdown_s = CalibrateConfig().countdown_s
    assert procedure_seconds(extras=False)["countdowns"] == 6 * countdown_s
    whole = procedure_seconds(extras=True)
    assert whole["countdowns"] == 12 * countdown_s
    assert whole["looking and waving"] > CalibrateConfig().waving_s


def test_ball_mark_and_floor_take_one_person_less_than_six_minutes() -> None:
    assert sum(procedure_seconds(extras=False).values()) < BAR_S
