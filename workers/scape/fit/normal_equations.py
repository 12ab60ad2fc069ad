"""Data terms of one step of the joint fit: correspondences, floor, outlines, crown and rims.

Rows of one sample vertex share its derivative, so they are summed up to a 3 x 3 weight and a
weighted residual before they are multiplied by it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.cloud.observed import CameraView, PointCloud
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.evidence.correspondence import OrientedTree, TrackedPoints
from workers.scape.evidence.crown import crown_rows
from workers.scape.evidence.floor import floor_rows
from workers.scape.evidence.free_space import FreeSpace
from workers.scape.evidence.rims import rims_of
from workers.scape.evidence.robust import spread_of
from workers.scape.evidence.rows import CameraTerms, Rows, Skin, outline_rows
from workers.scape.fit.annealing import AnnealingStep
from workers.scape.model.body_model import BodyModel
from workers.scape.surface.attachment import attached

Array = NDArray[np.float64]

_MODEL_SIGMA_M = 0.003
"""Standard deviation of what shape and pose cannot express. Neighbouring rows share it, which is
why a row counts less than once."""
_NOISE_LEFT = 0.7
"""Share of the points' standard deviation that their distances from the body show."""
_SUBSET_POINTS = 10_000
"""Points that are paired with their nearest vertex."""
_COARSE_EVERY = 4
"""Every so many of these points are used while the fit is coarse."""
_ASIDE = 2.0
"""Largest distance of a point to a vertex, as a multiple of its distance along the normal."""
_SPACING_M = 0.002
"""Distance between neighbouring points."""
_MIN_FLOOR_TOLERANCE_M = 0.012
_FLOOR_TOLERANCE_SHARE = 0.5
"""Feet are placed on the floor if they are within this distance, or this share of the gate."""


@dataclass(frozen=True, slots=True)
class Target:
    """Cloud, prepared for the search of correspondences."""

    tree: OrientedTree
    sigma_m: Array
    subset: NDArray[np.intp]
    """Indices of points that are paired with their nearest vertex; a fixed, even subset."""
    coarse: OrientedTree
    """Tree of this subset."""
    free_space: FreeSpace
    views: tuple[CameraView, ...]
    """Views in the order of the cameras' corrections."""
    camera: NDArray[np.integer]
    """(n,): index of each point's camera."""
    rims: PointCloud
    """Outlines of the hands; empty until it is known where the hands are."""

    @classmethod
    def build(cls, cloud: PointCloud, views: Sequence[CameraView], most_points: int) -> Target:
        """Prepare an even subset of at most `most_points` points."""
        used = even_subset(len(cloud), most_points)
        points, normals = cloud.points[used], cloud.normals[used]
        subset = even_subset(len(used), _SUBSET_POINTS)
        return cls(
            OrientedTree.build(points, normals),
            cloud.sigma_m[used],
            subset,
            OrientedTree.build(points[subset], normals[subset]),
            FreeSpace.build(views),
            tuple(views),
            cloud.camera[used],
            rims_of((), cloud.camera_names, ()),
        )

    def tracked(self, model: BodyModel) -> TrackedPoints:
        """The subset of points, followed by the rims, to be tracked over the model's surface."""
        points, normals = self.tree.points[self.subset], self.tree.normals[self.subset]
        return TrackedPoints(
            model.neighbours,
            np.concatenate([points, self.rims.points]),
            np.concatenate([normals, self.rims.normals]),
        )


def even_subset(count: int, wanted: int) -> NDArray[np.intp]:
    """Sorted pseudo-random subset of indices; the same for the same arguments."""
    if count <= wanted:
        return np.arange(count)
    return np.sort(np.random.default_rng(count).choice(count, wanted, replace=False))


@dataclass(frozen=True, slots=True)
class DataTerms:
    """Sums of the rows at n samples, and the m correspondences that they come from."""

    weight: Array
    """(n, 3, 3), sum of w d d^T over the rows of each sample."""
    residual: Array
    """(n, 3), sum of w r d."""
    cameras: Future[CameraTerms] | None
    """None while the corrections are kept fixed."""
    on_body: Array
    """(m, 3), places of the skin in the correspondences."""
    on_cloud: Array
    """(m, 3), their points."""


def probed_places(
    model: BodyModel, target: Target, skin: Skin, annealing: AnnealingStep
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Evenly spaced places of the skin that have a nearest point, and its index."""
    cloud = target.coarse if annealing.coarse else target.tree
    probes = np.arange(0, len(skin.share), max(1, len(skin.share) // (2 * annealing.samples)))
    probing, found = cloud.pairs(skin.positions[probes], skin.normals[probes], **annealing.limits)
    place = probes[probing]
    if annealing.coarse:
        return place, target.subset[found]
    kept = ~np.isin(skin.part[place], model.hand_parts)
    kept |= _along_normal(skin.positions[place], skin.normals[place], cloud.points[found])
    return place[kept], found[kept]


def _along_normal(places: Array, normals: Array, points: Array) -> NDArray[np.bool_]:
    """Mask of points (n, 3) that lie along the normals of places (n, 3) rather than beside them.

    The tip of a finger gives no readings. Its nearest point is on the border of the cloud and would
    shorten the finger (Turk & Levoy 1994 leave out such pairs at a mesh's border).
    """
    offset = points - places
    away = np.sqrt(np.einsum("ni,ni->n", offset, offset))
    ahead = np.abs(_along(normals, offset))
    return np.asarray(away < _ASIDE * ahead + _SPACING_M)


def bound_rows(
    model: BodyModel,
    target: Target,
    cameras: CameraCorrections,
    skin: Skin,
    annealing: AnnealingStep,
) -> tuple[Rows, ...]:
    """Rows of the floor and, in the fine steps, of the outlines and the top of the head."""
    tolerance_m = max(_MIN_FLOOR_TOLERANCE_M, _FLOOR_TOLERANCE_SHARE * annealing.gate_m)
    floor = floor_rows(model, skin, tolerance_m)
    if annealing.coarse:
        return (floor,)
    poses = cameras.poses(target.views)
    outline = outline_rows(model, target.free_space, poses, skin, annealing.row_share)
    return floor, outline, crown_rows(model, target.views, poses, skin.positions)


def data_terms(
    model: BodyModel,
    target: Target,
    tracked: TrackedPoints,
    probed: Callable[[], tuple[NDArray[np.intp], NDArray[np.intp]]],
    bounds: Future[tuple[Rows, ...]],
    cameras: CameraCorrections,
    skin: Skin,
    annealing: AnnealingStep,
    beside: ThreadPoolExecutor,
) -> DataTerms:
    """Correspondences and bounds, summed up at the samples.

    Args:
        tracked: what `Target.tracked` gives.
        probed: gives the result of `probed_places`.
        bounds: result of `bound_rows`.
        beside: sums up what involves the cameras.
    """
    cloud = target.tree
    if annealing.coarse:
        subset = target.subset[::_COARSE_EVERY]
        paired, mine = OrientedTree.build(skin.positions, skin.normals).pairs(
            cloud.points[subset], cloud.normals[subset], **annealing.limits
        )
    else:
        subset = target.subset
        paired, mine = tracked.pairs(skin.positions, skin.normals, **annealing.limits)
        border = int(np.searchsorted(paired, len(subset)))
        rimmed, at_rims = paired[border:] - len(subset), mine[border:]
        paired, mine = paired[:border], mine[:border]
    probes, found = probed()
    place = np.concatenate([mine, probes])
    point = np.concatenate([subset[paired], found])
    camera = target.camera[point]
    on_cloud = cameras.apply(cloud.points[point], camera)
    if annealing.coarse:
        on_body, direction = skin.positions[place], skin.normals[place]
    else:
        # A vertex pulled along its own normal towards the points around it sinks into a curved
        # skin: by a millimetre and more, on all sides.
        places = attached(model, skin.positions, on_cloud, place)
        on_body, direction = places.of(skin.positions, model.faces), cloud.normals[point]
    residual, sigma_m = _along(direction, on_cloud - on_body), target.sigma_m[point]
    share = share_of_points(residual, sigma_m, annealing)
    rows = [_point_rows(place, direction, residual, sigma_m, annealing.scale_m, share)]
    camera_terms = None
    if not annealing.coarse:
        if len(cameras):
            camera_terms = beside.submit(
                CameraTerms.build, rows[0], on_cloud, camera, cameras, skin, annealing.samples
            )
        rows.append(_rim_rows(target.rims, rimmed, cameras, skin, at_rims, annealing))
    weight, residual = Rows.joined(*rows, *bounds.result()).at_samples(skin, annealing.samples)
    return DataTerms(weight, residual, camera_terms, on_body, on_cloud)


def _rim_rows(
    rims: PointCloud,
    rimmed: NDArray[np.intp],
    cameras: CameraCorrections,
    skin: Skin,
    place: NDArray[np.intp],
    annealing: AnnealingStep,
) -> Rows:
    """Rows that place the outlines of hands where cameras saw them end before the background."""
    offset = cameras.apply(rims.points[rimmed], rims.camera[rimmed]) - skin.positions[place]
    direction, sigma_m = rims.normals[rimmed], rims.sigma_m[rimmed]
    residual = _along(direction, offset)
    return _point_rows(place, direction, residual, sigma_m, annealing.scale_m, annealing.row_share)


def _along(direction: Array, offset: Array) -> Array:
    """Offsets (n, 3) along unit directions (n, 3)."""
    return np.asarray(np.einsum("ni,ni->n", direction, offset))


def share_of_points(residual_m: Array, sigma_m: Array, annealing: AnnealingStep) -> float:
    """Share with which the rows of points count, by their distances (n,) from the body."""
    if annealing.usual_spread_m == np.inf or not len(residual_m):
        return annealing.row_share
    noise_m = _NOISE_LEFT * float(np.sqrt(np.mean(sigma_m**2)))
    usual_m = float(np.hypot(annealing.usual_spread_m, noise_m))
    return annealing.row_share * usual_m / max(spread_of(residual_m), usual_m)


def _point_rows(
    place: NDArray[np.intp],
    direction: Array,
    residual_m: Array,
    sigma_m: Array,
    scale_m: float,
    share: float,
) -> Rows:
    """Robustly weighted rows (Geman & McClure) for distances (n,) along directions (n, 3)."""
    robust = 1.0 / (1.0 + (residual_m / scale_m) ** 2) ** 2
    variance = sigma_m**2 + _MODEL_SIGMA_M**2
    return Rows(place, direction, residual_m, share * robust / variance)
