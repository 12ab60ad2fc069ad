"""Balls and limbs that move through a virtual booth, rendered in closed form.

A calibration looks at tens of thousands of frames in which little moves: static objects are ray
cast once, and balls and capsules (rods with round ends) are overlaid in closed form.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.geometry import invert, transform
from station.core.lens import rays
from station.core.rig import CameraCalibration
from station.simulation.interference import BASELINE_M, Projector
from station.simulation.noise import Image, TrueView, Window

Array = NDArray[np.float64]

_SHADOW_TOLERANCE_M = 1e-4
_SMALLEST = 1e-12
_FEWEST = 2
"""Rows and columns that show a slope."""
_MARGIN_PX = 14
"""Margin around moving objects that is redrawn, since their edges flicker."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within a radius of a segment, world frame; a ball where both ends are one."""

    start_m: Array
    end_m: Array
    radius_m: float
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    stretch: float = 0.0
    """A ball that is longer along ``axis`` by this share."""


def ball(
    center_m: Array, radius_m: float, axis: Array | None = None, stretch: float = 0.0
) -> Capsule:
    """A ball, or one that is longer along an axis."""
    x, y, z = (0.0, 0.0, 1.0) if axis is None else (float(value) for value in axis)
    return Capsule(center_m, center_m, radius_m, (x, y, z), stretch)


def overlay(
    still: TrueView,
    camera: CameraCalibration,
    capsules: list[Capsule],
    others: Collection[Projector] = (),
) -> tuple[TrueView, Window] | None:
    """The part of a view that capsules change, drawn with them; None where they are out of sight.

    ``still`` is the whole view without them. Their shadows in the projector's light fall on what
    stands still and on one another; in the light of ``others`` they cast none.
    """
    if not capsules:
        return None
    camera_from_world = invert(camera.world_from_camera)
    shapes = np.array(
        [
            (
                *transform(camera_from_world, capsule.start_m),
                *transform(camera_from_world, capsule.end_m),
                capsule.radius_m,
                *(camera_from_world[:3, :3] @ capsule.axis),
                1.0 / (1.0 + capsule.stretch) - 1.0,
            )
            for capsule in capsules
        ]
    )
    bounds = _bounds(shapes, camera)
    inside = (bounds[:, 2:] - bounds[:, :2]).min(axis=1) > 0
    if not inside.any():
        return None
    shapes, bounds = shapes[inside], bounds[inside]
    (left, top), (right, bottom) = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    part = np.s_[top:bottom, left:right]
    view = TrueView(
        still.depth_m[part].copy(),
        still.incidence_rad[part].copy(),
        still.lit[part].copy(),
        still.reflects[part].copy(),
    )
    ray = rays(camera)[part].astype(np.float64)
    _draw(
        shapes, bounds - (left, top, left, top), ray,
        BASELINE_M, view.depth_m, view.incidence_rad, view.lit, view.reflects,
    )  # fmt: skip
    if others and still.foreign is not None:
        foreign = _foreign(view.depth_m, ray, camera, others)
        view = replace(
            view,
            foreign=np.where(view.depth_m == still.depth_m[part], still.foreign[part], foreign),
        )
    return view, Window(int(top), int(left), *still.depth_m.shape)


def _foreign(
    depth_m: Image, ray: Array, camera: CameraCalibration, others: Collection[Projector]
) -> Image:
    """Light (h, w) of other projectors, in shares of the own one's."""
    if min(depth_m.shape) < _FEWEST:
        return np.zeros_like(depth_m)
    places = ray * depth_m[..., None]
    normals = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    normals *= -np.sign(np.einsum("hwi,hwi->hw", normals, ray))[..., None]
    normals /= np.maximum(np.linalg.norm(normals, axis=-1), _SMALLEST)[..., None]
    pose = camera.world_from_camera
    flat = transform(pose, places.reshape(-1, 3)), normals.reshape(-1, 3) @ pose[:3, :3].T
    total = np.sum([other.brightness(*flat) for other in others], axis=0)
    return Projector(camera, pose).in_shares(total, *flat).reshape(depth_m.shape)


def _bounds(shapes: Array, camera: CameraCalibration) -> NDArray[np.int64]:
    """(n, 4) left, top, right, bottom of each capsule and its shadow; empty where out of sight."""
    K = camera.K
    sides = []
    for end in (shapes[:, :3], shapes[:, 3:6]):
        depth = np.maximum(end[:, 2], 0.3)
        u, v = K[0, 0] * end[:, 0] / depth + K[0, 2], K[1, 1] * end[:, 1] / depth + K[1, 2]
        near = np.maximum(depth - shapes[:, 6], 0.2)
        reach = 1.1 * K[0, 0] * shapes[:, 6] / near + _MARGIN_PX
        # The projector stands to the camera's right: shadows fall to the left of what casts them.
        shadow = K[0, 0] * BASELINE_M / near
        sides.append(np.stack([u - reach - shadow, v - reach, u + reach, v + reach], axis=1))
    low = np.minimum(sides[0], sides[1])[:, :2]
    high = np.maximum(sides[0], sides[1])[:, 2:]
    size = (camera.width, camera.height)
    found = np.concatenate([np.clip(low, 0, size), np.clip(high + 1, 0, size)], axis=1)
    found[np.maximum(shapes[:, 2], shapes[:, 5]) < 0.3] = 0
    return found.astype(np.int64)


@numba.njit(cache=True, nogil=True)
def _hit(shape, ox, oy, oz, dx, dy, dz):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Least positive ray parameter at which a capsule is met (inf: never), and the normal."""
    ax, ay, az = shape[0], shape[1], shape[2]
    bx, by, bz = shape[3] - ax, shape[4] - ay, shape[5] - az
    radius = shape[6]
    best, nx, ny, nz = np.inf, 0.0, 0.0, 0.0
    dd = dx * dx + dy * dy + dz * dz
    bb = bx * bx + by * by + bz * bz
    mx, my, mz = ox - ax, oy - ay, oz - az
    # A stretched ball is a ball once space is shrunk along its axis; the ray parameter stays.
    shrink = shape[10]
    if shrink != 0.0:
        along_m = shrink * (mx * shape[7] + my * shape[8] + mz * shape[9])
        along_d = shrink * (dx * shape[7] + dy * shape[8] + dz * shape[9])
        mx, my, mz = mx + along_m * shape[7], my + along_m * shape[8], mz + along_m * shape[9]
        dx, dy, dz = dx + along_d * shape[7], dy + along_d * shape[8], dz + along_d * shape[9]
        dd = dx * dx + dy * dy + dz * dz
    if bb > 1e-12:
        bd = bx * dx + by * dy + bz * dz
        bm = bx * mx + by * my + bz * mz
        a = dd - bd * bd / bb
        if a > 1e-12:
            b = mx * dx + my * dy + mz * dz - bm * bd / bb
            c = mx * mx + my * my + mz * mz - bm * bm / bb - radius * radius
            root = b * b - a * c
            if root > 0.0:
                t = (-b - np.sqrt(root)) / a
                along = (bm + t * bd) / bb
                if t > 1e-9 and 0.0 <= along <= 1.0:
                    best = t
                    nx = (mx + t * dx - along * bx) / radius
                    ny = (my + t * dy - along * by) / radius
                    nz = (mz + t * dz - along * bz) / radius
    for end in range(2):
        ex, ey, ez = mx - end * bx, my - end * by, mz - end * bz
        b = ex * dx + ey * dy + ez * dz
        c = ex * ex + ey * ey + ez * ez - radius * radius
        root = b * b - dd * c
        if root > 0.0:
            t = (-b - np.sqrt(root)) / dd
            if 1e-9 < t < best:
                best = t
                nx, ny, nz = (ex + t * dx) / radius, (ey + t * dy) / radius, (ez + t * dz) / radius
        if bb <= 1e-12:
            break
    return best, nx, ny, nz


@numba.njit(cache=True, nogil=True)
def _draw(shapes, bounds, ray, baseline, depth, incidence, lit, reflects):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(shapes)):
        for v in range(bounds[i, 1], bounds[i, 3]):
            for u in range(bounds[i, 0], bounds[i, 2]):
                x, y = ray[v, u, 0], ray[v, u, 1]
                t, nx, ny, nz = _hit(shapes[i], 0.0, 0.0, 0.0, x, y, 1.0)
                if t < np.inf and (depth[v, u] == 0.0 or t < depth[v, u]):
                    cosine = abs(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1.0)
                    depth[v, u] = t
                    incidence[v, u] = np.arccos(min(cosine, 1.0))
                    lit[v, u] = True
                    reflects[v, u] = True
    for i in range(len(shapes)):
        for v in range(bounds[i, 1], bounds[i, 3]):
            for u in range(bounds[i, 0], bounds[i, 2]):
                z = depth[v, u]
                if not lit[v, u] or z == 0.0:
                    continue
                tx, ty, tz = ray[v, u, 0] * z - baseline, ray[v, u, 1] * z, z
                reach = 1.0 - _SHADOW_TOLERANCE_M / np.sqrt(tx * tx + ty * ty + tz * tz)
                if _hit(shapes[i], baseline, 0.0, 0.0, tx, ty, tz)[0] < reach:
                    lit[v, u] = False
