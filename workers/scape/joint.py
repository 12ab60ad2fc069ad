"""Pose, shape and place at once: Gauss-Newton on two-way point-to-plane distances.

Every correspondence is a point p, a vertex v and the vertex' normal n; its residual n . (p - y_v)
is exact, its derivative that of the sample vertex nearest to v on the template. Rows of one sample
share a derivative J_s (3 x D), so they add up to a 3 x 3 weight before anything is multiplied.
While the fit is coarse, some sample vertices stand for the whole skin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from station.depth import CameraView, PointCloud
from station.geometry import so3_exp
from workers.scape.cameras import CameraCorrections
from workers.scape.correspondence import Followers, OrientedTree
from workers.scape.crown import reach
from workers.scape.free_space import FreeSpace
from workers.scape.model import BodyModel, BodyState
from workers.scape.observer import Observer, unobserved
from workers.scape.rims import rims_of
from workers.scape.rows import CameraTerms, Rows, Skin, crown_rows, floor_rows, outline_rows
from workers.scape.sampled import twist_chain
from workers.scape.sampling import COARSE_SAMPLES, FINE_SAMPLES, Sampling

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_MODEL_SIGMA_M = 0.003
"""What shape and pose cannot express; it is shared by neighbours, so rows count less."""
_TWIST_INFLATION = 1.5
_THUMB_STIFFNESS = 3.0
_PULLED_POINTS = 10_000
_COARSELY_PULLED = 4
"""While the fit is coarse, every so many of them."""
_ASIDE = 2.0
"""A point is as far away as it lies ahead of a vertex, or at most so many times as far."""
_SPACING_M = 0.002
"""Points next to each other lie so far apart."""
_EVERY = 1 << 20
"""Components: as many as the model has."""


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the annealing."""

    samples: int
    components: int
    gate_m: float
    angle_rad: float
    scale_m: float
    """Of the robust weight: residuals beyond it lose their pull."""
    row_share: float
    """What one row counts: neighbours share what the model cannot express. Low at first, so that
    the prior carries the face and the hands as they are to where they belong."""

    @property
    def coarse(self) -> bool:
        """Whether samples stand for the whole skin."""
        return self.samples == COARSE_SAMPLES

    @property
    def limits(self) -> dict[str, float]:
        """Of the correspondences."""
        return {"max_distance_m": self.gate_m, "max_angle_rad": self.angle_rad}


COARSE = (
    *(Stage(COARSE_SAMPLES, 6, 0.20, np.radians(75), 0.060, 0.06) for _ in range(4)),
    *(Stage(COARSE_SAMPLES, 16, 0.12, np.radians(65), 0.030, 0.06) for _ in range(4)),
    *(Stage(COARSE_SAMPLES, 40, 0.08, np.radians(55), 0.018, 0.06) for _ in range(3)),
)
MIDDLE = tuple(Stage(FINE_SAMPLES, _EVERY, 0.05, np.radians(45), 0.010, 0.06) for _ in range(2))
FINE = tuple(Stage(FINE_SAMPLES, _EVERY, 0.03, np.radians(40), 0.006, 0.60) for _ in range(3))


@dataclass(frozen=True, slots=True)
class Target:
    """The cloud as the correspondences use it."""

    tree: OrientedTree
    sigma_m: Array
    pulled: NDArray[np.intp]
    """Points that look for their vertex; a fixed, even subset."""
    coarse: OrientedTree
    """Of these alone."""
    free_space: FreeSpace
    views: tuple[CameraView, ...]
    """In the order of their corrections."""
    camera: NDArray[np.integer]
    """(n,): whose point it is."""
    rims: PointCloud
    """Of the hands, once it is known where they are."""

    @classmethod
    def build(cls, cloud: PointCloud, views: Sequence[CameraView], most_points: int) -> Target:
        """An even subset of a cloud's points."""
        used = even_subset(len(cloud), most_points)
        points, normals = cloud.points[used], cloud.normals[used]
        pulled = even_subset(len(used), _PULLED_POINTS)
        return cls(
            OrientedTree.build(points, normals),
            cloud.sigma_m[used],
            pulled,
            OrientedTree.build(points[pulled], normals[pulled]),
            FreeSpace.build(views),
            tuple(views),
            cloud.camera[used],
            rims_of((), cloud.camera_names, ()),
        )


def even_subset(count: int, wanted: int) -> NDArray[np.intp]:
    """The same pseudo-random subset for the same count: same input, same output."""
    if count <= wanted:
        return np.arange(count)
    return np.sort(np.random.default_rng(count).choice(count, wanted, replace=False))


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
    terms: _DataTerms | None = None
    # What need not wait for one another is done side by side.
    with ThreadPoolExecutor(max_workers=2) as beside:
        for step, stage in enumerate(schedule):
            samples = sampling.body.first(stage.samples)
            derivative = beside.submit(samples.jacobian, state, stage.components)
            skin = (sampling.coarse_skin if stage.coarse else sampling.skin)(model, state)
            probed = beside.submit(_probed, model, target, skin, stage)
            bounds = beside.submit(_bounds, model, target, cameras, skin, stage)
            terms = _data_terms(target, followers, probed, bounds, cameras, skin, stage)
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
class _DataTerms:
    weight: Array
    """(n, 3, 3) at each sample."""
    pull: Array
    """(n, 3)."""
    cameras: CameraTerms | None
    """None while the corrections are kept."""
    on_body: Array
    """(m, 3): one end of each correspondence."""
    on_cloud: Array
    """(m, 3): the other."""


def _probed(
    model: BodyModel, target: Target, skin: Skin, stage: Stage
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Even places of the skin that have a point, and which."""
    cloud = target.coarse if stage.coarse else target.tree
    probes = np.arange(0, len(skin.share), max(1, len(skin.share) // (2 * stage.samples)))
    probing, found = cloud.pairs(skin.positions[probes], skin.normals[probes], **stage.limits)
    place = probes[probing]
    if stage.coarse:
        return place, target.pulled[found]
    kept = ~np.isin(skin.part[place], model.hand_parts)
    kept |= _before(skin.positions[place], skin.normals[place], cloud.points[found])
    return place[kept], found[kept]


def _before(places: Array, normals: Array, points: Array) -> NDArray[np.bool_]:
    """Whether points (n, 3) lie before or behind oriented places (n, 3) rather than beside them.

    The tip of a finger gives no reading: what is nearest to it is the cloud's border, and would
    draw it back (pairs at a mesh's border are left out since Turk & Levoy 1994).
    """
    offset = points - places
    away = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    ahead = np.abs(np.einsum("ni,ni->n", offset, normals))
    return np.asarray(away < _ASIDE * ahead + _SPACING_M)


def _bounds(
    model: BodyModel, target: Target, cameras: CameraCorrections, skin: Skin, stage: Stage
) -> tuple[Rows, ...]:
    """What floor, outlines and crown say."""
    floor = floor_rows(model, skin, max(0.012, 0.5 * stage.gate_m))
    if stage.coarse:
        return (floor,)
    poses = cameras.poses(target.views)
    outline = outline_rows(model, target.free_space, poses, skin, stage.row_share)
    return floor, outline, crown_rows(reach(model, target.views, poses, skin.positions))


def _data_terms(
    target: Target,
    followers: Followers,
    probed: Future[tuple[NDArray[np.intp], NDArray[np.intp]]],
    bounds: Future[tuple[Rows, ...]],
    cameras: CameraCorrections,
    skin: Skin,
    stage: Stage,
) -> _DataTerms:
    """Correspondences and bounds, summed up at the samples."""
    cloud = target.tree
    if stage.coarse:
        pulled = target.pulled[::_COARSELY_PULLED]
        asking, mine = OrientedTree.build(skin.positions, skin.normals).pairs(
            cloud.points[pulled], cloud.normals[pulled], **stage.limits
        )
    else:
        pulled = target.pulled
        asking, mine = followers.pairs(skin.positions, skin.normals, **stage.limits)
        # The rims come after the points.
        border = int(np.searchsorted(asking, len(pulled)))
        rimmed, at_rims = asking[border:] - len(pulled), mine[border:]
        asking, mine = asking[:border], mine[:border]
    probes, found = probed.result()
    place = np.concatenate([mine, probes])
    point = np.concatenate([pulled[asking], found])
    on_body, camera = skin.positions[place], target.camera[point]
    on_cloud = cameras.moved(cloud.points[point], camera)
    direction = skin.normals[place]
    rows = [_pulled(place, direction, on_cloud - on_body, target.sigma_m[point], stage)]
    camera_terms = None
    if not stage.coarse:
        if len(cameras):
            derivative = cameras.derivative(on_cloud, camera, direction)
            camera_terms = CameraTerms.build(
                rows[0], derivative, camera, len(cameras), skin, stage.samples
            )
        rows.append(_rim_rows(target.rims, rimmed, cameras, skin, at_rims, stage))
    weight, pull = Rows.joined(*rows, *bounds.result()).at_samples(skin, stage.samples)
    return _DataTerms(weight, pull, camera_terms, on_body, on_cloud)


def _rim_rows(
    rims: PointCloud,
    rimmed: NDArray[np.intp],
    cameras: CameraCorrections,
    skin: Skin,
    place: NDArray[np.intp],
    stage: Stage,
) -> Rows:
    """Places of hands end where cameras saw them end before the booth."""
    offset = cameras.moved(rims.points[rimmed], rims.camera[rimmed]) - skin.positions[place]
    return _pulled(place, rims.normals[rimmed], offset, rims.sigma_m[rimmed], stage)


def _pulled(
    place: NDArray[np.intp], direction: Array, offset: Array, sigma_m: Array, stage: Stage
) -> Rows:
    """Places of the skin that go by an offset (n, 3) as far as it is along a direction (n, 3)."""
    residual = np.einsum("ni,ni->n", direction, offset)
    robust = 1.0 / (1.0 + (residual / stage.scale_m) ** 2) ** 2
    variance = sigma_m**2 + _MODEL_SIGMA_M**2
    return Rows(place, direction, residual, stage.row_share * robust / variance)


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
    terms: _DataTerms,
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
