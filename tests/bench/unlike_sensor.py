"""A sensor that errs otherwise than the reconstruction assumes, and a calibration that is off.

Depths have a smooth bias that no polynomial of the image coordinates or of the depth removes,
silhouettes lose their outermost pixels, and each camera stands a millimetre and a twentieth of a
degree off the calibration, in a direction of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.bundle import CapturedFrame, write_bundle
from station.core.geometry import se3_exp
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import Rig
from station.simulation.scene import Mesh, astray
from station.simulation.sensor import FRAME_RATE_HZ, TICK_HZ, SimulatedBooth, VirtualCamera

Array = NDArray[np.float64]

_WAVES = 40
_REFERENCE_M = 1.7
"""Depth at which the bias has its nominal size; it grows with the square of the depth."""
_SILHOUETTE_M = 0.05
"""A jump of depth between neighbouring pixels that makes a silhouette."""
_NOTHING_M = 9.0
_HOLE = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, slots=True)
class UnlikeSensor:
    """Errors of the sensors and of the calibration."""

    bias_m: float = 1.5e-3
    """Size of each sensor's bias at 1.7 m: 95 of 100 pixels err by less."""
    bias_wavelengths_px: tuple[float, float] = (100.0, 400.0)
    eroded_px: tuple[int, int] = (1, 2)
    """Fewest and most pixels that a silhouette loses, one number for each camera."""
    shift_m: float = 1e-3
    turn_rad: float = float(np.radians(0.05))


def render_unlike(
    body: Mesh,
    folder: Path,
    booth: SimulatedBooth | None = None,
    sensor: UnlikeSensor | None = None,
    *,
    frames: int = 10,
) -> Path:
    """Write the bundle that such sensors would give of a body; `booth.rig` is what is believed."""
    booth, sensor = booth or SimulatedBooth(), sensor or UnlikeSensor()
    rng = np.random.default_rng((booth.seed, 404))
    true_booth = replace(booth, rig=_misplaced(booth.rig, sensor, rng))
    taken = {}
    for name, believed in booth.rig.cameras.items():
        bias = _bias_map(believed.height, believed.width, sensor, rng)
        radius = int(rng.integers(sensor.eroded_px[0], sensor.eroded_px[1] + 1))
        camera = VirtualCamera(true_booth, name, body)
        taken[name] = [
            CapturedFrame(
                _misread(TABLE[frame.raw], bias, radius),
                frame.ticks,
                TICK_HZ,
                frame.time_s,
                frame.sequence,
            )
            for frame in camera.frames(0 if name in booth.dead_cameras else frames)
        ]
    write_bundle(
        folder,
        scan_id="unlike",
        created="2026-01-01T00:00:00Z",
        label="virtual",
        depth_scale_m=DEPTH_SCALE_M,
        rig=booth.rig,
        frames=taken,
        spread_s_max=1.0 / FRAME_RATE_HZ,
    )
    return folder


def _misplaced(rig: Rig, sensor: UnlikeSensor, rng: np.random.Generator) -> Rig:
    """The true places of the cameras."""
    cameras = {}
    for name, camera in rig.cameras.items():
        pose = camera.world_from_camera @ se3_exp(astray(sensor.shift_m, sensor.turn_rad, rng))
        cameras[name] = replace(camera, world_from_camera=pose)
    return replace(rig, cameras=cameras)


def _bias_map(height: int, width: int, sensor: UnlikeSensor, rng: np.random.Generator) -> Array:
    """(h, w): metres of bias at the reference depth, waves of random directions and lengths."""
    if sensor.bias_m == 0.0:
        return np.zeros((height, width))
    shortest, longest = sensor.bias_wavelengths_px
    lengths = shortest * (longest / shortest) ** rng.random(_WAVES)
    angles, phases = rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES))
    x, y = np.arange(width), np.arange(height)[:, None]
    total = np.zeros((height, width))
    for length, angle, phase in zip(lengths, angles, phases, strict=True):
        step = 2.0 * np.pi / length
        total += np.cos(step * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    total -= total.mean()
    return np.asarray(sensor.bias_m * total / np.quantile(np.abs(total), 0.95))


def _misread(depth: NDArray[np.uint16], bias_m: Array, radius: int) -> NDArray[np.uint16]:
    """A frame (h, w) in units of DEPTH_SCALE_M with its bias, and without its silhouettes."""
    depth_m = depth * DEPTH_SCALE_M
    off = bias_m * np.square(depth_m / _REFERENCE_M)
    found = np.where(depth > 0, np.rint((depth_m + off) / DEPTH_SCALE_M), 0.0)
    if radius:
        # Beside a silhouette lies a wall, or nothing at all; small holes are dropped readings.
        nothing = cv2.morphologyEx((depth == 0).astype(np.uint8), cv2.MORPH_OPEN, _HOLE)
        beyond = np.where(nothing > 0, _NOTHING_M, depth_m).astype(np.float32)
        farthest = cv2.dilate(beyond, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
        found[farthest - depth_m > _SILHOUETTE_M] = 0.0
    return found.astype(np.uint16)
