"""Joint estimation of pose, shape and translation by Gauss-Newton on point-to-plane distances.

Every correspondence is a point p, its normal n and the place x of the skin nearest to it. Its
residual n . (p - y(x)) is exact, its derivative is that of the sample vertex nearest to x on the
template, J_s (3 x D). While the fit is coarse, some sample vertices represent the whole surface,
and x is one of them, n its normal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from workers.scape.evidence.cameras import CameraCorrections, CameraEvidence
from workers.scape.evidence.rows import CameraTerms
from workers.scape.fit.annealing import AnnealingStep
from workers.scape.fit.gauss_newton import (
    DAMPING,
    TwistPrior,
    add_shape_prior,
    shape_parameters,
    updated,
)
from workers.scape.fit.normal_equations import (
    DataTerms,
    Target,
    bound_rows,
    data_terms,
    probed_places,
)
from workers.scape.fit.observer import Observer, unobserved
from workers.scape.fit.sampling import Sampling
from workers.scape.model.body_model import BodyModel, BodyState

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_THUMB_STIFFNESS = 3.0
"""A thumb has few points, which must not turn it into the palm."""
_CAMERA_SHARE = 0.5
"""Share of the rows' information that counts for the cameras: a body that the model cannot follow
pulls many rows the same way, and would move cameras that stand right."""
_MIN_WEIGHT, _WEIGHT_SLACK = 1e-12, 1e-9
"""Added to the diagonal of each sample's weight, absolute and as a share of its trace, so that
weights of rank 1 and 2 have a Cholesky factor."""


@dataclass(frozen=True, slots=True)
class JointResult:
    """State of the body and corrections of the cameras after a joint estimation."""

    state: BodyState
    cameras: CameraCorrections
    vertices: Array
    """(P, 3), the model's surface."""
    correspondences: int
    """Number of pairs in the last step."""
    evidence: CameraEvidence | None
    """None where corrections were not estimated."""


def fit_jointly(
    model: BodyModel,
    sampling: Sampling,
    target: Target,
    state: BodyState,
    cameras: CameraCorrections,
    schedule: Sequence[AnnealingStep],
    progress: Callable[[float], None] = lambda share: None,  # noqa: ARG005
    observer: Observer = unobserved,
) -> JointResult:
    """Minimise robust two-way distances and priors, from coarse to fine.

    Args:
        sampling: sample vertices of the model.
        cameras: corrections to start from.
        schedule: settings of each step.
        progress: called with the share of the steps that are done.
    """
    prior = TwistPrior.build(model, _THUMB_STIFFNESS)
    tracked = target.tracked(model)
    terms: DataTerms | None = None
    evidence: Callable[[], CameraEvidence] | None = None
    # Terms that do not depend on each other are computed here and in one thread beside.
    with ThreadPoolExecutor(max_workers=1) as beside:
        for step, annealing in enumerate(schedule):
            samples = sampling.body.first(annealing.samples)
            derivative = beside.submit(samples.jacobian, state, annealing.components)
            skin = (sampling.coarse_skin if annealing.coarse else sampling.skin)(model, state)
            probe = partial(probed_places, model, target, skin, annealing)
            # Behind the derivative of many samples, probes would come too late.
            probed = beside.submit(probe).result if annealing.coarse else probe
            bounds = beside.submit(bound_rows, model, target, cameras, skin, annealing)
            terms = data_terms(
                model, target, tracked, probed, bounds, cameras, skin, annealing, beside
            )
            if observer is not unobserved:
                drawn = {"on_body": terms.on_body, "on_cloud": terms.on_cloud}
                drawn["gate_m"] = np.array(annealing.gate_m)
                observer("correspondences", {"vertices": model.vertices(state), **drawn})
            state, cameras, evidence = _step(
                model,
                state,
                cameras,
                derivative.result()[1],
                terms,
                prior,
                annealing.relaxation,
                beside,
            )
            progress((step + 1) / len(schedule))
    assert terms is not None
    return JointResult(
        state,
        cameras,
        model.vertices(state),
        len(terms.on_body),
        None if evidence is None else evidence(),
    )


def _step(
    model: BodyModel,
    state: BodyState,
    cameras: CameraCorrections,
    derivative: Array32,
    terms: DataTerms,
    prior: TwistPrior,
    relaxation: float,
    beside: ThreadPoolExecutor,
) -> tuple[BodyState, CameraCorrections, Callable[[], CameraEvidence] | None]:
    """One Gauss-Newton step, given the derivative (n, 3, D) of the samples; and a function that
    gives the evidence of its rows about the cameras."""
    size = derivative.shape[2]
    shape = shape_parameters(model, size - 3 * model.part_count - 3)
    rows = derivative.reshape(-1, size)
    coupling = None if terms.cameras is None else beside.submit(_coupling, rows, terms.cameras)
    extra = 0 if coupling is None else cameras.xi.size
    normal, gradient = np.zeros((size + extra, size + extra)), np.zeros(size + extra)
    # The weights are split between both sides: numpy then computes one triangle of the product.
    slack = _WEIGHT_SLACK * np.trace(terms.weight, axis1=1, axis2=2)[:, None, None] + _MIN_WEIGHT
    half = np.linalg.cholesky(terms.weight + slack * np.eye(3)).astype(np.float32)
    weighted = (half.transpose(0, 2, 1) @ derivative).reshape(-1, size)
    normal[:size, :size] = weighted.T @ weighted
    gradient[:size] = terms.residual.ravel().astype(np.float32) @ rows
    add_shape_prior(state, normal, gradient, shape)
    prior.add(model, state, normal, gradient)
    body_only = np.arange(size)
    normal[body_only, body_only] += DAMPING * np.trace(normal) / size
    evidence: Callable[[], CameraEvidence] | None = None
    if coupling is not None:
        of_cameras, together = coupling.result()
        information = scipy.linalg.block_diag(*cameras.prior_information()) / _CAMERA_SHARE
        normal[size:, size:] = of_cameras.normal + information
        gradient[size:] = of_cameras.gradient - information @ cameras.xi.ravel()
        normal[:size, size:] = -together
        normal[size:, :size] = -together.T
        evidence = partial(_evidence, normal, gradient, of_cameras, cameras)
    delta = scipy.linalg.cho_solve(scipy.linalg.cho_factor(normal), gradient)
    if coupling is not None:
        cameras = cameras.updated(delta[size:].reshape(-1, 6))
    return updated(state, relaxation * delta, shape), cameras, evidence


def _coupling(rows: Array32, terms: Future[CameraTerms]) -> tuple[CameraTerms, Array32]:
    """The cameras' terms, and the samples' derivative (3 n, D) times that by the corrections.

    It may wait in the thread that computes the terms, which was given them before.
    """
    cross = terms.result().cross
    together = rows.T @ cross.reshape(len(rows), -1).astype(np.float32)
    return terms.result(), together


def _evidence(
    normal: Array, gradient: Array, terms: CameraTerms, cameras: CameraCorrections
) -> CameraEvidence:
    """The rows' normal equations with the body's parameters eliminated, without the corrections'
    own prior, about corrections of zero."""
    size = len(gradient) - len(terms.gradient)
    cross = normal[:size, size:]
    body = scipy.linalg.cho_factor(normal[:size, :size])
    solved = scipy.linalg.cho_solve(body, np.column_stack([cross, gradient[:size]]))
    information = terms.normal - cross.T @ solved[:, :-1]
    vector = terms.gradient - cross.T @ solved[:, -1] + information @ cameras.xi.ravel()
    symmetric = 0.5 * (information + information.T)
    return CameraEvidence(_CAMERA_SHARE * symmetric, _CAMERA_SHARE * vector)
