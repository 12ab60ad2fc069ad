"""Preprocessing of a scan bundle: average, filter, crop and merge its frames to one cloud."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.bundle import Bundle
from station.core.config import Volume
from station.core.depth.images import Image, jumps
from station.core.lens import rays
from station.core.rig import CameraCalibration
from workers.cloud.average import average, random_sigma_m
from workers.cloud.floor_level import floor_heights, lowered_floor, raised_floor
from workers.cloud.noise import noise_ratio
from workers.cloud.observed import CameraView, Finding, PointCloud, Preprocessed
from workers.cloud.one_person import cells_of, one_person
from workers.cloud.points import normals, within

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_BILATERAL_RADII = 1.5
"""Radius of the bilateral filter, in standard deviations in the image, before it is rounded up."""
_BILATERAL_RANGE_SIGMAS = 2.5
"""Range parameter, in standard deviations of one reading at the person's distance."""
_BILATERAL_SPACE_PX = 2.0
"""Standard deviation in the image, times the root of the noise ratio: where two fifths of the
noise's variance stay, rows of 12 validation bodies err by 2.8 mm with 2 px, 2.6 with 3, 2.8 with 4.
"""
_LARGEST_NOISE = 6.0
"""Noise ratio from which on the filter is not made wider; 3.2 is where all noise of ten frames
stays."""
_MIN_INCIDENCE_COSINE = np.cos(np.radians(76.0))
"""Readings at a larger angle of incidence are left out."""
_WINDOW_BORDER_PX = 8
"""Border around the person's part of the image: no filter reaches farther."""
_MOTION_M = 0.010
"""Shift between the first and the last third of the frames from which a scan is repeated."""
_MOTION_STRIDE = 4
_MIN_MOVING = 125
"""Every so many points are used for the shift, since neighbours move alike, and at least so many
are needed."""
_MOTION_OUTLIER, _MOTION_OUTLIER_M = 3.0, 1e-4
"""Depth changes beyond so many median absolute ones are left out."""
_MOTION_RIDGE = 1e-2
"""Share of the identity added to the mean of n n^T: directions that no normal shows stay 0."""
_UNSETTLED_SHARE = 0.25
"""Share of unsettled readings from which a scan is repeated."""
_MIN_FRAMES_SHARE = 0.5
"""Share of the expected frames below which a camera is reported."""
_PLENTY_OF_FRAMES = 10
"""Frames that are enough, however many others were lost."""
_SIGMA_FLOOR_M = 4e-4
"""Standard deviation that averaging more frames does not remove: quantisation, calibration."""


def warm_up() -> None:
    """Compile, or load from the cache, the functions that the first scan needs."""
    average(np.zeros((3, 2, 2), np.uint16), 1e-4)
    nothing = np.zeros((1, 1, 3), np.float32)
    # Read-only, as `rays` gives them: writable arrays are another type to the compiler.
    nothing.flags.writeable = False
    within(nothing, np.zeros((1, 1), np.float32), np.eye(4), np.zeros(3), np.zeros(3))
    normals(np.zeros((1, 1, 3), np.float32), np.zeros((1, 1), np.float32))
    cells_of(np.zeros((1, 3)), 1.0)


@dataclass(frozen=True, slots=True)
class _Camera:
    """Surface points of one camera inside the volume."""

    calibration: CameraCalibration
    depth_m: Image
    pixels: NDArray[np.int64]
    points: Array
    normals: Array
    sigma_m: Array
    excess_noise_m: float
    """As in `PointCloud`, of this camera's points."""
    change_m: Array
    unsettled: float
    """Share of the readings in the volume that disagree between frames."""
    frames: int
    """Number of frames."""
    floor_m: Array
    """Heights of some of the readings near z = 0 in the volume."""
    ordered: int
    """Number of frames without the gaps in their sequence, at most `_PLENTY_OF_FRAMES`."""


def preprocess(bundle: Bundle, volume: Volume | None = None) -> Preprocessed:
    """Average, filter, crop and merge a bundle's frames.

    Raises:
        BundleError: a frame cannot be read.
        InputError: there is nobody in the booth.
    """
    volume = volume or Volume()
    names = [name for name, frames in bundle.frames.items() if frames]
    with ThreadPoolExecutor(max_workers=2) as pool:
        cameras = list(pool.map(lambda name: _camera(bundle, name, volume), names))
        kept, findings = one_person([camera.points for camera in cameras])
        expected = max(max(camera.frames, camera.ordered) for camera in cameras)
        cleaned = pool.map(_cleaned, cameras, kept)
        noticed = pool.map(partial(_camera_findings, expected), names, cameras, kept)
        views, clouds = zip(*cleaned, strict=True)
        findings += [finding for of_camera in noticed for finding in of_camera]
    findings += lowered_floor([camera.floor_m for camera in cameras])
    findings += [
        Finding("camera-blind", name, None, f"camera {name} sent no frame; check its cable")
        for name in bundle.rig.cameras
        if name not in names
    ]
    cloud = _merged(names, clouds, [camera.excess_noise_m for camera in cameras])
    floor, raised = raised_floor(cloud)
    if raised:
        cloud, findings = _without(cloud, floor), [*findings, *raised]
    return Preprocessed(cloud, views, tuple(findings), bundle.rig.predicted)


def _camera(bundle: Bundle, name: str, volume: Volume) -> _Camera:
    calibration = bundle.rig.cameras[name]
    averaged = average(bundle.depth_stack(name), bundle.depth_scale_m)
    depth = calibration.depth_correction.apply(averaged.depth_m).astype(np.float32)
    near = _in_volume(calibration, depth, volume)
    floor_m = floor_heights(calibration, depth, volume)
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    restless = _in_volume(calibration, averaged.unsettled_m, volume)
    unsettled = float(restless.sum() / max(1, (near | restless).sum()))
    if not len(rows):
        nothing = np.empty((0, 3))
        none = np.empty(0)
        return _Camera(
            calibration, depth, np.empty(0, np.int64), nothing, nothing, none, 0.0, none,
            unsettled, len(bundle.frames[name]), floor_m, _ordered(bundle, name),
        )  # fmt: skip
    # The rest works only on the part of the image that shows the person.
    border = _WINDOW_BORDER_PX
    top, bottom = max(rows[0] - border, 0), min(rows[-1] + border + 1, depth.shape[0])
    left, right = max(columns[0] - border, 0), min(columns[-1] + border + 1, depth.shape[1])
    window = np.s_[top:bottom, left:right]
    part = np.ascontiguousarray(depth[window])
    ratio = noise_ratio(part, near[window], averaged.count[window])
    edge = jumps(part)
    typical = float(np.median(part[near[window]]))
    smooth = filtered(part, typical, ratio)
    depth[window] = np.where(smooth > 0, smooth, part)
    points = rays(calibration)[window] * smooth[..., None]
    directions, valid = normals(points, smooth)
    distance = np.sqrt(np.einsum("hwi,hwi->hw", points, points))
    cosine = -np.einsum("hwi,hwi->hw", directions, points) / np.maximum(distance, 1e-6)
    valid &= near[window] & ~edge & (cosine > _MIN_INCIDENCE_COSINE)
    at = np.flatnonzero(valid)
    y, x = np.unravel_index(at, valid.shape)
    readings = averaged.count[window].ravel()[at].astype(np.float64)
    sigma = random_sigma_m(smooth.ravel()[at].astype(np.float64))
    sigma /= np.sqrt(readings * cosine.ravel()[at])
    local = points.reshape(-1, 3)[at].astype(np.float64)
    pose = calibration.world_from_camera
    return _Camera(
        calibration=calibration,
        depth_m=depth,
        pixels=(y + top) * depth.shape[1] + (x + left),
        points=local @ pose[:3, :3].T + pose[:3, 3],
        normals=directions.reshape(-1, 3)[at].astype(np.float64) @ pose[:3, :3].T,
        sigma_m=np.hypot(sigma, _SIGMA_FLOOR_M),
        excess_noise_m=float(np.sqrt((ratio**2 - 1.0) * (sigma @ sigma) / max(1, len(sigma)))),
        change_m=averaged.change_m[window].ravel()[at].astype(np.float64),
        unsettled=unsettled,
        frames=len(bundle.frames[name]),
        floor_m=floor_m,
        ordered=_ordered(bundle, name),
    )


def filtered(depth_m: Image, typical_m: float, noise: float = 1.0) -> Image:
    """Bilateral filter (Tomasi & Manduchi 1998) of averaged readings; missing ones stay 0.

    Args:
        typical_m: distance of the person, which sets the noise.
        noise: `noise_ratio` of the image.
    """
    space_px = _BILATERAL_SPACE_PX * np.sqrt(min(noise, _LARGEST_NOISE))
    smooth = cv2.bilateralFilter(
        depth_m,
        1 + 2 * int(np.ceil(_BILATERAL_RADII * space_px)),
        _BILATERAL_RANGE_SIGMAS * float(random_sigma_m(np.array(typical_m))),
        space_px,
        # Of skin that tilts away the outermost reading is off by half as much as with a mirror.
        borderType=cv2.BORDER_REPLICATE,
    )
    smooth[depth_m == 0.0] = 0.0
    return np.asarray(smooth, np.float32)


def _ordered(bundle: Bundle, name: str) -> int:
    numbers = [record.sequence for record in bundle.frames[name]]
    return min(max(numbers) - min(numbers) + 1, _PLENTY_OF_FRAMES)


def _in_volume(calibration: CameraCalibration, depth_m: Image, volume: Volume) -> Mask:
    low = np.array(volume.min_m)
    low[2] = max(low[2], volume.floor_clearance_m)
    pose = calibration.world_from_camera
    return within(rays(calibration), depth_m, pose, low, np.array(volume.max_m))


def _cleaned(camera: _Camera, keep: Mask) -> tuple[CameraView, tuple[Array, Array, Array]]:
    person = np.zeros(camera.depth_m.shape, bool)
    person.flat[camera.pixels[keep]] = True
    # Pixels at the person's edge are neither person nor background.
    near_person = cv2.dilate(person.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    view = CameraView(
        name=camera.calibration.name,
        calibration=camera.calibration,
        depth_m=camera.depth_m,
        person=person,
        background=(camera.depth_m > 0) & ~near_person,
    )
    return view, (camera.points[keep], camera.normals[keep], camera.sigma_m[keep])


def _merged(
    names: list[str],
    clouds: Sequence[tuple[Array, Array, Array]],
    excess_noise_m: Sequence[float],
) -> PointCloud:
    sizes = np.array([len(points) for points, _, _ in clouds])
    excess2 = sizes @ np.square(excess_noise_m) / max(1, sizes.sum())
    return PointCloud(
        points=np.concatenate([points for points, _, _ in clouds]),
        normals=np.concatenate([directions for _, directions, _ in clouds]),
        sigma_m=np.concatenate([sigma for _, _, sigma in clouds]),
        camera=np.repeat(np.arange(len(names), dtype=np.int16), sizes),
        camera_names=tuple(names),
        excess_noise_m=float(np.sqrt(excess2)),
    )


def _without(cloud: PointCloud, left_out: Mask) -> PointCloud:
    kept = ~left_out
    return replace(
        cloud,
        points=cloud.points[kept],
        normals=cloud.normals[kept],
        sigma_m=cloud.sigma_m[kept],
        camera=cloud.camera[kept],
    )


def _camera_findings(expected: int, name: str, camera: _Camera, keep: Mask) -> list[Finding]:
    found = []
    if not keep.any():
        message = f"camera {name} sees nothing of the person; check that it is not covered"
        found.append(Finding("camera-blind", name, None, message))
    if camera.frames < _MIN_FRAMES_SHARE * expected:
        message = f"camera {name} gave {camera.frames} of {expected} frames; check its connection"
        found.append(Finding("frames-missing", name, float(camera.frames), message))
    moved_m = _motion(camera, keep)
    if moved_m > _MOTION_M:
        message = f"the person moved by {1e3 * moved_m:.0f} mm during the scan (camera {name})"
        found.append(Finding("motion", name, moved_m, message))
    elif camera.unsettled > _UNSETTLED_SHARE:
        message = (
            f"the person moved during the scan: {100 * camera.unsettled:.0f} % of the readings of "
            f"camera {name} differ between frames"
        )
        found.append(Finding("motion", name, None, message))
    return found


def _motion(camera: _Camera, keep: Mask) -> float:
    """Distance (m) that the person moved from the first third of the frames to the last.

    Least squares for one shift t that explains the depth changes: n . t = (n . ray) change.
    """
    chosen = np.flatnonzero(keep & np.isfinite(camera.change_m))[::_MOTION_STRIDE]
    if len(chosen) < _MIN_MOVING:
        return 0.0
    pose = camera.calibration.world_from_camera
    offsets = camera.points[chosen] - pose[:3, 3]
    along = offsets / (offsets @ pose[:3, 2])[:, None]
    directions = camera.normals[chosen]
    shift = np.einsum("ni,ni->n", directions, along) * camera.change_m[chosen]
    gate = _MOTION_OUTLIER * np.median(np.abs(shift)) + _MOTION_OUTLIER_M
    used = np.abs(shift) < gate
    normal = directions[used].T @ directions[used] + _MOTION_RIDGE * used.sum() * np.eye(3)
    return float(np.linalg.norm(np.linalg.solve(normal, directions[used].T @ shift[used])))
