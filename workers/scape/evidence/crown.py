"""How high the head reaches: its highest centimetres are seen at a slant and give no reading, but
where they end the booth is seen behind them.

In a column of an image the head's last reading, a gap and the booth's first reading follow each
other; the head ends half a pixel before the latter. Of a tall person's head, with no booth behind,
the last reading alone says how high it reaches at the least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from station.core.depth_image import Image
from station.core.geometry import invert, transform
from station.core.lens import project
from workers.cloud.observed import CameraView
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_CROWN_M = 0.05
"""The head ends within so much of its highest point, unless a camera looks down on it."""
_CAP_M = 0.07
"""What is drawn: deep enough that its lower rim is not taken for an outline."""
_LEVEL = np.tan(np.radians(10.0))
"""Slope of an outline along the rows: the projector stands beside the camera, its shadow falls
along them. On a skull's radius of 15 cm it hides less than 0.7 px of what lies beyond such an
outline, however wide it is."""
_SLOPE_PX = 3
_REACH_PX = 16
_WIDEST_PX = 12
"""A wider gap is no slant but hair that gives no reading, and a stature is measured without."""
_BEHIND_M = 0.08
_NEARER_M = 0.12
"""The last reading of a flat skull is so much nearer than its outline."""
_BEYOND_M = 0.0045
"""So much of a head lies beyond its last reading: a Kinect reads up to 70 or 75 degrees of
incidence, beyond which a radius of 8 to 12 cm leaves 3 to 7 mm."""
_FARTHEST_M = 0.012
"""No shape leaves a head off by so much: what is seen to end there is a bun, a hat, a hand."""
_LEAST_COLUMNS = 6
_SIGMA_M = 0.0015
"""Of one camera's word, however many columns it has: half a pixel, or 0.05 degrees of its pose."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Where n columns of images see the head end."""

    vertex: Index
    """(n,): at the body's outline."""
    direction: Array
    """(n, 3): unit, out of the outline."""
    distance_m: Array
    """(n,): from the outline to where the head ends, negative inwards."""
    information: Array
    """(n,): one over the variance."""


_UNSEEN = Reach(np.empty(0, np.intp), np.empty((0, 3)), np.empty(0), np.empty(0))


@dataclass(frozen=True, slots=True)
class _Cap:
    """The head's highest part."""

    vertex: Index
    """(k,): of the body."""
    points: Array
    """(k, 3)."""
    edges: Index
    """(e, 2): between them."""


def reach(
    model: BodyModel, views: Sequence[CameraView], poses: Sequence[Array], vertices: Array
) -> Reach:
    """How far from the outline of a body (P, 3) cameras at poses (4, 4) see its head end."""
    cap = _cap(model, vertices)
    found = [_UNSEEN, *(_seen(view, pose, cap) for view, pose in zip(views, poses, strict=True))]
    return Reach(
        np.concatenate([one.vertex for one in found]),
        np.concatenate([one.direction for one in found]),
        np.concatenate([one.distance_m for one in found]),
        np.concatenate([one.information for one in found]),
    )


def _cap(model: BodyModel, vertices: Array) -> _Cap:
    head, edges = _head(model)
    height = vertices[head, 2]
    high = height > height.max() - _CAP_M
    number = np.cumsum(high) - 1
    return _Cap(
        head[high], vertices[head[high]], number[edges[high[edges[:, 0]] & high[edges[:, 1]]]]
    )


@lru_cache(maxsize=2)
def _head(model: BodyModel) -> tuple[Index, Index]:
    """The head's vertices, and the edges (e, 2) between them."""
    head = np.flatnonzero(model.part_of_vertex == model.part_names.index("head"))
    ends = sp.triu(model.adjacency[head][:, head]).nonzero()
    return head, np.stack(ends, axis=1).astype(np.intp)


def _seen(view: CameraView, pose: Array, cap: _Cap) -> Reach:
    """What one camera says."""
    K, (height, width) = view.calibration.K, view.depth_m.shape
    local = transform(invert(pose), cap.points)
    places = np.nan_to_num(project(view.calibration, local), nan=-1.0)
    inside = (places[:, 1] > _REACH_PX) & (places[:, 1] < height - _REACH_PX - 1)
    # An outline that leaves the image says nothing, nor does a head that is not in it.
    if not inside.all():
        return _UNSEEN
    out = 1 if pose[2, 1] > 0.0 else -1
    column, row, place = _outline(places * (1, out), cap.edges, width)
    row *= out
    rows = np.rint(row).astype(np.intp)
    booth, last = _ends(view.depth_m, column, rows, out, local[place, 2])
    pixel_m = local[place, 2] / K[1, 1]
    slope = (row - K[1, 2]) / K[1, 1]
    length = np.hypot(1.0, slope)
    # Out of the plane of the ray and the row.
    direction = out * (pose[:3, 1] - slope[:, None] * pose[:3, 2]) / length[:, None]
    high = cap.points[place, 2] > cap.points[:, 2].max() - _CROWN_M
    used = high & (booth >= 0)
    distance = (out * (booth - row) - 0.5) * pixel_m / length
    if np.count_nonzero(used) < _LEAST_COLUMNS:
        used = high & (last >= 0)
        distance = out * (last - row) * pixel_m / length + _BEYOND_M
        # Dark hair ends readings as well: they do not say that a head is lower.
        if not used.any() or np.median(distance[used]) < 0.0:
            return _UNSEEN
    count = int(used.sum())
    if count < _LEAST_COLUMNS or abs(np.median(distance[used])) > _FARTHEST_M:
        return _UNSEEN
    information = np.full(count, 1.0 / (count * _SIGMA_M**2))
    return Reach(cap.vertex[place[used]], direction[used], distance[used], information)


def _outline(places: Array, edges: Index, width: int) -> tuple[Index, Array, Index]:
    """Columns in which a drawing ends level; how far along v; the nearer end of the line there.

    Args:
        places: (k, 2) pixels.
        edges: (e, 2): lines between them.
        width: number of columns.
    """
    start, stop = edges.T
    swapped = places[start, 0] > places[stop, 0]
    start, stop = np.where(swapped, stop, start), np.where(swapped, start, stop)
    first = np.ceil(np.maximum(places[start, 0], 0.0)).astype(np.intp)
    last = np.floor(np.minimum(places[stop, 0], width - 1.0)).astype(np.intp)
    count = np.maximum(last - first + 1, 0)
    line = np.repeat(np.arange(len(edges)), count)
    column = np.arange(len(line)) + np.repeat(first - np.cumsum(count) + count, count)
    a, b = places[start[line]], places[stop[line]]
    share = (column - a[:, 0]) / np.maximum(b[:, 0] - a[:, 0], 1e-9)
    height = a[:, 1] + share * (b[:, 1] - a[:, 1])
    row = np.full(width + 2 * _SLOPE_PX, np.nan)
    inner = row[_SLOPE_PX:-_SLOPE_PX]
    np.fmax.at(inner, column, height)
    topmost = height == inner[column]
    end = np.zeros(width, np.intp)
    end[column[topmost]] = np.where(share < 0.5, start[line], stop[line])[topmost]
    slope = (row[2 * _SLOPE_PX :] - row[: -2 * _SLOPE_PX]) / (2 * _SLOPE_PX)
    level = np.flatnonzero(np.abs(slope) < _LEVEL)
    return level, inner[level], end[level]


def _ends(
    depth_m: Image, column: Index, row: Index, out: int, near_m: Array
) -> tuple[Index, Index]:
    """(n,) each: the row of the booth's first reading beyond the head's last one, -1 where the gap
    between them is wide or holds something else; the row of the last one where no booth is."""
    # From inside to outside.
    rows = row[:, None] + out * np.arange(-_REACH_PX, _REACH_PX + 1)
    reading = depth_m[rows, column[:, None]]
    farther = reading - near_m[:, None]
    each = np.arange(len(rows))
    behind = farther > _BEHIND_M
    outer = np.argmax(behind, axis=1)
    read = np.where(reading > 0.0, np.arange(rows.shape[1]), -1)
    # Where no booth is, outer is 0, and the last column holds the last reading of all.
    inner = np.maximum.accumulate(read, axis=1)[each, outer - 1]
    head = (inner >= 0) & (farther[each, inner] > -_NEARER_M)
    narrow = (outer > 0) & (outer - inner <= _WIDEST_PX)
    return (
        np.where(head & narrow, rows[each, outer], -1),
        np.where(head & ~behind.any(axis=1), rows[each, inner], -1),
    )
