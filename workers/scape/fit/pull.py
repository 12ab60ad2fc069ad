"""What pulls the body at one step: two-way correspondences, floor, outlines, crown and rims.

Rows of one sample vertex share a derivative, so they add up to a 3 x 3 weight before anything is
multiplied.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.cloud.observed import CameraView, PointCloud
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.evidence.correspondence import Followers, OrientedTree
from workers.scape.evidence.crown import reach
from workers.scape.evidence.free_space import FreeSpace
from workers.scape.evidence.rims import rims_of
from workers.scape.evidence.rows import (
    CameraTerms,
    Rows,
    Skin,
    crown_rows,
    floor_rows,
    outline_rows,
)
from workers.scape.fit.stages import Stage
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_MODEL_SIGMA_M = 0.003
"""What shape and pose cannot express; it is shared by neighbours, so rows count less."""
_PULLED_POINTS = 10_000
_COARSELY_PULLED = 4
"""While the fit is coarse, every so many of them."""
_ASIDE = 2.0
"""A point is as far away as it lies ahead of a vertex, or at most so many times as far."""
_SPACING_M = 0.002
"""Points next to each other lie so far apart."""


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
class DataTerms:
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


def probed_places(
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


def bounds(
    model: BodyModel, target: Target, cameras: CameraCorrections, skin: Skin, stage: Stage
) -> tuple[Rows, ...]:
    """What floor, outlines and crown say."""
    floor = floor_rows(model, skin, max(0.012, 0.5 * stage.gate_m))
    if stage.coarse:
        return (floor,)
    poses = cameras.poses(target.views)
    outline = outline_rows(model, target.free_space, poses, skin, stage.row_share)
    return floor, outline, crown_rows(reach(model, target.views, poses, skin.positions))


def data_terms(
    target: Target,
    followers: Followers,
    probed: Future[tuple[NDArray[np.intp], NDArray[np.intp]]],
    bounding: Future[tuple[Rows, ...]],
    cameras: CameraCorrections,
    skin: Skin,
    stage: Stage,
) -> DataTerms:
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
    weight, pull = Rows.joined(*rows, *bounding.result()).at_samples(skin, stage.samples)
    return DataTerms(weight, pull, camera_terms, on_body, on_cloud)


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
