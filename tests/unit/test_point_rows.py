"""On a body that the model follows badly, points count less in the fine steps."""

from dataclasses import replace

import numpy as np
import pytest

from workers.scape.fit.annealing import COARSE, FINE, MIDDLE, AnnealingStep
from workers.scape.fit.normal_equations import share_of_points

STEP = FINE[-1]
COUNT = 20_000


def _share(off_m: float, noise_m: float, step: AnnealingStep = STEP) -> float:
    """Share of points that are off the body by a normal distribution."""
    residual_m = off_m * np.random.default_rng(1).standard_normal(COUNT)
    return share_of_points(residual_m, np.full(COUNT, noise_m), step)


@pytest.mark.parametrize(("off_m", "noise_m"), [(1.3e-3, 1.5e-3), (2.0e-3, 2.6e-3), (3e-3, 4.4e-3)])
def test_points_of_the_models_family_count_in_full(off_m: float, noise_m: float) -> None:
    """With ten frames, with three and with one, whose noise is no misfit."""
    assert _share(off_m, noise_m) == STEP.row_share


def test_points_of_a_body_that_it_follows_half_as_well_count_half() -> None:
    usual_m = float(np.hypot(STEP.usual_spread_m, 0.7 * 1.5e-3))
    assert _share(2.0 * usual_m, 1.5e-3) == pytest.approx(0.5 * STEP.row_share, rel=0.02)


def test_while_the_fit_moves_all_points_count_alike() -> None:
    for step in (*COARSE, *MIDDLE):
        assert _share(0.02, 1.5e-3, step) == step.row_share


def test_some_that_are_far_off_do_not_matter() -> None:
    residual_m = np.full(COUNT, 0.9e-3)
    residual_m[: COUNT // 3] = 0.02
    assert share_of_points(residual_m, np.full(COUNT, 1.5e-3), STEP) == STEP.row_share


def test_no_points_have_no_spread() -> None:
    assert share_of_points(np.empty(0), np.empty(0), STEP) == STEP.row_share
    assert share_of_points(np.zeros(9), np.zeros(9), replace(STEP, usual_spread_m=1e-3)) > 0.0
