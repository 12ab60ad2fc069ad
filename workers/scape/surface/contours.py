"""Rows that place the surface's contours where cameras saw something farther begin behind them.

Skin that turns away from a camera gives no readings, and opposite cameras lose the same strip of a
limb. But what is behind the limb begins where a camera's rays touch the skin (the contour generator
of Cipolla & Blake 1992). That edge is sharp, while the person's own readings end before it: at a
slant they fade, and silhouettes flicker.

A sensor does not draw edges where they are: it blurs, erodes or widens them, and a camera that
stands a millimetre aside shifts them all. So for each camera the left and the right edges have an
offset of their own, the mean over trunk, limbs and head of what they differ by from a surface that
follows the readings. What is used is how one place of the contour differs from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.geometry import invert, transform
from station.core.lens import project
from workers.cloud.observed import CameraView
from workers.scape.evidence.robust import spread_of
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.attachment import Attachments
from workers.scape.surface.offset_equations import OffsetRows

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_STEP_PX, _STEPS = 0.5, 33
"""Distance and number of the places at which a line across a contour is looked at."""
_ASIDE_PX = (-1.0, 0.0, 1.0)
"""Distances along a contour of the lines that are looked at ..."""
_SAME_EDGE_PX = 1.0
"""... whose edges are averaged where they are at most so far from the middle one."""
_REACH_PX = 6.0
"""Distance from a contour up to which it is looked for: 17 mm at 1.7 m."""
_GAP_STEPS = 10
"""Widest strip without readings between the person and what is behind, in steps. The projector's
shadow is wider, and hides where the person ends."""
_SAME_M, _BEHIND_M = 0.06, 0.12
"""Largest difference in depth of readings on the same limb, least to what is behind it."""
_MIN_SIDEWAYS = 0.5
"""Least share along the image's rows of the direction across an outline: the projector is beside
the camera, so that upper and lower edges are others than left and right ones."""
_SIGMA_PX = 0.6
"""Standard deviation of a place of a contour in the image ..."""
_INDEPENDENT = 0.15
"""... and the share of them that count as independent: those of one limb share 0.2 px."""
_ROBUST_PX = 2.5
"""Scale of the robust weight (Geman & McClure): larger distances are weighted down."""
_MIN_PLACES = 40
_MAX_OFFSET_PX, _MAX_SPREAD_PX = 4.0, 2.0
"""A side is used if it shows at least so many places, with a median and a spread (median absolute
deviation, for a normal distribution) of at most this: sound ones have 1 px and 0.7. The projector's
shadow leaves the edges of one side with few places."""
_NEAR_MEDIAN_PX = 1.5
"""Places farther from the median do not count for the offset."""
_TINY = 1e-9


def warm_up() -> None:
    """Compile, or load from the cache, what the first scan needs."""
    _edges_on_lines(np.zeros((1, 1), np.float32), np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1))


@dataclass(frozen=True, slots=True)
class ContourPlaces:
    """n places where the surface turns away from a camera, near a contour in its image."""

    at: Attachments
    outwards: Array
    """(n, 3): unit vectors across the contour, perpendicular to the ray."""
    beyond_px: Array
    """(n,): distance in the image by which the place lies beyond its edge."""
    pixel_m: Array
    """(n,): size of a pixel there."""
    side: Index
    """(n,): twice the index of the camera, plus 1 for a right edge."""

    @classmethod
    def joined(cls, pieces: Sequence[ContourPlaces]) -> ContourPlaces:
        """All places of several sets."""
        return cls(
            Attachments.joined(*(one.at for one in pieces)),
            np.concatenate([one.outwards for one in pieces]),
            np.concatenate([one.beyond_px for one in pieces]),
            np.concatenate([one.pixel_m for one in pieces]),
            np.concatenate([one.side for one in pieces]),
        )


def contour_places(
    model: BodyModel, views: Sequence[CameraView], poses: Sequence[Array], vertices: Array
) -> ContourPlaces:
    """Places of a surface (P, 3) near a contour in one of C views, at least one.

    Args:
        poses: corrected world_from_camera (4, 4) of each camera.
    """
    normals = vertex_normals(vertices, model.faces)
    return ContourPlaces.joined(
        [
            _places(model, view, pose, vertices, normals, camera)
            for camera, (view, pose) in enumerate(zip(views, poses, strict=True))
        ]
    )


def side_offsets_px(places: ContourPlaces, cameras: int) -> Array:
    """Offset (2 cameras,) of the edges on each side of each camera; NaN where it is not known."""
    offsets = np.full(2 * cameras, np.nan)
    for side in range(2 * cameras):
        beyond = places.beyond_px[places.side == side]
        if len(beyond) < _MIN_PLACES:
            continue
        middle = float(np.median(beyond))
        spread = spread_of(beyond - middle)
        if abs(middle) <= _MAX_OFFSET_PX and spread <= _MAX_SPREAD_PX:
            offsets[side] = beyond[np.abs(beyond - middle) < _NEAR_MEDIAN_PX].mean()
    return offsets


def contour_rows(
    model: BodyModel, places: ContourPlaces, offsets_px: Array, offset: Array
) -> OffsetRows:
    """Rows on the surface's whole offset (P, 3).

    Args:
        offsets_px: as `side_offsets_px` gives them.
        offset: (P, 3), the present offset of the surface on which the places are.
    """
    away_px = offsets_px[places.side] - places.beyond_px
    used = np.isfinite(away_px)
    at, outwards = places.at.chosen(used), places.outwards[used]
    away_px, pixel_m = away_px[used], places.pixel_m[used]
    already = np.einsum("ni,ni->n", outwards, at.of(offset, model.faces))
    robust = 1.0 / (1.0 + (away_px / _ROBUST_PX) ** 2) ** 2
    weight = _INDEPENDENT * robust / (_SIGMA_PX * pixel_m) ** 2
    return OffsetRows(at, outwards, away_px * pixel_m + already, weight)


def _places(
    model: BodyModel, view: CameraView, pose: Array, vertices: Array, normals: Array, camera: int
) -> ContourPlaces:
    """Places in one view: on edges of the mesh, where the normal is perpendicular to the ray."""
    ends, triangle, corner = _mesh_edges(model)
    facing = np.einsum("ni,ni->n", normals, vertices - pose[:3, 3])
    tail, head = facing[ends[:, 0]], facing[ends[:, 1]]
    turning = np.flatnonzero((tail < 0.0) != (head < 0.0))
    share = tail[turning] / (tail[turning] - head[turning])
    here, there = ends[turning].T
    place = vertices[here] + share[:, None] * (vertices[there] - vertices[here])
    outwards = _unit(normals[here] + share[:, None] * (normals[there] - normals[here]))
    local, calibration = transform(invert(pose), place), view.calibration
    pixel_m = local[:, 2] / calibration.K[0, 0]
    pixels = project(calibration, local)
    moved = local + pixel_m[:, None] * (outwards @ pose[:3, :3])
    across = _unit(project(calibration, moved) - pixels)
    edge_px = _edge_px(view, pixels, across, np.ascontiguousarray(local[:, 2]))
    kept = np.isfinite(edge_px) & (np.abs(across[:, 0]) > _MIN_SIDEWAYS)
    turning, share = turning[kept], share[kept]
    weights, index = np.zeros((len(turning), 3)), np.arange(len(turning))
    weights[index, corner[turning]] = 1.0 - share
    weights[index, (corner[turning] + 1) % 3] = share
    return ContourPlaces(
        Attachments(triangle[turning], weights),
        outwards[kept],
        -edge_px[kept],
        pixel_m[kept],
        2 * camera + (across[kept, 0] > 0.0).astype(np.intp),
    )


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), _TINY))


def _edge_px(view: CameraView, pixels: Array, across: Array, depth_m: Array) -> Array:
    """Distances (n,) from pixels (n, 2) along unit directions (n, 2) to the edges of a limb at
    depths (n,); NaN where one of the lines has none, as where something hides it."""
    lines = _edges_on_lines(view.depth_m, pixels, across, depth_m)
    middle = np.median(lines, axis=1)
    close = np.abs(lines - middle[:, None]) <= _SAME_EDGE_PX
    mean = np.where(close, lines, 0.0).sum(axis=1) / np.maximum(close.sum(axis=1), 1)
    return np.where(np.isfinite(middle), mean, np.nan)


@numba.njit(cache=True, nogil=True)
def _edges_on_lines(depth, pixels, across, depth_m):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The edge nearest to each pixel on each line (n, 3), as in `_edge_px`: where readings from
    behind begin, at most a gap after one on the limb."""
    height, width = depth.shape
    found = np.full((len(pixels), len(_ASIDE_PX)), np.nan)
    for p in range(len(pixels)):
        x, y = across[p]
        for line, aside in enumerate(_ASIDE_PX):
            on_limb, was_behind, nearest = -_GAP_STEPS - 1, True, _REACH_PX
            for step in range(_STEPS):
                away = _STEP_PX * (step - _STEPS // 2)
                u = np.rint(pixels[p, 0] + away * x - aside * y)
                v = np.rint(pixels[p, 1] + away * y + aside * x)
                reading = 0.0
                if 0.0 <= u < width and 0.0 <= v < height:
                    reading = depth[int(v), int(u)]
                behind = reading > depth_m[p] + _BEHIND_M
                between = away - 0.5 * _STEP_PX
                begins = behind and not was_behind and step - on_limb <= _GAP_STEPS
                if begins and abs(between) < nearest:
                    nearest, found[p, line] = abs(between), between
                if behind:
                    on_limb = -_GAP_STEPS - 1
                elif reading > 0.0 and abs(reading - depth_m[p]) < _SAME_M:
                    on_limb = step
                was_behind = behind
    return found


@lru_cache(maxsize=2)
def _mesh_edges(model: BodyModel) -> tuple[NDArray[np.int32], Index, Index]:
    """Ends (e, 2) of each edge, a triangle (e,) that has it, and the corner (e,) it starts from.

    Hands and feet are left out: their contours are those of fingers and toes.
    """
    faces = model.faces
    ends = np.concatenate([faces, np.roll(faces, -1, axis=1)]).reshape(2, -1).T
    triangle, corner = np.divmod(np.arange(faces.size), 3)
    feet = [index for index, name in enumerate(model.part_names) if name.startswith("foot")]
    outer = np.isin(model.part_of_vertex, [*model.hand_parts, *feet])
    kept = (ends[:, 0] < ends[:, 1]) & ~outer[ends].any(axis=1)
    return ends[kept], triangle[kept].astype(np.intp), corner[kept].astype(np.intp)
