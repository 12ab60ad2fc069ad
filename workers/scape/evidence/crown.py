"""Rows for the top of the head, which gives no depth readings: the cameras see it at a slant.

Each column of an image has the last reading of the head, a gap and the first reading of the booth
behind it. The head ends half a pixel before the first reading of the booth. Where there is no booth
behind the head, its last reading gives a lower bound of its height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from station.core.depth.images import Image
from station.core.geometry import invert, transform
from station.core.lens import project
from workers.cloud.observed import CameraView
from workers.scape.evidence.rows import Rows
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_CROWN_M = 0.05
"""Outlines count within this height below the head's highest point; a camera that looks down sees
the outline of lower places."""
_CAP_M = 0.07
"""Height of the part of the head that is drawn: enough that its lower rim is no outline."""
_LEVEL = np.tan(np.radians(10.0))
"""Largest slope of an outline against the rows. The projector stands beside the camera, so its
shadow falls along the rows: on a skull (radius 15 cm) it hides less than 0.7 px beyond an outline
of this slope."""
_SLOPE_PX = 3
"""Columns to either side over which the slope is taken."""
_REACH_PX = 16
"""Rows above and below the outline that are searched for readings."""
_WIDEST_PX = 12
"""Widest gap between the readings: a wider one is hair, which does not count to the stature."""
_BEHIND_M = 0.08
"""Least distance from the outline to the booth behind it."""
_NEARER_M = 0.12
"""Most by which the head's last reading may be nearer than the outline (flat skulls)."""
_BEYOND_M = 0.0045
"""Length of the head beyond its last reading: a Kinect reads up to 70 or 75 degrees of incidence,
which leaves 3 to 7 mm of a radius of 8 to 12 cm."""
_BEYOND_SIGMA_M = 0.003
"""Standard deviation of that length: heads without a wall behind them came out within 4 mm on
validation bodies."""
_MODEL_SIGMA_M = 0.008
"""Standard deviation of the head's top as the model has it below a head that ends in hair or
without a wall behind it: up to 14 mm were seen on real people."""
_REACHED_M = 0.003
"""Readings as near to the top as this show it."""
_HEAD_RADIUS_M = 0.08
"""Readings so near to the vertical through the top are the head's."""
_MIN_READINGS = 5
"""Fewer of them may be stray."""
_UNKNOWN_HEAD_M = 0.03
"""Standard deviation where there is no reading of the head: the length of a head varies by it."""
FACE_ALONE_M = 0.011
"""Standard deviation where dark hair hides all but the face: 9 mm rms on sculpted bodies, 4
on those of the model's own family."""
_FACE = 0.08
"""Share of the head's vertices that its face has at least."""
_FARTHEST_M = 0.012
"""Largest distance between the outline and the observed end: beyond it the cameras see a bun, a hat
or a hand."""
_MIN_COLUMNS = 6
"""Fewer columns are not used."""
_STRAY_PX = 2.5
"""Columns that differ more from the others show a gap in the booth's readings, not the head's end:
sensors whose patterns overlap lose patches of what stands behind a head."""
_SIGMA_M = 0.0015
"""Standard deviation of one camera's observation, however many columns it has: half a pixel, or
0.05 degrees of its pose."""
_MIN_WIDTH_PX = 1e-9
"""Guards the division by the width of a line that stands upright in the image."""


_NO_ROWS = Rows(np.empty(0, np.intp), np.empty((0, 3)), np.empty(0), np.empty(0))


@dataclass(frozen=True, slots=True)
class _Cap:
    """Highest part of the head."""

    vertex: Index
    """(k,): index among the body's vertices."""
    points: Array
    """(k, 3), world frame, metres."""
    edges: Index
    """(e, 2): pairs of indices into `points`."""


def crown_rows(
    model: BodyModel, views: Sequence[CameraView], poses: Sequence[Array], vertices: Array
) -> Rows:
    """Rows that place the outline of the head where the cameras saw the head end.

    Args:
        poses: world_from_camera (4, 4) of each view.
        vertices: (P, 3), the body's; the rows' places are its vertices.
    """
    cap = _cap(model, vertices)
    observed = (_rows_of(view, pose, cap) for view, pose in zip(views, poses, strict=True))
    return Rows.joined(_NO_ROWS, *(rows for rows, _ in observed))


def crown_sigma_m(
    model: BodyModel,
    views: Sequence[CameraView],
    poses: Sequence[Array],
    vertices: Array,
    points: Array,
    seen: NDArray[np.bool_],
) -> float:
    """Standard deviation of the height of a fitted head, metres.

    0 where a camera saw the booth behind the head, or readings reach its top: then the errors are
    an ordinary scan's. Otherwise the head may end anywhere from its last reading, plus what no
    camera sees at a slant, to the top that the model gives it.

    Args:
        poses, vertices: as in `crown_rows`.
        points: (n, 3), the cloud's.
        seen: (P,), vertices with points.
    """
    cap = _cap(model, vertices)
    if any(_rows_of(view, pose, cap)[1] for view, pose in zip(views, poses, strict=True)):
        return 0.0
    top = cap.points[np.argmax(cap.points[:, 2])]
    over_head = np.linalg.norm(points[:, :2] - top[:2], axis=1) < _HEAD_RADIUS_M
    heights = np.sort(points[over_head, 2])
    gap = float(top[2] - heights[-_MIN_READINGS]) if len(heights) >= _MIN_READINGS else np.inf
    if gap > _CAP_M:
        return FACE_ALONE_M if seen[_head(model)[0]].mean() > _FACE else _UNKNOWN_HEAD_M
    if gap < _REACHED_M:
        return 0.0
    return min(max(abs(gap - _BEYOND_M), _BEYOND_SIGMA_M), _MODEL_SIGMA_M)


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
    """Vertices of the head, and the edges (e, 2) between them."""
    head = np.flatnonzero(model.part_of_vertex == model.part_names.index("head"))
    ends = sp.triu(model.adjacency[head][:, head]).nonzero()
    return head, np.stack(ends, axis=1).astype(np.intp)


def _rows_of(view: CameraView, pose: Array, cap: _Cap) -> tuple[Rows, bool]:
    """Rows of one camera, and whether it saw the booth behind the head."""
    K, (height, width) = view.calibration.K, view.depth_m.shape
    local = transform(invert(pose), cap.points)
    places = np.nan_to_num(project(view.calibration, local), nan=-1.0)
    inside = (places[:, 1] > _REACH_PX) & (places[:, 1] < height - _REACH_PX - 1)
    # A head that is not wholly in the image is not used.
    if not inside.all():
        return _NO_ROWS, False
    out = 1 if pose[2, 1] > 0.0 else -1
    column, row, place = _outline(places * (1, out), cap.edges, width)
    row *= out
    rows = np.rint(row).astype(np.intp)
    booth, last = _ends(view.depth_m, column, rows, out, local[place, 2])
    pixel_m = local[place, 2] / K[1, 1]
    slope = (row - K[1, 2]) / K[1, 1]
    length = np.hypot(1.0, slope)
    # Normal of the plane through the ray and the image row.
    direction = out * (pose[:3, 1] - slope[:, None] * pose[:3, 2]) / length[:, None]
    high = cap.points[place, 2] > cap.points[:, 2].max() - _CROWN_M
    used = high & (booth >= 0)
    behind = bool(np.count_nonzero(used) >= _MIN_COLUMNS)
    distance = (out * (booth - row) - 0.5) * pixel_m / length
    if not behind:
        used = high & (last >= 0)
        distance = out * (last - row) * pixel_m / length + _BEYOND_M
        # Dark hair gives no readings either, so a lower last reading does not mean a lower head.
        if not used.any() or np.median(distance[used]) < 0.0:
            return _NO_ROWS, False
    used[used] = np.abs(distance[used] - np.median(distance[used])) < _STRAY_PX * pixel_m[used]
    count = int(used.sum())
    if count < _MIN_COLUMNS or abs(np.median(distance[used])) > _FARTHEST_M:
        return _NO_ROWS, False
    information = np.full(count, 1.0 / (count * _SIGMA_M**2))
    found = Rows(cap.vertex[place[used]], direction[used], distance[used], information)
    return found, behind


def _outline(places: Array, edges: Index, width: int) -> tuple[Index, Array, Index]:
    """Columns with a level outline; the outline's row in each; the vertex nearest to it.

    Args:
        places: (k, 2), pixels.
        edges: (e, 2), the lines between them.
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
    share = (column - a[:, 0]) / np.maximum(b[:, 0] - a[:, 0], _MIN_WIDTH_PX)
    height = a[:, 1] + share * (b[:, 1] - a[:, 1])
    row = np.full(width + 2 * _SLOPE_PX, np.nan)
    inner = row[_SLOPE_PX:-_SLOPE_PX]
    np.fmax.at(inner, column, height)
    topmost = height == inner[column]
    end = np.zeros(width, np.intp)
    end[column[topmost]] = np.where(share < 0.5, start[line], stop[line])[topmost]
    slope = (row[2 * _SLOPE_PX :] - row[: -2 * _SLOPE_PX]) / (2 * _SLOPE_PX)
    # Between a head that leans and its ear there may be columns without an outline.
    level = np.flatnonzero(np.isfinite(inner) & (np.abs(slope) < _LEVEL))
    return level, inner[level], end[level]


def _ends(
    depth_m: Image, column: Index, row: Index, out: int, near_m: Array
) -> tuple[Index, Index]:
    """Rows (n,) where the booth begins behind the head, and where the head's readings end.

    The first is -1 where the gap between the readings is wide or holds something else. The second
    is given only where there is no booth behind the head, and is -1 elsewhere.
    """
    # From inside to outside.
    rows = row[:, None] + out * np.arange(-_REACH_PX, _REACH_PX + 1)
    reading = depth_m[rows, column[:, None]]
    farther = reading - near_m[:, None]
    each = np.arange(len(rows))
    behind = farther > _BEHIND_M
    outer = np.argmax(behind, axis=1)
    read = np.where(reading > 0.0, np.arange(rows.shape[1]), -1)
    # Without a booth `outer` is 0, so that `outer - 1` is the last column: the last reading of all.
    inner = np.maximum.accumulate(read, axis=1)[each, outer - 1]
    head = (inner >= 0) & (farther[each, inner] > -_NEARER_M)
    narrow = (outer > 0) & (outer - inner <= _WIDEST_PX)
    return (
        np.where(head & narrow, rows[each, outer], -1),
        np.where(head & ~behind.any(axis=1), rows[each, inner], -1),
    )
