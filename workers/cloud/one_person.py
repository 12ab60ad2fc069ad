"""The one person in a booth: all pieces of one body, and whether somebody is beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.core.bundle import LEAST_READINGS, NOBODY
from station.core.errors import InputError
from workers.cloud.observed import TWO_PEOPLE, Finding
from workers.cloud.people import count_people

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_VOXEL_M = 0.04
"""Cell size for connected components."""
_MIN_READINGS_PER_CELL = 3
_SECOND_PERSON_SHARE = 0.15
_SECOND_PERSON_HEIGHT_M = 1.1
"""Another component with this share of the largest one's points and this height is a second person;
a chair that stands apart is lower and is ignored."""
_LEGS_BELOW_M, _HEAD_ABOVE_M = 0.4, 1.3
"""A body that begins higher than the one, or ends lower than the other, above the lowest of all
points, lacks its legs or its head."""
_SAME_BODY_SHARE, _SAME_BODY_GAP_M = 0.3, 0.35
"""A component with this share of its footprint above or below such a body, at most so far from it,
is of the same body: briefs that give no reading cut one in two or three."""
_LEAST_PIECE_SHARE = 0.005
"""Components with a smaller share of the largest one's points are stray readings."""
_PEOPLE_STRIDE = 4
"""Every so many points are used to count people."""


def one_person(points: Sequence[Array]) -> tuple[list[Mask], list[Finding]]:
    """Masks of each camera's points (n, 3) that are of the largest body, and whether others are
    people.

    Raises:
        InputError: there is nobody in the booth.
    """
    everything = np.concatenate(points)
    if len(everything) < LEAST_READINGS:
        raise InputError(NOBODY)
    cell, shape = cells_of(everything, _VOXEL_M)
    occupied = np.bincount(cell, minlength=np.prod(shape)).reshape(shape)
    labels, count = ndimage.label(ndimage.binary_dilation(occupied >= _MIN_READINGS_PER_CELL))
    of_point = labels.ravel()[cell]
    sizes = np.bincount(of_point, minlength=count + 1)
    sizes[0] = 0
    main = int(np.argmax(sizes))
    same_body = _pieces_of_body(labels, sizes, main)
    keep = same_body[of_point]
    beside = any(
        sizes[label] > _SECOND_PERSON_SHARE * sizes[main]
        and np.ptp(everything[of_point == label, 2]) > _SECOND_PERSON_HEIGHT_M
        for label in np.flatnonzero(~same_body)
    )
    findings = []
    if beside or count_people(everything[np.flatnonzero(keep)[::_PEOPLE_STRIDE]]) > 1:
        message = "two people (or a large object) in the booth; only one person may be there"
        findings.append(Finding(TWO_PEOPLE, None, None, message))
    ends = np.cumsum([len(part) for part in points])
    return np.split(keep, ends[:-1]), findings


@numba.njit(cache=True, nogil=True)
def cells_of(points, size_m):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Index (n,) of each point's cell in a grid, and the grid's shape; its border is empty."""
    low, high = points[0].copy(), points[0].copy()
    for p in range(len(points)):
        for i in range(3):
            low[i], high[i] = min(low[i], points[p, i]), max(high[i], points[p, i])
    low -= 2.0 * size_m
    x, y, z = ((high - low) / size_m).astype(np.int64) + 3
    cell = np.empty(len(points), np.int64)
    for p in range(len(points)):
        cell[p] = 0
        for i, cells in enumerate((x, y, z)):
            cell[p] = cell[p] * cells + int((points[p, i] - low[i]) / size_m)
    return cell, (x, y, z)


def _pieces_of_body(labels: NDArray[np.int32], sizes: NDArray[np.int64], main: int) -> Mask:
    """Mask (count + 1,) of the components that are of one body with the largest.

    Only a body that does not reach from the floor to a head lacks something: whoever is whole may
    have a stool below the arm and a lamp above the head.
    """
    same_body = np.zeros(len(sizes), bool)
    same_body[main] = True
    body = labels == main
    heights = np.flatnonzero(body.any(axis=(0, 1))) * _VOXEL_M
    no_legs, no_head = heights[0] > _LEGS_BELOW_M, heights[-1] < _HEAD_ABOVE_M
    if not (no_legs or no_head):
        return same_body
    for label in np.argsort(-sizes, kind="stable")[1:]:
        if sizes[label] < _LEAST_PIECE_SHARE * sizes[main]:
            break
        piece = labels == label
        footprint = piece.any(axis=2)
        shared = footprint & body.any(axis=2)
        if shared.sum() <= _SAME_BODY_SHARE * footprint.sum():
            continue
        its, rest = (np.flatnonzero(one[shared].any(axis=0)) for one in (piece, body))
        below_m, above_m = _VOXEL_M * (rest[0] - its[-1]), _VOXEL_M * (its[0] - rest[-1])
        if (no_legs and 0.0 < below_m < _SAME_BODY_GAP_M) or (
            no_head and 0.0 < above_m < _SAME_BODY_GAP_M
        ):
            same_body[label] = True
            body |= piece
    return same_body
