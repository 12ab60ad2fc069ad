"""The virtual Kinect: a body mesh seen by simulated sensors, live, as recordings or as a bundle."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.core.bundle import CapturedFrame, write_bundle
from station.core.errors import InputError
from station.core.geometry import se3_exp
from station.core.kinect_v1 import DEPTH_SCALE_M, depth_of_raw
from station.core.rig import CameraCalibration, Rig
from station.sensors.recording import RecordedFrame
from station.simulation import violations
from station.simulation.interference import Projector
from station.simulation.noise import NoiselessView, UnitError
from station.simulation.scene import (
    Mesh,
    VirtualScene,
    bent,
    booth_walls,
    default_rig,
    uneven,
)

Array = NDArray[np.float64]

TICK_HZ = 60_000_000
FRAME_RATE_HZ = 30.0
_SWAY_PERIOD_S = 3.1
_LEAN_STEP_M = 0.00025
"""A view is rendered again when the lean has changed by this much: far below the sensor's noise."""
_FACTORY_ENDS = (5e-4, 2.5e-3)
"""Largest gain and curvature of inverse depth among units that have depth errors at all."""


@dataclass(frozen=True, slots=True)
class SimulatedBooth:
    """Properties and faults of a virtual booth; the defaults are an ordinary day."""

    rig: Rig = field(default_factory=default_rig)
    """The calibration that the station believes."""
    seed: int = 0
    sway_m: float = 0.002
    """Amplitude of the head's sway, with a period of three seconds."""
    bias_m: float = 0.0
    """Size of each unit's systematic depth error at 2 m."""
    drop_rate: float = 0.0
    """Share of the frames that are lost."""
    moved_cameras: Mapping[str, Array] = field(default_factory=dict)
    """Camera -> twist (6,), rotation first, by which it stands off its calibration."""
    dead_cameras: Collection[str] = ()
    """Cameras that give no frame."""
    clutter: Sequence[Mesh] = ()
    """Further objects: a chair, a second person."""
    walls: bool = True
    violations: frozenset[str] = frozenset()
    """Names of `station.simulation.violations` that are switched on."""
    warmth: float = 0.0
    """Mean share by which depths of 2.5 m are larger than when the booth was calibrated."""
    uneven_floor_m: float = 0.0
    uneven_board_m: float = 0.0
    """Unevenness of the floor, and of a board held up in the booth, rms."""

    @property
    def fixtures(self) -> list[Mesh]:
        """Everything fixed in the booth."""
        if not self.walls:
            return [*self.clutter]
        floor, *walls = booth_walls()
        rng = np.random.default_rng((self.seed, 6))
        floor = uneven(floor, 2, self.uneven_floor_m, rng)
        if self.violations & {violations.FLOOR, violations.SLOPE}:
            floor = bent(floor, lambda x, y: violations.bow_m(self.violations, self.seed, x, y))
        return [floor, *walls, *self.clutter]

    def true_pose(self, camera: CameraCalibration) -> Array:
        """World from camera (4, 4), as it stands."""
        moved = self.moved_cameras.get(camera.name)
        believed = camera.world_from_camera
        return believed if moved is None else believed @ se3_exp(moved)

    def disturbing(self, name: str) -> list[Projector]:
        """Projectors whose light disturbs a camera."""
        if violations.INTERFERENCE not in self.violations:
            return []
        return [
            Projector(other, self.true_pose(other))
            for other in self.rig.cameras.values()
            if other.name != name and other.name not in self.dead_cameras
        ]


@dataclass(frozen=True, slots=True)
class VirtualFrame:
    """One raw frame with the unit's own clock."""

    time_s: float
    ticks: int
    sequence: int
    raw: NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class SimulatedUnit:
    """The properties of one simulated sensor."""

    error: UnitError
    camera: CameraCalibration
    """The true lens of the unit; the booth's rig has the one that its driver states."""
    drift: float
    phase_s: float
    first_tick: int

    @classmethod
    def of(cls, booth: SimulatedBooth, name: str) -> SimulatedUnit:
        """A camera's unit; the same in every simulation of this booth."""
        index = list(booth.rig.cameras).index(name)
        rng = np.random.default_rng((booth.seed, index, 1))
        made = np.random.default_rng((booth.seed, index, 5)).uniform(-1.0, 1.0, 2) * _FACTORY_ENDS
        return cls(
            error=UnitError(
                booth.bias_m * rng.uniform(-1.0, 1.0),
                tuple(rng.uniform(-0.3, 0.3, 2)),
                *_with_gain(made if booth.bias_m else np.zeros(2), booth, index),
                _warmth(booth, index),
                violations.smooth_bias(booth.violations, booth.seed, index),
                violations.zero_plane(booth.violations, booth.seed, index),
                violations.frozen_share(booth.violations),
                (booth.seed, index, 10),
                violations.interference(booth.violations, booth.seed, index),
            ),
            camera=violations.true_lens(
                booth.violations, booth.seed, index, booth.rig.cameras[name]
            ),
            drift=rng.uniform(-80e-6, 80e-6),
            phase_s=rng.uniform(0.0, 1.0 / FRAME_RATE_HZ),
            first_tick=int(rng.integers(0, 2**32)),
        )

    def ticks(self, time_s: float) -> int:
        """The device's counter, which wraps."""
        return (self.first_tick + round(time_s * TICK_HZ * (1.0 + self.drift))) % 2**32


def _with_gain(made: Array, booth: SimulatedBooth, index: int) -> tuple[float, float]:
    extra = violations.extra_gain(booth.violations, booth.seed, index)
    return float(made[0]) + extra, float(made[1])


def _warmth(booth: SimulatedBooth, index: int) -> tuple[float, int]:
    """A unit's share of the booth's warmth, and the law: a constant, in proportion to the depth, or
    to its square."""
    own = np.random.default_rng((booth.seed, index, 13)).uniform(0.6, 1.4)
    return booth.warmth * own, int(np.random.default_rng((booth.seed, 13)).integers(-1, 2))


class VirtualCamera:
    """One simulated unit in front of a body; the same seed gives the same frames."""

    def __init__(self, booth: SimulatedBooth, name: str, body: Mesh | None) -> None:
        index = list(booth.rig.cameras).index(name)
        self._rng = np.random.default_rng((booth.seed, index))
        self._booth = booth
        self.unit = SimulatedUnit.of(booth, name)
        self._camera = self.unit.camera
        self._body = body
        # One person, one sway: all cameras see the same phase.
        self._sway_phase = float(np.random.default_rng((booth.seed, 7, 7)).random())
        self._views: dict[float, NoiselessView] = {}

    def frames(self, count: int) -> Iterator[VirtualFrame]:
        """Frames at 30 Hz of the unit's own clock; a dropped one leaves a gap in the sequence."""
        for sequence in range(count):
            time_s = self.unit.phase_s + sequence / FRAME_RATE_HZ
            raw = self._view(time_s).read(self._rng)
            if self._rng.random() < self._booth.drop_rate:
                continue
            yield VirtualFrame(time_s, self.unit.ticks(time_s), sequence, raw)

    def _view(self, time_s: float) -> NoiselessView:
        """The view without noise at a time, rendered once for each lean."""
        booth, camera = self._booth, self._camera
        turns = time_s / _SWAY_PERIOD_S + self._sway_phase
        sway_m = 0.0 if self._body is None else booth.sway_m
        lean_m = sway_m * float(np.sin(2.0 * np.pi * turns))
        lean_m = _LEAN_STEP_M * round(lean_m / _LEAN_STEP_M)
        if lean_m not in self._views:
            meshes = booth.fixtures
            if self._body is not None:
                meshes.append(_leaning(self._body, lean_m))
            if not meshes:
                raise InputError("the virtual booth holds nothing to look at")
            view = VirtualScene(meshes).view(
                camera, booth.true_pose(camera), booth.disturbing(camera.name)
            )
            self._views[lean_m] = NoiselessView.of(view, self.unit.error)
        return self._views[lean_m]


def _leaning(body: Mesh, lean_m: float) -> Mesh:
    """Feet stay; the rest leans with height."""
    share = np.clip(body.vertices[:, 2:] / 1.7, 0.0, 1.2) * (0.6, 0.8, 0.0)
    return Mesh(body.vertices + share * lean_m, body.faces, body.dark)


def render_bundle(
    body: Mesh | None,
    folder: Path,
    booth: SimulatedBooth | None = None,
    *,
    frames: int = 10,
) -> Path:
    """Write the scan bundle that a booth with this body in it would give."""
    booth = booth or SimulatedBooth()
    taken = {}
    for name in booth.rig.cameras:
        camera = VirtualCamera(booth, name, body)
        taken[name] = [
            CapturedFrame(
                depth_of_raw(frame.raw), frame.ticks, TICK_HZ, frame.time_s, frame.sequence
            )
            for frame in camera.frames(0 if name in booth.dead_cameras else frames)
        ]
    write_bundle(
        folder,
        scan_id="virtual",
        created="2026-01-01T00:00:00Z",
        label="virtual",
        depth_scale_m=DEPTH_SCALE_M,
        rig=booth.rig,
        frames=taken,
        spread_s_max=1.0 / FRAME_RATE_HZ,
    )
    return folder


def recorded_frames(camera: VirtualCamera, count: int) -> Iterator[RecordedFrame]:
    """A camera's frames as a recording holds them."""
    for frame in camera.frames(count):
        yield RecordedFrame(frame.time_s, frame.ticks, frame.raw)
