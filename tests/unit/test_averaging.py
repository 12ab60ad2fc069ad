"""Widths of priors weighed by their evidence, on data of which the answer is known."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from station.calibration.adjust.averaging import averaged_state, most_probable_widths
from station.calibration.adjust.priors import priors
from station.calibration.adjust.problem import Layout, Problem, State
from station.calibration.adjust.trajectory import TimeGrid
from station.calibration.adjust.widths import (
    CENTER,
    FOCAL,
    GAIN,
    K1,
    SENSOR,
    Widths,
    lens_log_prior,
    sound_level,
    width_options,
    worst_level,
)
from station.calibration.detect.detections import FLOOR
from station.simulation.scene import default_rig

CAMERAS = default_rig().cameras
NAMES = tuple(CAMERAS)
PLACES = {GAIN: 1, FOCAL: 6, CENTER: 7, K1: 9}
"""Places of gain, focal length, centre (across) and k1 among a sensor's parameters."""
SPREAD = {FOCAL: 2e-4, CENTER: 0.25, K1: 4e-4}
"""Standard deviations to which a calibration knows them without priors."""


def problem() -> Problem:
    return Problem(CAMERAS, NAMES[0], 0.1, {}, {}, (), Widths.widest(CAMERAS))


def state(values: Mapping[str, float], sigma: float, name: str = GAIN) -> State:
    """A state at nominal sensors, where data say that gains (or other parameters) are these, each
    with a deviation."""
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
    for camera in CAMERAS:
        information[np.ix_(layout.sensor(camera), layout.sensor(camera))] = 0.0
    information[np.ix_(layout.radius, layout.radius)] = 0.0
    information[np.ix_(layout.bow, layout.bow)] = 0.0
    for prior in priors(whole, layout, nothing):
        information[np.ix_(prior.index, prior.index)] += prior.information
    for camera, value in values.items():
        at = layout.sensor(camera)[PLACES[name]]
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
        assert levels[0] >= worst_level(GAIN) - 1
        assert levels[1:] == (0,) * 4
    solved = averaged_state(problem(), at)
    for name, gain in gains.items():
        assert solved.sensors[name][PLACES[GAIN]] == pytest.approx(gain, abs=1e-4)


def test_one_wrong_unit_does_not_make_the_others_doubtful() -> None:
    gains = dict(zip(NAMES, (0.0, 5e-3, 0.0, 0.0), strict=True))
    found = most_probable_widths(problem(), state(gains, 1e-4))
    assert [found.sensors[name][0] for name in NAMES] == [0, worst_level(GAIN), 0, 0]


def test_what_the_data_do_not_decide_shows_in_the_covariance() -> None:
    """Gains that are hardly seen may be a sound unit's or a poor one's."""
    layout = Layout.of(problem())
    place = layout.sensor(NAMES[0])[PLACES[GAIN]]
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


def lens_state(errors: Mapping[str, Mapping[str, float]]) -> State:
    """A state whose data say of each camera that its lens is off by so much."""
    found = state({}, 1.0)
    for camera, error in errors.items():
        for name, spread in SPREAD.items():
            at = Layout.of(problem()).sensor(camera)[PLACES[name]]
            found.information[at, at] += spread**-2.0
            found.gradient[at] -= error.get(name, 0.0) / spread**2
    return found


def center_sigma(at: State, camera: str = NAMES[0]) -> float:
    place = Layout.of(problem()).sensor(camera)[PLACES[CENTER]]
    return float(np.sqrt(averaged_state(problem(), at).covariance[place, place]))


def test_a_lens_of_wrong_distortion_has_a_doubtful_centre() -> None:
    """Nobody measured such a unit's lens."""
    sound = center_sigma(lens_state({name: {} for name in CAMERAS}))
    wrong = center_sigma(lens_state({name: {K1: 0.03} for name in CAMERAS}))
    assert sound < 0.1
    assert wrong > 1.5 * sound


def test_a_lens_without_any_error_was_measured_with_care() -> None:
    """The stated errors of sound booths were twice too wide: most of them was the sound width of
    the centre, also where focal length and centre had proved to be better than sound."""
    exact = most_probable_widths(problem(), lens_state({name: {} for name in CAMERAS}))
    assert {levels[SENSOR.index(CENTER)] for levels in exact.sensors.values()} == {0}
    signs = dict(zip(NAMES, (1.0, -1.0, 1.0, -1.0), strict=True))
    off = {name: {K1: 6e-3 * sign} for name, sign in signs.items()}
    found = most_probable_widths(problem(), lens_state(off))
    for name in (FOCAL, CENTER):
        levels_of = {levels[SENSOR.index(name)] for levels in found.sensors.values()}
        assert levels_of == {sound_level(name)}
    assert center_sigma(lens_state(off)) > 0.14


def test_the_lens_of_one_camera_alone_is_wrong_in_one_booth_of_ten() -> None:
    """It was in one of forty: its level's probability was counted once more."""
    share = np.exp(lens_log_prior(4))
    assert share.sum() == pytest.approx(1.0)
    shared = len([o for o in width_options(FOCAL, 4) if len(set(o.levels)) == 1])
    alone = share.sum() - share[:shared, :shared, :shared].sum()
    assert 0.08 < alone < 0.1
    one = lens_state({name: {K1: 0.03 * (name == NAMES[1])} for name in CAMERAS})
    found = most_probable_widths(problem(), one)
    k1 = SENSOR.index(K1)
    assert [found.sensors[name][k1] for name in NAMES] == [1, worst_level(K1), 1, 1]
    assert center_sigma(one, NAMES[1]) > 1.05 * center_sigma(one, NAMES[0])
