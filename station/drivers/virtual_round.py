"""Balls and limbs that move through a virtual booth, seen exactly and fast.

A calibration looks at tens of thousands of frames in which little moves: what stands still is ray
cast once, and balls and capsules (rods with round ends) are laid over it in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from station.calibration.rig import CameraCalibration
from station.drivers.virtual_noise import BASELINE_M, TrueView, Window
from station.geometry import invert, transform

Array = NDArray[np.float64]

_SHADOW_TOLERANCE_M = 1e-4
_MARGIN_PX = 14
"""What moves flickers at its edges and casts noise of its own: a little more is drawn anew."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within a radius of a segment, world frame; a ball where both ends are one."""

    start_m: Array
    end_m: Array
    radius_m: float


def ball(center_m: Array, radius_m: float) -> Capsule:
    """A ball."""
    return Capsule(center_m, center_m, radius_m)


def overlay(
    still: TrueView, camera: CameraCalibration, capsules: list[Capsule]
) -> tuple[TrueView, Window] | None:
    """The part of a view that capsules change, drawn with them; None where they are out of sight.

    ``still`` is the whole view without them. Their shadows in the projector's light fall on what
    stands still and on one another.
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
            )
            for capsule in capsules
        ]
    )
    K = camera.K
    window = _window(shapes, camera)
    if window is None:
        return None
    top, bottom, left, right = window
    part = np.s_[top:bottom, left:right]
    view = TrueView(
        still.depth_m[part].copy(),
        still.incidence_rad[part].copy(),
        still.lit[part].copy(),
        still.reflects[part].copy(),
    )
    _draw(
        shapes, K[0, 0], K[1, 1], K[0, 2] - left, K[1, 2] - top, BASELINE_M,
        view.depth_m, view.incidence_rad, view.lit, view.reflects,
    )  # fmt: skip
    return view, Window(top, left, *still.depth_m.shape)


def _window(shapes: Array, camera: CameraCalibration) -> tuple[int, int, int, int] | None:
    K = camera.K
    ends = np.concatenate([shapes[:, :3], shapes[:, 3:6]])
    radii = np.tile(shapes[:, 6], 2)
    near = np.maximum(ends[:, 2] - radii, 0.2)
    u = K[0, 0] * ends[:, 0] / np.maximum(ends[:, 2], 0.2) + K[0, 2]
    v = K[1, 1] * ends[:, 1] / np.maximum(ends[:, 2], 0.2) + K[1, 2]
    reach = 1.1 * K[0, 0] * radii / near + _MARGIN_PX
    # The projector stands to the camera's right, so shadows fall to the left of what casts them.
    shadow = K[0, 0] * BASELINE_M / near
    seen = ends[:, 2] > 0.3
    if not seen.any():
        return None
    left = max(int((u - reach - shadow)[seen].min()), 0)
    right = min(int((u + reach)[seen].max()) + 1, camera.width)
    top = max(int((v - reach)[seen].min()), 0)
    bottom = min(int((v + reach)[seen].max()) + 1, camera.height)
    if right - left < 4 or bottom - top < 4:
        return None
    return top, bottom, left, right


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
def _draw(shapes, fx, fy, cx, cy, baseline, depth, incidence, lit, reflects):  # type: ignore[no-untyped-def]  # pragma: no cover
    height, width = depth.shape
    for v in range(height):
        y = (v - cy) / fy
        for u in range(width):
            x = (u - cx) / fx
            nearest = depth[v, u] if depth[v, u] > 0.0 else np.inf
            drawn = False
            for i in range(len(shapes)):
                t, nx, ny, nz = _hit(shapes[i], 0.0, 0.0, 0.0, x, y, 1.0)
                if t < nearest:
                    nearest = t
                    drawn = True
                    cosine = abs(nx * x + ny * y + nz) / np.sqrt(x * x + y * y + 1.0)
                    incidence[v, u] = np.arccos(min(cosine, 1.0))
            if drawn:
                depth[v, u] = nearest
                lit[v, u] = True
                reflects[v, u] = True
            if not lit[v, u] or not np.isfinite(nearest):
                continue
            px, py, pz = x * nearest, y * nearest, nearest
            tx, ty, tz = px - baseline, py, pz
            reach = 1.0 - _SHADOW_TOLERANCE_M / np.sqrt(tx * tx + ty * ty + tz * tz)
            for i in range(len(shapes)):
                t, _, _, _ = _hit(shapes[i], baseline, 0.0, 0.0, tx, ty, tz)
                if t < reach:
                    lit[v, u] = False
                    break
