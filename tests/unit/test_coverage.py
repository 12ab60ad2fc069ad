"""Advice on where to wave the ball."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from seen_balls import CAMERAS, ball

from station.calibration.detect.coverage import Coverage


def test_advice_names_what_is_missing() -> None:
    coverage = Coverage(CAMERAS, "front-upper", 0.1)
    assert coverage.share == 0.0
    assert "0 of 120" in coverage.advice()
    rng = np.random.default_rng(0)
    for moment in range(400):
        for name in ("front-upper", "front-lower"):
            x, y, z = rng.uniform((-0.5, -0.4, 1.2), (0.5, 0.4, 2.2))
            coverage.add(
                ball(name, 0.1 * moment + (0.02 if name == "front-lower" else 0), (x, y, z))
            )
    assert coverage.links()["front-lower"] == ("front-upper", 400)
    assert coverage.links()["back-lower"][1] == 0
    enough_with_half = coverage.enough
    for moment in range(400, 800):
        for index, name in enumerate(CAMERAS):
            x, y, z = rng.uniform((-0.5, -0.4, 1.2), (0.5, 0.4, 2.2))
            coverage.add(ball(name, 0.1 * moment + 0.01 * index, (x, y, z)))
    assert coverage.enough
    assert not enough_with_half
    assert coverage.share == 1.0
    assert coverage.advice() == "everything is covered"


def test_balls_that_may_be_covered_cover_nothing() -> None:
    coverage = Coverage(CAMERAS, "front-upper", 0.1)
    for moment in range(100):
        coverage.add(replace(ball("front-upper", 0.1 * moment), radius_sigma_m=5e-3))
    assert coverage.counts() == dict.fromkeys(CAMERAS, 0)


def test_one_corner_of_the_image_is_not_enough() -> None:
    coverage = Coverage(CAMERAS, "front-upper", 0.1)
    for moment in range(400):
        for index, name in enumerate(CAMERAS):
            coverage.add(ball(name, 0.1 * moment + 0.01 * index, (-0.3, -0.3, 1.5)))
    assert not coverage.enough
    assert "in the image of" in coverage.advice() or "nearer" in coverage.advice()
