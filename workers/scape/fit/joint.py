"""Pose, shape and place at once: Gauss-Newton on two-way point-to-plane distances.

Every correspondence is a point p, a vertex v and the vertex' normal n; its residual n . (p - y_v)
is exact, its derivative that of the sample vertex nearest to v on the template, J_s (3 x D).
While the fit is coarse, some sample vertices stand for the whole skin.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from station.core.geometry import so3_exp
from workers.cloud.observed import PointCloud
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.evidence.correspondence import Followers
from workers.scape.fit.observer import Observer, unobserved
from workers.scape.fit.pull import DataTerms, Target, bounds, data_terms, probed_places
from workers.scape.fit.sampling import Sampling
from workers.scape.fit.stages import Stage
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.sampled import twist_chain

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_TWIST_INFLATION = 1.5
_THUMB_STIFFNESS = 3.0


@dataclass(frozen=True, slots=True)
class JointResult:
    state: BodyState
    cameras: CameraCorrections
    vertices: Array
    rims: PointCloud
    """Of the hands, as the target had them."""
    correspondences: int
    iterations: int


def fit_jointly(
    model: BodyModel,
    sampling: Sampling,
    target: Target,
    state: BodyState,
    cameras: CameraCorrections,
    schedule: tuple[Stage, ...],
    progress: Callable[[float], None] = lambda share: None,  # noqa: ARG005
    observer: Observer = unobserved,
) -> JointResult:
    """Minimise robust two-way distances with priors, coarse to fine."""
    prior = _TwistPrior.build(model)
    pulled = target.pulled
    followers = Followers(
        model.neighbours,
        np.concatenate([target.tree.points[pulled], target.rims.points]),
        np.concatenate([target.tree.normals[pulled], target.rims.normals]),
    )
    terms: DataTerms | None = None
    # What need not wait for one another is done side by side.
    with ThreadPoolExecutor(max_workers=2) as beside:
        for step, stage in enumerate(schedule):
            samples = sampling.body.first(stage.samples)
            derivative = beside.submit(samples.jacobian, state, stage.components)
            skin = (sampling.coarse_skin if stage.coarse else sampling.skin)(model, state)
            probed = beside.submit(probed_places, model, target, skin, stage)
            bounding = beside.submit(bounds, model, target, cameras, skin, stage)
            terms = data_terms(target, followers, probed, bounding, cameras, skin, stage)
            if observer is not unobserved:
                drawn = {"on_body": terms.on_body, "on_cloud": terms.on_cloud}
                observer("correspondences", {"vertices": model.vertices(state), **drawn})
            state, cameras = _step(model, state, cameras, derivative.result()[1], terms, prior)
            progress((step + 1) / len(schedule))
    assert terms is not None
    return JointResult(
        state, cameras, model.vertices(state), target.rims, len(terms.on_body), len(schedule)
    )


@dataclass(frozen=True, slots=True)
class _TwistPrior:
    """Gaussian over the relative twists, wider than the training poses."""

    mean: Array
    information: Array

    @classmethod
    def build(cls, model: BodyModel) -> _TwistPrior:
        covariance = model.twist_covariance * _TWIST_INFLATION**2
        covariance = covariance + np.radians(1.5) ** 2 * np.eye(len(covariance))
        # The few points of a thumb must not turn it into the palm.
        stiff = [
            _THUMB_STIFFNESS if name.startswith("thumb") else 1.0 for name in model.part_names[1:]
        ]
        scale = np.repeat(stiff, 3)
        information = np.linalg.inv(covariance) * scale[:, None] * scale[None, :]
        return cls(model.twist_mean, information)


def _step(
    model: BodyModel,
    state: BodyState,
    cameras: CameraCorrections,
    derivative: Array32,
    terms: DataTerms,
    prior: _TwistPrior,
) -> tuple[BodyState, CameraCorrections]:
    """One Gauss-Newton step; derivative is that of the samples, (n, 3, D)."""
    parts = model.part_count
    size = derivative.shape[2]
    active = size - 3 * parts - 3
    rows = derivative.reshape(-1, size)
    extra = 0 if terms.cameras is None else len(terms.cameras.gradient)
    normal, gradient = np.zeros((size + extra, size + extra)), np.zeros(size + extra)
    # Half of the weights goes to either side: numpy then computes one triangle of the product.
    slack = 1e-9 * np.trace(terms.weight, axis1=1, axis2=2)[:, None, None] + 1e-12
    half = np.linalg.cholesky(terms.weight + slack * np.eye(3)).astype(np.float32)
    weighted = (half.transpose(0, 2, 1) @ derivative).reshape(-1, size)
    normal[:size, :size] = weighted.T @ weighted
    gradient[:size] = terms.pull.ravel().astype(np.float32) @ rows
    shape = slice(3 * parts, 3 * parts + active)
    normal[shape, shape] += np.eye(active)
    gradient[shape] -= state.beta[:active]
    change = twist_chain(model, state.rotations)
    twists = model.relative_twists(state.rotations)[1:].ravel()
    normal[: 3 * parts, : 3 * parts] += change.T @ prior.information @ change
    gradient[: 3 * parts] -= change.T @ prior.information @ (twists - prior.mean)
    body_only = np.arange(size)
    normal[body_only, body_only] += 1e-6 * np.trace(normal) / size
    if terms.cameras is not None:
        bound = scipy.linalg.block_diag(*cameras.bound())
        normal[size:, size:] = terms.cameras.normal + bound
        gradient[size:] = terms.cameras.gradient - bound @ cameras.xi.ravel()
        together = rows.T @ terms.cameras.cross.reshape(-1, extra).astype(np.float32)
        normal[:size, size:] = -together
        normal[size:, :size] = -together.T
    delta = scipy.linalg.cho_solve(scipy.linalg.cho_factor(normal), gradient)
    turned = np.clip(delta[: 3 * parts].reshape(-1, 3), -0.5, 0.5)
    beta = state.beta.copy()
    beta[:active] += delta[shape]
    new = BodyState(
        so3_exp(turned) @ state.rotations, beta, state.translation + delta[size - 3 : size]
    )
    if extra:
        cameras = cameras.stepped(delta[size:].reshape(-1, 6))
    return new, cameras
