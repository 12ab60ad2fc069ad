"""The pose and shape that come nearest to a mesh in the template's topology."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from workers.scape.fit.gauss_newton import shape_parameters, updated
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.sampled import SampledBody

Array = NDArray[np.float64]

PROJECTION_STRIDE = 5
"""Every so many vertices make samples that stand for the whole mesh."""
_STEPS = 8
_SETTLED_M = 2e-5
_NOISE_M = 1e-3
"""Standard deviation of each sample, against beta ~ N(0, I): the prior barely acts."""


def best_fit(
    model: BodyModel,
    samples: SampledBody,
    vertices: Array,
    *,
    start: BodyState | None = None,
    components: int | None = None,
) -> BodyState:
    """The state that minimises sum |Y_s - T_s|^2 over samples s of a mesh T (P, 3).

    Gauss-Newton on all parameters at once, by default from the alternating closed forms of
    `BodyModel.project`; with the first `components` alone if they are given.
    """
    state = model.project(vertices) if start is None else start
    active = model.beta_count if components is None else components
    beta = state.beta.copy()
    beta[active:] = 0.0
    state = replace(state, beta=beta)
    target = vertices[samples.indices]
    shape = shape_parameters(model, active)
    for _ in range(_STEPS):
        positions, rows = samples.jacobian(state, active)
        size = rows.shape[2]
        flat = rows.reshape(-1, size)
        normal = (flat.T @ flat).astype(np.float64) / _NOISE_M**2
        residual = (target - positions).ravel().astype(np.float32)
        gradient = (flat.T @ residual).astype(np.float64) / _NOISE_M**2
        normal[np.diag_indices(size)] += 1.0
        gradient[shape] -= state.beta[:active]
        delta = scipy.linalg.solve(normal, gradient, assume_a="pos")
        state = updated(state, delta, shape)
        moved = flat @ delta.astype(np.float32)
        if np.sqrt(np.mean(np.square(moved))) < _SETTLED_M:
            break
    return state
