"""A whole calibration in the virtual booth: the empty booth, a ball waved through it by a person,
the ball on the mark and in front of it, a flat board at several places."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from station.core.errors import InputError
from station.core.kinect_v1 import INDEPENDENT_HZ
from station.simulation.noise import NoiselessView, TrueView, observe
from station.simulation.round_objects import Capsule, ball, overlay
from station.simulation.scene import VirtualScene, box, uneven
from station.simulation.sensor import (
    FRAME_RATE_HZ,
    SimulatedBooth,
    SimulatedUnit,
    VirtualFrame,
)

Array = NDArray[np.float64]

EMPTY, BALL, MARK, FRONT, AROUND = "empty", "ball", "mark", "front", "around"
STRIDE = FRAME_RATE_HZ / INDEPENDENT_HZ
"""No more frames of a ball are looked at."""
_REST_S = 2.0
_PAUSE_S = 3.0
"""Between two steps, while the person walks away."""
_STILL_FRAMES = 8
_BOARD_M = (1.2, 2.1)
_BOARD_THICK_M = 0.02


@dataclass(frozen=True)
class VirtualProcedure:
    """A virtual calibration as the cameras see it; the same seed gives the same frames."""

    booth: SimulatedBooth = field(default_factory=SimulatedBooth)
    radius_m: float = 0.1
    waving_s: float = 60.0
    front_m: float = 0.5
    """Distance in front of the mark at which the ball rests the second time."""
    board_at_m: tuple[float, ...] = (-0.6, -0.2, 0.2, 0.6)
    """y of the board's middle at each of its places."""
    around_m: tuple[tuple[float, float], ...] = ((0.6, 0.0), (-0.6, 0.0), (0.0, 0.6))
    """x, y of the ball at each of its places on the floor around the mark."""
    _views: dict[tuple[str, float | None], TrueView] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def steps(self) -> tuple[str, ...]:
        """In the order in which they are done."""
        walls = (f"wall-{i}" for i in range(len(self.board_at_m)))
        around = (f"{AROUND}-{i}" for i in range(len(self.around_m)))
        return (EMPTY, BALL, MARK, FRONT, *walls, *around)

    def starts_s(self, step: str) -> float:
        """True time at which a step begins."""
        start_s = 0.0
        for other in self.steps:
            if other == step:
                return start_s
            start_s += self._lasts_s(other) + _PAUSE_S
        raise InputError(f"the calibration has no step {step} (it has: {', '.join(self.steps)})")

    def frames(
        self, camera: str, step: str, *, stride: float = 1.0, limit_s: float | None = None
    ) -> Iterator[VirtualFrame]:
        """A camera's frames of a step: every stride-th of 30 a second, on the average."""
        unit = SimulatedUnit.of(self.booth, camera)
        calibration = self.booth.rig.cameras[camera]
        index = list(self.booth.rig.cameras).index(camera)
        rng = np.random.default_rng((self.booth.seed, index, 2, self.steps.index(step)))
        view = self._still(camera, self._board_y_m(step))
        # The background is a short loop with noise; only moving objects are drawn in each frame.
        moves = step in (BALL, MARK, FRONT) or step.startswith(AROUND)
        still = NoiselessView.of(view, unit.error)
        loop = [still.read(rng) for _ in range(_STILL_FRAMES if moves else 0)]
        start_s = self.starts_s(step)
        first = int(np.ceil((start_s - unit.phase_s) * FRAME_RATE_HZ))
        lasts_s = min(self._lasts_s(step), limit_s or np.inf)
        count = int(lasts_s * FRAME_RATE_HZ)
        for sequence in (first + int(later) for later in np.arange(0.0, count, stride)):
            time_s = unit.phase_s + sequence / FRAME_RATE_HZ
            raw = loop[int(rng.integers(len(loop)))] if moves else still.read(rng)
            drawn = overlay(view, calibration, self._moving(step, time_s))
            if drawn is not None:
                part, window = drawn
                height, width = part.depth_m.shape
                raw = raw.copy()
                raw[window.top : window.top + height, window.left : window.left + width] = observe(
                    part, unit.error, rng, window
                )
            if rng.random() < self.booth.drop_rate:
                continue
            yield VirtualFrame(time_s, unit.ticks(time_s), sequence, raw)

    def ball_center_m(self, time_s: float) -> Array:
        """True centre of the waved ball, world frame."""
        return self._path.at(time_s - self.starts_s(BALL))

    def _lasts_s(self, step: str) -> float:
        return self.waving_s if step == BALL else _REST_S

    def _board_y_m(self, step: str) -> float | None:
        return (
            self.board_at_m[int(step.removeprefix("wall-"))] if step.startswith("wall-") else None
        )

    def _still(self, camera: str, board_y_m: float | None) -> TrueView:
        """View of everything that does not move; most steps share it."""
        if (camera, board_y_m) not in self._views:
            meshes = self.booth.fixtures
            if board_y_m is not None:
                half, high = 0.5 * _BOARD_M[0], _BOARD_M[1]
                near, far = board_y_m - 0.5 * _BOARD_THICK_M, board_y_m + 0.5 * _BOARD_THICK_M
                board = box((-half, near, 0.0), (half, far, high))
                rng = np.random.default_rng((self.booth.seed, 8))
                meshes.append(uneven(board, 1, self.booth.uneven_board_m, rng))
            calibration = self.booth.rig.cameras[camera]
            view = VirtualScene(meshes).view(calibration, calibration.world_from_camera)
            self._views[camera, board_y_m] = view
        return self._views[camera, board_y_m]

    def _moving(self, step: str, time_s: float) -> list[Capsule]:
        if step == BALL:
            center = self.ball_center_m(time_s)
            return [ball(center, self.radius_m), *self._path.person(center, time_s, self.radius_m)]
        if step == MARK:
            return [ball(np.array([0.0, 0.0, self.radius_m]), self.radius_m)]
        if step == FRONT:
            return [ball(np.array([0.0, -self.front_m, self.radius_m]), self.radius_m)]
        if step.startswith(AROUND):
            x, y = self.around_m[int(step.removeprefix(f"{AROUND}-"))]
            return [ball(np.array([x, y, self.radius_m]), self.radius_m)]
        return []

    @cached_property
    def _path(self) -> _Waving:
        return _Waving.draw(np.random.default_rng((self.booth.seed, 3)), self.waving_s)


@dataclass(frozen=True)
class _Waving:
    """A person who waves a ball through the booth at 0.3-0.5 m/s, walking around it meanwhile."""

    middle_m: Array
    size_m: Array
    """(k, 3) amplitudes of each harmonic."""
    rate_hz: Array
    phase_rad: Array
    turn_rad_s: float
    heading_rad: float

    @classmethod
    def draw(cls, rng: np.random.Generator, lasts_s: float) -> _Waving:
        # The ball goes up and down while it sweeps the plan; then wobble and a hand's tremor.
        size = np.array([[0.48, 0.42, 0.76], [0.03, 0.03, 0.03], [0.006, 0.006, 0.006], [2e-4] * 3])
        rate = np.array([[0.11, 0.135, 0.058], [0.37, 0.31, 0.41], [1.1, 1.3, 0.9], [8, 9, 8.5]])
        return cls(
            middle_m=np.array([0.0, 0.0, 1.07]),
            size_m=size * rng.uniform(0.9, 1.1, size.shape),
            rate_hz=rate * rng.uniform(0.92, 1.08, rate.shape),
            phase_rad=rng.uniform(0.0, 2.0 * np.pi, rate.shape),
            turn_rad_s=2.0 * np.pi * rng.choice([-1.0, 1.0]) * rng.uniform(1.5, 2.5) / lasts_s,
            heading_rad=rng.uniform(0.0, 2.0 * np.pi),
        )

    def at(self, time_s: float) -> Array:
        angle = 2.0 * np.pi * self.rate_hz * time_s + self.phase_rad
        return np.asarray(self.middle_m + np.sum(self.size_m * np.sin(angle), axis=0))

    def person(self, center_m: Array, time_s: float, radius_m: float) -> list[Capsule]:
        """Fingers, hand, arm, trunk and head of whoever holds the ball."""
        heading = self.heading_rad + self.turn_rad_s * time_s
        away = np.array([np.cos(heading), np.sin(heading), 0.0])
        across = np.array([-away[1], away[0], 0.0])
        shoulder = center_m + 0.5 * away
        shoulder[2] = np.clip(center_m[2] + 0.05, 0.75, 1.4)
        grip = shoulder - center_m - (0.0, 0.0, 0.35)
        grip /= np.linalg.norm(grip)
        hand = center_m + (radius_m + 0.025) * grip
        elbow = 0.5 * (hand + shoulder) - (0.0, 0.0, 0.12)
        parts = [
            Capsule(hand, hand + 0.02 * grip, 0.042),
            Capsule(hand + 0.03 * grip, elbow, 0.038),
            Capsule(elbow, shoulder, 0.05),
        ]
        for spread in (-0.6, -0.2, 0.2, 0.6):
            side = across * np.cos(spread) + np.cross(grip, across) * np.sin(spread)
            tip = 0.75 * grip + 0.66 * side
            parts.append(Capsule(hand, center_m + (radius_m + 0.006) * tip, 0.009))
        trunk = shoulder + 0.22 * away - 0.1 * across
        hip = trunk.copy()
        hip[2] = 0.15
        parts.append(Capsule(hip, trunk - (0.0, 0.0, 0.1), 0.15))
        chin = trunk + np.array([0.0, 0.0, 0.22])
        parts.append(Capsule(chin, chin + np.array([0.0, 0.0, 0.07]), 0.08))
        return parts
