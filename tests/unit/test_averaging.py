"""Widths of priors weighed by their evidence, on data of which the answer is known."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from station.calibration.adjust.averaging import averaged_state, most_probable_widths
from station.calibration.adjust.priors import priors
from station.calibration.adjust.problem import Layout, Problem, State
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.adjust.widths import LEVELS, Widths
from station.calibration.detect.detections import FLOOR
from station.simulation.scene import default_rig

CAMERAS = default_rig().cameras
NAMES = tuple(CAMERAS)
GAIN = 1
CENTER, K1 = 7, 9
"""Places of gain, centre (across) and k1 among a sensor's parameters."""


def problem() -> Problem:
    return Problem(CAMERAS, NAMES[0], 0.1, {}, {}, (), Widths.widest(CAMERAS))


def state(values: Mapping[str, float], sigma: float, place: int = GAIN) -> State:
    """A state at nominal sensors, where data say that gains (or the parameters at another place)
    are these, each with a deviation."""
    whole = problem()
    layout = Layout.of(whole)
    nothing = State(
        poses={name: np.eye(4) for name in CAMERAS},
        clock_s=dict.fromkeys(CAMERAS, 0.0),
        sensors={name: np.zeros(whole.model.size) for name in CAMERAS},
        grid=TimeGrid(0.0, 8),
        controls=np.zeros((8, 3)),
        places={},
        planes={FLOOR: np.array([0.0, 0.5, 0.0])},
        radius_m=0.1,
    )
    information, gradient = 1e6 * np.eye(layout.size), np.zeros(layout.size)
    for name in CAMERAS:
        information[np.ix_(layout.sensor(name), layout.sensor(name))] = 0.0
    information[np.ix_(layout.radius, layout.radius)] = 0.0
    information[np.ix_(layout.bow, layout.bow)] = 0.0
    for prior in priors(whole, layout, nothing):
        information[np.ix_(prior.index, prior.index)] += prior.information
    for name, value in values.items():
        at = layout.sensor(name)[place]
        information[at, at] += sigma**-2.0
        gradient[at] -= value / sigma**2
    return replace(nothing, information=information, gradient=gradient)


def test_sound_units_are_believed_to_be_sound() -> None:
    found = most_probable_widths(problem(), state(dict.fromkeys(CAMERAS, 1e-4), 1e-4))
    assert set(found.sensors.values()) == {(0,) * 5}
    assert (found.radius, found.bow) == (0, 0)


def test_units_that_are_all_wrong_get_a_wide_prior_of_that_class_alone() -> None:
    gains = dict(zip(NAMES, (3e-3, -2e-3, 4e-3, -3e-3), strict=True))
    at = state(gains, 1e-4)
    found = most_probable_widths(problem(), at)
    for levels in found.sensors.values():
        assert levels[0] >= LEVELS - 2
        assert levels[1:] == (0,) * 4
    solved = averaged_state(problem(), at)
    for name, gain in gains.items():
        assert solved.sensors[name][GAIN] == pytest.approx(gain, abs=1e-4)


def test_one_wrong_unit_does_not_make_the_others_doubtful() -> None:
    gains = dict(zip(NAMES, (0.0, 5e-3, 0.0, 0.0), strict=True))
    found = most_probable_widths(problem(), state(gains, 1e-4))
    assert [found.sensors[name][0] for name in NAMES] == [0, LEVELS - 1, 0, 0]


def test_what_the_data_do_not_decide_shows_in_the_covariance() -> None:
    """Gains that are hardly seen may be a sound unit's or a poor one's."""
    layout = Layout.of(problem())
    place = layout.sensor(NAMES[0])[GAIN]
    sigmas = {}
    for said, sigma in (("sound", 1e-4), ("nothing", 1.0)):
        solved = averaged_state(problem(), state(dict.fromkeys(CAMERAS, 0.0), sigma))
        sigmas[said] = float(np.sqrt(solved.covariance[place, place]))
    assert sigmas["sound"] < 1.5e-4
    # 0.6 of 0.03 %, the rest up to 0.4 %.
    assert 1e-3 < sigmas["nothing"] < 2.5e-3


def test_a_moderate_departure_gets_a_moderate_width() -> None:
    """0.12 % is four times a sound unit's, and a third of the worst."""
    found = most_probable_widths(problem(), state(dict.fromkeys(CAMERAS, 1.2e-3), 1e-4))
    assert {levels[0] for levels in found.sensors.values()} <= {1, 2}


def test_a_lens_of_wrong_distortion_has_a_doubtful_centre() -> None:
    """Nobody measured such a unit's lens."""
    sigmas = []
    for distortion in (0.0, 0.03):
        at = state(dict.fromkeys(CAMERAS, distortion), 1e-3, K1)
        for name in CAMERAS:
            place = Layout.of(problem()).sensor(name)[CENTER]
            at.information[place, place] += 1.0
        solved = averaged_state(problem(), at)
        sigmas.append(float(np.sqrt(solved.covariance[place, place])))
    assert sigmas[0] < 0.5
    assert sigmas[1] > 1.15 * sigmas[0]
