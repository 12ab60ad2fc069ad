"""Moments of a mixture that is never held as a whole."""

import numpy as np
import pytest

from station.calibration.adjust.mixture import Mixture


def test_moments_are_those_of_all_samples() -> None:
    """Weights far apart, the largest neither first nor last, as evidences are."""
    rng = np.random.default_rng(1)
    logs = np.array([-900.0, -1.0, 0.5, -0.3])
    means = rng.normal(size=(4, 3))
    spreads = [a @ a.T for a in rng.normal(size=(4, 3, 3))]
    mixture = Mixture(3)
    for key, log, mean, spread in zip("abac", logs, means, spreads, strict=True):
        mixture.add(key, log, mean, spread)
    weights = np.exp(logs) / np.exp(logs).sum()
    mean = weights @ means
    away = means - mean
    covariance = np.einsum("n,nij->ij", weights, spreads) + (weights * away.T) @ away
    found, spread = mixture.moments()
    assert found == pytest.approx(mean)
    assert spread == pytest.approx(covariance)
    probability, under = mixture.share("b")
    assert probability == pytest.approx(weights[1])
    assert under == pytest.approx(means[1])
    assert mixture.share("never")[0] == 0.0
