"""The fit of the SCAPE model to a cloud, step by step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from station.core.errors import InputError
from workers.cloud.observed import (
    LEAST_POINTS,
    POSSIBLE_HEIGHTS_M,
    CameraView,
    Finding,
    PointCloud,
    Preprocessed,
)
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.evidence.crown import reach
from workers.scape.evidence.rims import rims_of
from workers.scape.fit.hands import place_hands
from workers.scape.fit.initial import starting_states
from workers.scape.fit.joint import JointResult, fit_jointly
from workers.scape.fit.observer import Observer, unobserved
from workers.scape.fit.paper import fit_like_the_paper
from workers.scape.fit.pull import Target, even_subset
from workers.scape.fit.sampling import Sampling
from workers.scape.fit.stages import COARSE, FINE, MIDDLE
from workers.scape.fit.verdict import (
    PartReport,
    Verdict,
    judge,
    report_parts,
    sides_seen,
    unexplained_share,
)
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.displacement import SurfaceFit, fit_surface
from workers.scape.surface.intersections import untangled

Array = NDArray[np.float64]
Method = Literal["joint", "paper"]
Progress = Callable[[str, float], None]

_TREE_POINTS = 30_000
_COARSE_POINTS = 800
_SCOUT_SAMPLES = 250
_FACING_EVERY = 10
"""Of the points: enough to tell where the toes are."""
_MOST_STARTS = 4
_RIM_EVERY = 8
"""So many of a hand's vertices say about where it is."""
_EXPLAINED = 0.008


@dataclass(frozen=True, slots=True)
class FitResult:
    """A fitted body."""

    state: BodyState
    vertices: Array
    """(P, 3): the surface, world frame, metres."""
    overlapping: Array
    """(P, 3): the same before limbs that press into each other were taken apart: each with all its
    flesh, as a tape finds it around a limb that is held away."""
    cloud: PointCloud
    """What the surface was laid on: the scan's, its cameras corrected."""
    vertex_sigma_m: Array
    """(P,): posterior standard deviation along the normal."""
    vertex_seen: NDArray[np.bool_]
    parts: tuple[PartReport, ...]
    verdict: Verdict
    point_to_surface_rms_m: float
    coverage: float
    correspondences: int
    iterations: int
    camera_shifts_m: dict[str, float]
    """How far each camera's points had to move to agree with all others."""
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LaidBody:
    """A body whose surface lies on the cloud; limbs may press into each other."""

    state: BodyState
    vertices: Array
    """(P, 3)."""
    surface: SurfaceFit
    """The same, unrounded, with what is known of it."""
    reference: Array | None
    """(P, 3): the model's own surface in this state; None: the paper's, which is left as it is."""
    cloud: PointCloud
    correspondences: int
    iterations: int
    camera_shifts_m: dict[str, float]
    seconds: dict[str, float]


@lru_cache(maxsize=2)
def sampling_of(model: BodyModel) -> Sampling:
    """The model's samples: the same for every scan."""
    return Sampling.build(model)


def fit_body(
    model: BodyModel,
    scan: Preprocessed,
    *,
    method: Method = "joint",
    progress: Progress = lambda step, share: None,  # noqa: ARG005
    observer: Observer = unobserved,
) -> FitResult:
    """Fit the model to a preprocessed scan.

    Raises:
        InputError: the cloud holds no body that could be fitted.
    """
    with one_thread_in_blas():
        laid = lay_body(model, scan, method, progress, observer)
        return take_apart(model, laid, scan.findings, observer)


def one_thread_in_blas() -> threadpool_limits:
    """The order of its sums, and so every bit, stays the same; the other core has other work."""
    return threadpool_limits(limits=1, user_api="blas")


def lay_body(
    model: BodyModel, scan: Preprocessed, method: Method, progress: Progress, observer: Observer
) -> LaidBody:
    """The first part of `fit_body`, after which a body can be measured.

    Raises:
        InputError: the cloud holds no body that could be fitted.
    """
    cloud = scan.cloud
    _refuse_absurd(cloud)
    observer("cloud", {"points": cloud.points, "normals": cloud.normals})
    start = time.monotonic()
    progress("aligning", 0.0)
    sampling = sampling_of(model)
    scout = sampling.body.first(_SCOUT_SAMPLES)
    most_points = len(cloud) if method == "paper" else _TREE_POINTS
    few = cloud.points[even_subset(len(cloud), _COARSE_POINTS)]
    with ThreadPoolExecutor(1) as beside:
        building = beside.submit(Target.build, cloud, scan.views, most_points)
        starts = starting_states(model, scout, few, cloud.points[::_FACING_EVERY])
        target = building.result()
    if observer is not unobserved:
        observer("start", {"vertices": model.vertices(starts[0])})
    aligned = time.monotonic()
    reference = None
    if method == "paper":
        surface, state, iterations = fit_like_the_paper(
            model, target, starts[0], lambda share: progress("icp", share), observer
        )
        used = int(np.isfinite(surface.residual_m).sum())
        cameras = CameraCorrections.build(cloud, scan.views)
        fitted = time.monotonic()
    else:
        joint = _best_start(model, sampling, cloud, scan.views, target, starts, progress, observer)
        state, used, iterations = joint.state, joint.correspondences, joint.iterations
        cameras, reference = joint.cameras, joint.vertices
        observer("joint", {"vertices": reference})
        fitted = time.monotonic()
        progress("surface", 0.0)
        cloud = cameras.corrected(cloud)
        crown = partial(reach, model, scan.views, cameras.poses(scan.views))
        surface = fit_surface(model, reference, cloud, cameras.corrected(joint.rims), crown)
    return LaidBody(
        state=state,
        vertices=_rounded(surface.vertices),
        surface=surface,
        reference=reference,
        cloud=cloud,
        correspondences=used,
        iterations=iterations,
        camera_shifts_m=cameras.shifts_m(scan.cloud),
        seconds={
            "align": aligned - start,
            "icp": fitted - aligned,
            "optimise": time.monotonic() - fitted,
        },
    )


def take_apart(
    model: BodyModel, laid: LaidBody, findings: Sequence[Finding], observer: Observer
) -> FitResult:
    """The second part of `fit_body`: limbs that press into each other are parted, and judged."""
    start = time.monotonic()
    surface, vertices = laid.surface, laid.surface.vertices
    if laid.reference is not None:
        vertices = untangled(model, vertices, laid.reference)
    observer("surface", {"vertices": vertices, "residual_m": surface.residual_m})
    parts, rms_m, unexplained = report_parts(model, vertices, surface.seen, laid.cloud)
    stature_m = float(np.ptp(vertices[:, 2]))
    sides = sides_seen(model, vertices, surface.seen)
    beta, shifts = laid.state.beta, laid.camera_shifts_m
    verdict = judge(parts, sides, findings, unexplained, stature_m, beta, shifts)
    delivered = _rounded(vertices)
    observer("done", {"vertices": delivered})
    return FitResult(
        state=laid.state,
        vertices=delivered,
        overlapping=laid.vertices,
        cloud=laid.cloud,
        vertex_sigma_m=surface.sigma_m,
        vertex_seen=surface.seen,
        parts=parts,
        verdict=verdict,
        point_to_surface_rms_m=rms_m,
        coverage=float(surface.seen.mean()),
        correspondences=laid.correspondences,
        iterations=laid.iterations,
        camera_shifts_m=laid.camera_shifts_m,
        seconds={**laid.seconds, "judge": time.monotonic() - start},
    )


def _rounded(vertices: Array) -> Array:
    """Sums depend in their last bit on where arrays lie in memory; a tenth of a micrometre does
    not: the same scan gives the same file."""
    return np.round(vertices, 7)


def _best_start(
    model: BodyModel,
    sampling: Sampling,
    cloud: PointCloud,
    views: Sequence[CameraView],
    target: Target,
    starts: Sequence[BodyState],
    progress: Progress,
    observer: Observer,
) -> JointResult:
    """Fit from the best start; from others too while a limb's worth of points stays unexplained."""
    best, least = None, np.inf
    cameras = CameraCorrections.build(cloud, views)
    for start in starts[:_MOST_STARTS]:
        coarse = fit_jointly(model, sampling, target, start, cameras, COARSE, observer=observer)
        left = unexplained_share(model, coarse.vertices, cloud)
        if left < least:
            best, least = coarse, left
        if least < _EXPLAINED:
            break
    assert best is not None
    done, steps = 0, len(MIDDLE) + len(FINE)
    hands = sampling.hands
    for schedule in (MIDDLE, FINE):
        share = len(schedule) / steps
        parts, places = model.part_of_vertex[::_RIM_EVERY], best.vertices[::_RIM_EVERY]
        bodies = [places[np.isin(parts, hand.parts)] for hand in hands]
        target = replace(target, rims=rims_of(views, cloud.camera_names, bodies))
        normals = vertex_normals(best.vertices, model.faces)
        state = place_hands(model, hands, target.tree, best.state, best.vertices, normals)
        best = fit_jointly(
            model,
            sampling,
            target,
            state,
            best.cameras,
            schedule,
            partial(_report, progress, done / steps, share),
            observer,
        )
        done += len(schedule)
    return best


def _report(progress: Progress, before: float, share: float, of_schedule: float) -> None:
    progress("icp", before + share * of_schedule)


def _refuse_absurd(cloud: PointCloud) -> None:
    if not (np.isfinite(cloud.points).all() and np.isfinite(cloud.normals).all()):
        raise InputError("the cloud holds values that are not numbers; repair or scan again")
    if len(cloud) < LEAST_POINTS:
        raise InputError(f"the cloud has {len(cloud)} points; a body needs {LEAST_POINTS}")
    height_m = float(np.ptp(cloud.points[:, 2]))
    if not POSSIBLE_HEIGHTS_M[0] < height_m < POSSIBLE_HEIGHTS_M[1]:
        raise InputError(
            f"the cloud is {height_m:.2f} m high; a standing adult in metres, z up, was expected"
        )
