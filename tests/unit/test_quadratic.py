"""The evidence after a change of the diagonal, against one that is computed anew."""

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.quadratic import evidence_changes

Array = NDArray[np.float64]


def test_changes_are_those_of_a_new_factorisation() -> None:
    rng = np.random.default_rng(3)
    count = 12
    rows = rng.normal(size=(30, count))
    information, gradient = rows.T @ rows, 5.0 * rng.normal(size=count)
    values, before = rng.normal(size=count), 10.0 ** rng.uniform(-1.0, 3.0, count)

    def evidence(prior: Array) -> float:
        whole, pull = information + np.diag(prior), gradient + prior * values
        half = 0.5 * float(pull @ np.linalg.solve(whole, pull))
        return half - 0.5 * float(np.linalg.slogdet(whole)[1])

    after = np.repeat(before[None], 40, axis=0)
    for number, prior in enumerate(after):
        changed = rng.choice(count, number % count, replace=False)
        prior[changed] *= 10.0 ** rng.uniform(-3.0, 3.0, len(changed))
    spread = np.asarray(np.linalg.inv(information + np.diag(before)), np.float64)
    step = spread @ (gradient + before * values)
    found = evidence_changes(spread, step, values, before, after)
    expected = [evidence(prior) - evidence(before) for prior in after]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
