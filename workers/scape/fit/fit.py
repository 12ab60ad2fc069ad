"""Fit of the SCAPE model to a cloud: start, joint estimation, surface, crossings, verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workers.cloud.observed import Finding, PointCloud, Preprocessed, check_shows_a_body
from workers.scape.evidence.cameras import CameraCorrections, CameraEvidence
from workers.scape.evidence.crown import crown_sigma_m
from workers.scape.evidence.rims import rims_of
from workers.scape.fit.annealing import COARSE, FINE, MIDDLE
from workers.scape.fit.hands import place_hands
from workers.scape.fit.head import settle_head
from workers.scape.fit.initial import is_head_hidden, starting_states, taller
from workers.scape.fit.joint import JointResult, fit_jointly
from workers.scape.fit.normal_equations import Target, even_subset
from workers.scape.fit.observer import Observer, unobserved
from workers.scape.fit.paper import fit_like_the_paper
from workers.scape.fit.sampling import Sampling
from workers.scape.model.blas import single_threaded_blas
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import vertex_normals
from workers.scape.model.halves import started
from workers.scape.surface.displacement import SurfaceFit, fit_surface
from workers.scape.surface.intersections import untangled
from workers.scape.verdict.clothes import Clothing, clothing_signs
from workers.scape.verdict.hair import Hair, hair_of, head_cover_m
from workers.scape.verdict.posture import (
    arms_inside,
    feet_cut_off,
    head_cut_off,
    head_turned,
    leaning,
    off_floor,
)
from workers.scape.verdict.seen import PartReport, report_parts, sides_seen, unexplained_share
from workers.scape.verdict.unmatched import Patch, unmatched_patches
from workers.scape.verdict.verdict import Verdict, hair_remarks, judge, lost_parts

Array = NDArray[np.float64]
Method = Literal["joint", "paper"]
Progress = Callable[[str, float], None]

_JOINT_POINTS = 30_000
"""Points of the cloud that the joint fit uses."""
_START_POINTS, _START_SAMPLES = 800, 250
"""Points of the cloud and vertices of the model that starting poses are compared with."""
_FACING_EVERY = 10
"""Every so many points are used to find the direction that the toes point in."""
_STEPS = len(COARSE) + len(MIDDLE) + len(FINE)
"""Steps of the joint fit from one starting pose."""
_MAX_STARTS = 8
"""Starting poses that are tried at most, 80 ms each: with 5, 3 of 928 sound clouds lost an arm."""
_RIM_EVERY = 8
"""Every so many vertices of a hand are used to find it in an image."""
_EXPLAINED = 0.008
"""Share of unexplained points below which no other starting pose is tried."""
_DELIVERED_DIGITS = 7
"""Decimals of delivered coordinates in metres."""


@dataclass(frozen=True, slots=True)
class FitResult:
    """Fitted body with its quality."""

    state: BodyState
    vertices: Array
    """(P, 3): the surface, world frame, metres."""
    overlapping: Array
    """(P, 3): the surface before limbs that press into each other were separated. It is measured,
    since each limb keeps the girth that it has when it is held away."""
    cloud: PointCloud
    """The scan's cloud after the corrections of the cameras."""
    vertex_sigma_m: Array
    """(P,): standard deviation along the normal, in excess of an ordinary scan's."""
    crown_sigma_m: float
    """Standard deviation of the top of the head, in excess of an ordinary scan's."""
    vertex_seen: NDArray[np.bool_]
    parts: tuple[PartReport, ...]
    verdict: Verdict
    point_to_surface_rms_m: float
    coverage: float
    correspondences: int
    iterations: int
    """Steps from the starting pose that was chosen, without those of a second look at the head."""
    camera_shifts_m: dict[str, float]
    """Distance by which each camera's points were moved to agree with the others."""
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class OverlappingFit:
    """Fitted body before limbs that press into each other are separated."""

    state: BodyState
    vertices: Array
    """(P, 3)."""
    surface: SurfaceFit
    """The same surface, not rounded, with its standard deviations and residuals."""
    reference: Array | None
    """(P, 3): the model's surface in this state; None for the paper's method, whose surface is not
    separated."""
    crown_sigma_m: float
    """Standard deviation of the top of the head, in excess of an ordinary scan's."""
    head_cover_m: float
    """Thickness at most (95 %) of hair or a cap all around the head."""
    patches: Future[tuple[Patch, ...]]
    """Patches of the scan that the surface does not explain, which are searched for meanwhile."""
    clothing: Future[list[Clothing]]
    """Signs of clothing, which are searched for meanwhile."""
    cloud: PointCloud
    correspondences: int
    iterations: int
    camera_shifts_m: dict[str, float]
    evidence: CameraEvidence | None
    """Evidence of the scan about its cameras' places."""
    seconds: dict[str, float]


@lru_cache(maxsize=2)
def sampling_of(model: BodyModel) -> Sampling:
    """Sample vertices of a model, which are the same for every scan."""
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
    with single_threaded_blas():
        overlapping = fit_overlapping(model, scan, method, progress, observer)
        return separate_limbs(model, overlapping, scan.findings, observer)


def fit_overlapping(
    model: BodyModel, scan: Preprocessed, method: Method, progress: Progress, observer: Observer
) -> OverlappingFit:
    """First part of `fit_body`, after which the body can be measured.

    Raises:
        InputError: the cloud holds no body that could be fitted.
    """
    cloud = scan.cloud
    check_shows_a_body(cloud)
    observer("cloud", {"points": cloud.points, "normals": cloud.normals})
    start = time.monotonic()
    progress("aligning", 0.0)
    sampling = sampling_of(model)
    most_points = len(cloud) if method == "paper" else _JOINT_POINTS
    target, starts = _prepared(model, sampling, scan, most_points)
    if observer is not unobserved:
        observer("start", {"vertices": model.vertices(starts[0])})
    aligned = time.monotonic()
    reference, evidence = None, None
    if method == "paper":
        surface, state, iterations = fit_like_the_paper(
            model, target, starts[0], lambda share: progress("fitting", share), observer
        )
        used = int(np.isfinite(surface.residual_m).sum())
        cameras = CameraCorrections.build(cloud, scan.views, scan.predicted)
        fitted = time.monotonic()
    else:
        joint = _best_start(model, sampling, scan, target, starts, progress, observer)
        state, used, iterations = joint.state, joint.correspondences, _STEPS
        cameras, reference, evidence = joint.cameras, joint.vertices, joint.evidence
        observer("joint", {"vertices": reference})
        fitted = time.monotonic()
        progress("surface", 0.0)
        cloud = cameras.corrected(cloud)
        surface = fit_surface(model, reference, cloud, scan.views, cameras.poses(scan.views))
    crown_sigma = crown_sigma_m(
        model, scan.views, cameras.poses(scan.views), surface.vertices, cloud.points, surface.seen
    )
    return OverlappingFit(
        state=state,
        vertices=_rounded(surface.vertices),
        surface=surface,
        reference=reference,
        crown_sigma_m=crown_sigma,
        head_cover_m=head_cover_m(model, surface.vertices, reference, state.rotations),
        # Only intervals and verdict need these: whoever separates limbs does not wait for them.
        patches=started(unmatched_patches, model, surface.vertices, cloud),
        clothing=started(clothing_signs, model, reference, state.rotations, surface, cloud),
        cloud=cloud,
        correspondences=used,
        iterations=iterations,
        camera_shifts_m=cameras.shifts_m(scan.cloud),
        evidence=evidence,
        seconds={
            "align": aligned - start,
            "icp": fitted - aligned,
            "optimise": time.monotonic() - fitted,
        },
    )


def _prepared(
    model: BodyModel, sampling: Sampling, scan: Preprocessed, most_points: int
) -> tuple[Target, list[BodyState]]:
    """The cloud prepared for the search of correspondences, and starting states, best first."""
    points = scan.cloud.points
    few = points[even_subset(len(points), _START_POINTS)]
    building = started(Target.build, scan.cloud, scan.views, most_points)
    scout = sampling.body.first(_START_SAMPLES)
    starts = starting_states(model, scout, few, points[::_FACING_EVERY])
    return building.result(), starts


def separate_limbs(
    model: BodyModel, fit: OverlappingFit, findings: Sequence[Finding], observer: Observer
) -> FitResult:
    """Second part of `fit_body`: separate limbs that press into each other, and judge."""
    start = time.monotonic()
    surface, vertices = fit.surface, fit.surface.vertices
    if fit.reference is not None:
        crossing = None if surface.crossing is None else surface.crossing.result()
        vertices = untangled(model, vertices, fit.reference, surface.measured, crossing)
    observer("surface", {"vertices": vertices, "residual_m": surface.residual_m})
    parts, rms_m = report_parts(model, vertices, surface.seen, fit.cloud)
    rotations = fit.state.rotations
    noticed = [*findings, *leaning(model, rotations)]
    arms = arms_inside(model, fit.vertices)
    misplaced = {**head_turned(model, rotations), **arms}
    if not fit.camera_shifts_m:
        if fit.reference is not None:
            noticed += off_floor(model, fit.reference)
        misplaced |= feet_cut_off(model, vertices, fit.cloud.points)
        misplaced |= head_cut_off(model, surface.seen, fit.crown_sigma_m)
    patches = fit.patches.result()
    # What lies beside the head may be an arm that was not found.
    hair = Hair() if arms else hair_of(model, patches, fit.surface.vertices, fit.cloud)
    lost = lost_parts(model, patches, hair)
    remarks, signs = hair_remarks(hair, fit.head_cover_m), fit.clothing.result()
    sides = sides_seen(model, vertices, surface.seen)
    stature_m, beta, shifts = np.ptp(vertices[:, 2]), fit.state.beta, fit.camera_shifts_m
    verdict = judge(
        parts, sides, noticed, lost, stature_m, beta, shifts, rms_m, misplaced, remarks, signs
    )
    delivered = _rounded(vertices)
    observer("done", {"vertices": delivered})
    return FitResult(
        state=fit.state,
        vertices=delivered,
        overlapping=fit.vertices,
        cloud=fit.cloud,
        vertex_sigma_m=surface.sigma_m,
        crown_sigma_m=fit.crown_sigma_m,
        vertex_seen=surface.seen,
        parts=parts,
        verdict=verdict,
        point_to_surface_rms_m=rms_m,
        coverage=float(surface.seen.mean()),
        correspondences=fit.correspondences,
        iterations=fit.iterations,
        camera_shifts_m=fit.camera_shifts_m,
        seconds={**fit.seconds, "judge": time.monotonic() - start},
    )


def _rounded(vertices: Array) -> Array:
    """Vertices rounded to 0.1 micrometres, so that the same scan gives the same file.

    The last bits of sums depend on where arrays lie in memory.
    """
    return np.round(vertices, _DELIVERED_DIGITS)


def _best_start(
    model: BodyModel,
    sampling: Sampling,
    scan: Preprocessed,
    target: Target,
    starts: Sequence[BodyState],
    progress: Progress,
    observer: Observer,
) -> JointResult:
    """Fit from the best start, and from others as long as too many points stay unexplained.

    Of starts that leave points unexplained, the best has the least sum of their share and the share
    of skin that cameras saw through: a body with its arms up explains one whose arm was not seen.
    """
    best, hidden, least, first = None, None, np.inf, starts[0]
    cloud, views = scan.cloud, scan.views
    cameras = CameraCorrections.build(cloud, views, scan.predicted)
    for start in starts[:_MAX_STARTS]:
        coarse = fit_jointly(model, sampling, target, start, cameras, COARSE, observer=observer)
        looked = started(is_head_hidden, model, coarse.vertices, cloud.points)
        left = unexplained_share(model, coarse.vertices, cloud)
        if left < _EXPLAINED:
            best, hidden, first = coarse, looked, start
            break
        poses = coarse.cameras.poses(views)
        absent = target.free_space.seen_through(poses, coarse.vertices)
        wrong = left + float(absent @ model.vertex_shares) / len(absent)
        if wrong < least:
            best, hidden, least, first = coarse, looked, wrong, start
    assert best is not None
    assert hidden is not None
    if hidden.result():
        start = taller(model, first)
        best = fit_jointly(model, sampling, target, start, cameras, COARSE, observer=observer)
    done, total = 0, len(MIDDLE) + len(FINE)
    hands = sampling.hands
    for schedule in (MIDDLE, FINE):
        share = len(schedule) / total
        parts, places = model.part_of_vertex[::_RIM_EVERY], best.vertices[::_RIM_EVERY]
        bodies = [places[np.isin(parts, hand.parts)] for hand in hands]
        with ThreadPoolExecutor(1) as beside:
            rims = beside.submit(rims_of, views, cloud.camera_names, bodies)
            normals = vertex_normals(best.vertices, model.faces)
            state = place_hands(model, hands, target.tree, best.state, best.vertices, normals)
            target = replace(target, rims=rims.result())
        best = fit_jointly(
            model,
            sampling,
            target,
            state,
            best.cameras,
            schedule,
            partial(_report, progress, done / total, share),
            observer,
        )
        done += len(schedule)
        if schedule is MIDDLE:
            best = settle_head(model, sampling, target, best, observer)
    return best


def _report(progress: Progress, before: float, share: float, of_schedule: float) -> None:
    progress("fitting", before + share * of_schedule)
