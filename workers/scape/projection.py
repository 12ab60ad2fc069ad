"""The pose and shape that come nearest to a mesh in the template's topology."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from station.geometry import so3_exp
from workers.scape.model import BodyModel, BodyState
from workers.scape.sampled import SampledBody

Array = NDArray[np.float64]

PROJECTION_STRIDE = 5
"""Every so many vertices make samples that stand for the whole mesh."""
_STEPS = 8
_SETTLED_M = 2e-5
_NOISE_M = 1e-3
"""Of each sample, against beta ~ N(0, I): the prior barely acts."""
_MOST_TURN_RAD = 0.5


def best_fit(model: BodyModel, samples: SampledBody, vertices: Array) -> BodyState:
    """The state that minimises sum |Y_s - T_s|^2 over samples s of a mesh T (P, 3).

    Gauss-Newton on all parameters at once, from the alternating closed forms of
    `BodyModel.project`.
    """
    state = model.project(vertices)
    target = vertices[samples.indices]
    first_beta = 3 * model.part_count
    for _ in range(_STEPS):
        positions, rows = samples.jacobian(state)
        size = rows.shape[2]
        flat = rows.reshape(-1, size)
        normal = (flat.T @ flat).astype(np.float64) / _NOISE_M**2
        pull = (target - positions).ravel().astype(np.float32)
        gradient = (flat.T @ pull).astype(np.float64) / _NOISE_M**2
        normal[np.diag_indices(size)] += 1.0
        gradient[first_beta:-3] -= state.beta
        delta = scipy.linalg.solve(normal, gradient, assume_a="pos")
        turns = np.clip(delta[:first_beta].reshape(-1, 3), -_MOST_TURN_RAD, _MOST_TURN_RAD)
        state = BodyState(
            so3_exp(turns) @ state.rotations,
            state.beta + delta[first_beta:-3],
            state.translation + delta[-3:],
        )
        moved = flat @ delta.astype(np.float32)
        if np.sqrt(np.mean(np.square(moved))) < _SETTLED_M:
            break
    return state
