"""One Gauss-Newton step on the parameters of a body: priors, solution, update.

Parameters are in the order of `SampledBody.jacobian`: rotation increments of L parts (3 L), the
first shape components, the translation (3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import so3_exp
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.sampled import twist_chain

Array = NDArray[np.float64]

_MAX_TURN_RAD = 0.5
"""Largest rotation increment about each axis in one step: derivatives are of first order."""
_TWIST_INFLATION = 1.5
"""Standard deviations of people's poses over those of the training poses."""
_TWIST_FLOOR_RAD = np.radians(1.5)
"""Standard deviation added to every twist, for joints that the training poses hold still."""
DAMPING = 1e-6
"""Share of the mean diagonal that is added to it."""


@dataclass(frozen=True, slots=True)
class TwistPrior:
    """Gaussian over the relative twists, wider than the training poses."""

    mean: Array
    """(3 (L - 1),), radians."""
    information: Array
    """(3 (L - 1), 3 (L - 1))."""

    @classmethod
    def build(cls, model: BodyModel, thumb_stiffness: float = 1.0) -> TwistPrior:
        """Prior of a model.

        Args:
            thumb_stiffness: factor by which the thumbs' standard deviations are divided.
        """
        covariance = model.twist_covariance * _TWIST_INFLATION**2
        covariance = covariance + _TWIST_FLOOR_RAD**2 * np.eye(len(covariance))
        stiff = [
            thumb_stiffness if name.startswith("thumb") else 1.0 for name in model.part_names[1:]
        ]
        scale = np.repeat(stiff, 3)
        information = np.linalg.inv(covariance) * scale[:, None] * scale[None, :]
        return cls(model.twist_mean, information)

    def add(self, model: BodyModel, state: BodyState, normal: Array, gradient: Array) -> None:
        """Add the prior at a state to normal equations (D, D) and (D,), in place."""
        turns = slice(0, 3 * model.part_count)
        change = twist_chain(model, state.rotations)
        twists = model.relative_twists(state.rotations)[1:].ravel()
        normal[turns, turns] += change.T @ self.information @ change
        gradient[turns] -= change.T @ self.information @ (twists - self.mean)


def add_shape_prior(state: BodyState, normal: Array, gradient: Array, shape: slice) -> None:
    """Add beta ~ N(0, I) to normal equations, in place; `shape` is where the components are."""
    active = shape.stop - shape.start
    normal[shape, shape] += np.eye(active)
    gradient[shape] -= state.beta[:active]


def shape_parameters(model: BodyModel, active: int) -> slice:
    """Slice of the first `active` shape components among the parameters."""
    return slice(3 * model.part_count, 3 * model.part_count + active)


def updated(state: BodyState, delta: Array, shape: slice) -> BodyState:
    """State after a step (D,), with each rotation increment limited."""
    turns = np.clip(delta[: shape.start].reshape(-1, 3), -_MAX_TURN_RAD, _MAX_TURN_RAD)
    beta = state.beta.copy()
    beta[: shape.stop - shape.start] += delta[shape]
    translation = state.translation + delta[shape.stop : shape.stop + 3]
    return BodyState(so3_exp(turns) @ state.rotations, beta, translation)
