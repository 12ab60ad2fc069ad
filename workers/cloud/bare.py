"""Strays, scatter, somebody else: all that a bare cloud holds beside a person's skin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.cloud.observed import TWO_PEOPLE, Finding, PointCloud
from workers.cloud.people import count_people

Array = NDArray[np.float64]

_NEIGHBOUR, _FAR_RATIO, _FAR_M = 6, 5.0, 0.02
"""A stray point's neighbour of this rank is so many times as far as those of half the points, and
so far, ..."""
_PATCH = 24
"""Neighbours that a patch of skin is fitted to."""
_PATCHES = 4000
"""Patches that the scatter is found from."""
_SMOOTH_SHARE = 0.25
"""Share of them that lies where the skin is smooth, so that their scatter is the points' own."""
_LOWEST = 2000
"""Lowest points among which strays are looked for."""
_OFF_RATIO, _OFF_M, _BESIDE_RATIO = 4.0, 0.004, 3.0
"""... or it is so many times as far from a patch as the patch's own points, and so far, or so many
times their distance beside it."""
_MOST_SCATTER_M = 0.002
"""Scatter from which a cloud is too rough, or has too few points, to be measured: rows are up to
20 mm off with 2.2, of 5000 points, or of 60,000 with 2.5 mm of noise."""
_FLOOR_PER_SCATTER = 1.5
"""Standard deviation of where lowest points put the floor: noise puts it 1 to 3 mm too low with a
scatter of 1.8, and few points 1 to 3 mm too high with 0.7."""
_TERMS = 6
"""Coefficients of a patch."""


def lowest_m(tree: cKDTree) -> float:
    """Height of the lowest of a cloud's points, those of a tree, that lie on skin."""
    points = tree.data
    low = np.argsort(points[:, 2], kind="stable")[:_LOWEST]
    away_m, around = tree.query(points[low], _PATCH + 1, workers=-1)
    rms, off, beside = _patches(points[around[:, 1:]], points[low])
    near_m = away_m[:, _NEIGHBOUR]
    stray = near_m > max(_FAR_RATIO * float(np.median(near_m)), _FAR_M)
    stray |= (off > np.maximum(_OFF_RATIO * rms, _OFF_M)) | (beside > _BESIDE_RATIO)
    return float(points[low[0 if stray.all() else int(np.argmin(stray))], 2])


def scatter_m(tree: cKDTree) -> float:
    """Standard deviation of a cloud's points, those of a tree, about the skin."""
    points = tree.data
    chosen = points[:: max(1, len(points) // _PATCHES)]
    around = tree.query(chosen, _PATCH, workers=-1)[1]
    return float(np.quantile(_patches(points[around], chosen)[0], _SMOOTH_SHARE))


def floor_sigma_m(cloud: PointCloud) -> float:
    """Standard deviation of heights above a cloud's lowest points."""
    return _FLOOR_PER_SCATTER * cloud.scatter_m


def roughness(cloud: PointCloud) -> tuple[Finding, ...]:
    """The finding that a cloud's points lie too far from the skin, where they do."""
    if cloud.scatter_m < _MOST_SCATTER_M:
        return ()
    message = (
        f"the points scatter by {1e3 * cloud.scatter_m:.1f} mm about the skin, or are too few: "
        "smooth the cloud, or take more points"
    )
    return (Finding("rough", None, cloud.scatter_m, message),)


def several_people(cloud: PointCloud) -> tuple[Finding, ...]:
    """The finding that a cloud holds more than one person, where it does."""
    if count_people(cloud.points) < 2:
        return ()
    message = "two people (or a large object) in the cloud: cut one person out"
    return (Finding(TWO_PEOPLE, None, None, message),)


def _patches(around: Array, places: Array) -> tuple[Array, Array, Array]:
    """Rms distances of neighbours (n, k, 3) from the quadrics through them, the places' (n, 3)
    distances from these, and how far beside the neighbours they lie, in units of their extent.
    """
    middle = around.mean(axis=1, keepdims=True)
    axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around - middle, around - middle))[1]
    above, x, y = np.moveaxis((around - middle) @ axes, 2, 0)
    extent = np.sqrt(np.mean(x * x + y * y, axis=1, keepdims=True))
    basis = _terms(x / extent, y / extent)
    coefficients = np.linalg.pinv(basis) @ above[..., None]
    rest = above - (basis @ coefficients)[..., 0]
    rms = np.sqrt(np.sum(rest**2, axis=1) / (around.shape[1] - _TERMS))
    height, u, v = np.moveaxis((places[:, None] - middle) @ axes, 2, 0)
    u, v = u / extent, v / extent
    off = height - (_terms(u, v) @ coefficients)[..., 0]
    return rms, np.abs(off[:, 0]), np.hypot(u, v)[:, 0]


def _terms(x: Array, y: Array) -> Array:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
