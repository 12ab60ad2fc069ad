import numpy as np
import pytest

from workers.scape.fit.annealing import FINE
from workers.scape.fit.normal_equations import _point_rows

USUAL_M = FINE[-1].usual_mismatch_m
COUNT = 2000


def _weight(mismatch_m: float, usual_m: float) -> float:
    """Sum of the weights of rows that are off by a normal distribution."""
    rng = np.random.default_rng(1)
    direction = np.tile([0.0, 0.0, 1.0], (COUNT, 1))
    offset = mismatch_m * rng.standard_normal((COUNT, 1)) * direction
    place, sigma_m = np.arange(COUNT), np.full(COUNT, 1e-3)
    rows = _point_rows(place, direction, offset, sigma_m, FINE[-1], usual_m)
    return float(rows.weight.sum())


def test_rows_of_a_body_that_the_model_follows_count_in_full() -> None:
    assert _weight(0.8 * USUAL_M, USUAL_M) == _weight(0.8 * USUAL_M, np.inf)


def test_rows_of_a_body_that_it_follows_half_as_well_count_half() -> None:
    share = _weight(2.0 * USUAL_M, USUAL_M) / _weight(2.0 * USUAL_M, np.inf)
    assert share == pytest.approx(0.5, rel=0.05)


def test_no_rows_have_no_mismatch() -> None:
    nothing = np.empty((0, 3))
    rows = _point_rows(np.arange(0), nothing, nothing, np.empty(0), FINE[-1], USUAL_M)
    assert len(rows.weight) == 0
