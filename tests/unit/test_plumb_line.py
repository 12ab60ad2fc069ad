"""The hanging ball's places, above one another."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np

from station.calibration.adjust.contacts import PLUMB, Belief, Contacts, _plumb, plumb_ends
from station.calibration.adjust.problem import Layout, Problem, State
from station.calibration.detect.detections import FLOOR

LOW, HIGH = "hanging-700", "hanging-1800"
STARTS = {LOW: 0, HIGH: 3, FLOOR: 6}
LAYOUT = cast(Layout, SimpleNamespace(size=9, triple=lambda name: np.arange(3) + STARTS[name]))
UP = np.array([0.1, -0.2, 0.97]) / np.linalg.norm([0.1, -0.2, 0.97])


def _state(values: np.ndarray) -> State:
    places = {LOW: values[:3], HIGH: values[3:6]}
    return cast(State, SimpleNamespace(places=places, planes={FLOOR: values[6:]}))


def test_the_derivatives_are_those_of_the_distance_from_plumb() -> None:
    here = np.concatenate([[0.3, 0.1, 0.2], np.array([0.3, 0.1, 0.2]) + 1.2 * UP, -UP / 1.9])
    rows, off_m = _plumb(LAYOUT, _state(here), LOW, HIGH)
    assert np.allclose(off_m, 0.0)
    for k, step in enumerate(1e-6 * np.eye(9)):
        ahead, behind = (
            _plumb(LAYOUT, _state(here + sign * step), LOW, HIGH)[1] for sign in (1.0, -1.0)
        )
        assert np.allclose(rows[:, k], (ahead - behind) / 2e-6, atol=1e-6)


def test_the_lowest_and_the_highest_hanging_place_are_compared() -> None:
    heights_m = {"stand-900": 0.9, HIGH: 1.8, "hanging-1200": 1.2, LOW: 0.7}
    assert plumb_ends(cast(Problem, SimpleNamespace(heights_m=heights_m))) == (LOW, HIGH)
    del heights_m[LOW], heights_m[HIGH]
    assert plumb_ends(cast(Problem, SimpleNamespace(heights_m=heights_m))) is None


def test_a_moved_hook_errs_along_two_axes_and_wrong_heights_err_together() -> None:
    names, sigma_m = (LOW, HIGH, PLUMB, PLUMB), np.full(4, 1e-3)
    contacts = Contacts(names, np.zeros((4, 9)), np.array([0, 0, 3e-3, 4e-3]), sigma_m, sigma_m)
    hook, heights = Belief((PLUMB,), 0.1, 5e-3), Belief((LOW, HIGH), 0.1, 5e-3)
    of_hook, of_heights = contacts.covariance(hook), contacts.covariance(heights)
    assert np.allclose(of_hook, np.diag([1e-6, 1e-6, 26e-6, 26e-6]))
    assert np.allclose(of_heights[:2, :2], [[26e-6, 25e-6], [25e-6, 26e-6]])
    assert np.isclose(contacts.size_m(hook, np.zeros(9)), 5e-3)
