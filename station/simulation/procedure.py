"""A whole calibration in the virtual booth: the empty booth, a ball waved through it by a person,
the ball on the mark and in front of it, a flat board at several places."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.step_names import (
    AROUND,
    BALL,
    EMPTY,
    FRONT,
    HANGING,
    HEIGHTS_M,
    MARK,
    PLACES,
    STAND,
    WALL,
    kind_of,
    numbered_step,
    place_of,
    raised_height_m,
    raised_step,
)
from station.core.errors import InputError
from station.core.kinect_v1 import INDEPENDENT_HZ
from station.simulation import violations
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

STRIDE = FRAME_RATE_HZ / INDEPENDENT_HZ
"""Every so many frames of a ball are used."""
_REST_S, _HANG_S = 2.0, 5.0
_PAUSE_S = 3.0
"""Between two steps, while the person walks away."""
_STILL_FRAMES = 8
_BOARD_M = (1.2, 2.1)
_BOARD_THICK_M = 0.02
_TAPE_M = 1e-3
"""Largest error of a height that was measured with a tape."""


@dataclass(frozen=True)
class VirtualProcedure:
    """The frames of a whole calibration; the same seed gives the same frames."""

    booth: SimulatedBooth = field(default_factory=SimulatedBooth)
    radius_m: float = 0.1
    waving_s: float = 60.0
    front_m: float = 0.5
    """Distance of the ball in front of the mark when it rests there."""
    board_at_m: tuple[float, ...] = (-0.6, 0.0, 0.6)
    """y of the board's middle at each of its places."""
    around_m: tuple[tuple[float, float], ...] = ((0.6, 0.0), (-0.6, 0.0), (0.0, 0.6))
    """x, y of the ball at each of its places on the floor around the mark."""
    hanging: bool = False
    """Above the mark, the ball hangs from a hook; otherwise it is on a stand."""
    _views: dict[tuple[str, float | None], TrueView] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def raised_m(self) -> tuple[float, ...]:
        """Stated heights of the ball's underside above the floor."""
        return HEIGHTS_M[HANGING if self.hanging else STAND][::-1]

    @property
    def steps(self) -> tuple[str, ...]:
        """All steps in their order."""
        walls = (numbered_step(WALL, i) for i in range(len(self.board_at_m)))
        around = (numbered_step(AROUND, i) for i in range(len(self.around_m)))
        kind = HANGING if self.hanging else STAND
        raised = (raised_step(kind, height) for height in self.raised_m)
        return (EMPTY, BALL, MARK, FRONT, *walls, *around, *raised)

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
        calibration = unit.camera
        index = list(self.booth.rig.cameras).index(camera)
        rng = np.random.default_rng((self.booth.seed, index, 2, self.steps.index(step)))
        view, others = self._still(camera, self._board_y_m(step)), self.booth.disturbing(camera)
        # The background is a short loop with noise; only moving objects are drawn in each frame.
        moves = step in (BALL, MARK, FRONT) or step.startswith(PLACES)
        still = NoiselessView.of(view, unit.error)
        loop = [still.read(rng) for _ in range(_STILL_FRAMES if moves else 0)]
        start_s = self.starts_s(step)
        first = int(np.ceil((start_s - unit.phase_s) * FRAME_RATE_HZ))
        lasts_s = min(self._lasts_s(step), limit_s or np.inf)
        count = int(lasts_s * FRAME_RATE_HZ)
        for sequence in (first + int(later) for later in np.arange(0.0, count, stride)):
            time_s = unit.phase_s + sequence / FRAME_RATE_HZ
            raw = loop[int(rng.integers(len(loop)))] if moves else still.read(rng)
            drawn = overlay(view, calibration, self._moving(step, time_s), others)
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
        """True position (3,) of the waved ball, world frame."""
        return self._path.at(time_s - self.starts_s(BALL))

    def _lasts_s(self, step: str) -> float:
        if step == BALL:
            return self.waving_s
        return _HANG_S if step.startswith(HANGING) else _REST_S

    def _board_y_m(self, step: str) -> float | None:
        return self.board_at_m[place_of(step)] if kind_of(step) == WALL else None

    def _still(self, camera: str, board_y_m: float | None) -> TrueView:
        """The view of everything fixed; most steps share it."""
        if (camera, board_y_m) not in self._views:
            meshes = self.booth.fixtures
            if board_y_m is not None:
                half, high = 0.5 * _BOARD_M[0], _BOARD_M[1]
                near, far = board_y_m - 0.5 * _BOARD_THICK_M, board_y_m + 0.5 * _BOARD_THICK_M
                board = box((-half, near, 0.0), (half, far, high))
                rng = np.random.default_rng((self.booth.seed, 8))
                meshes.append(uneven(board, 1, self.booth.uneven_board_m, rng))
            calibration = SimulatedUnit.of(self.booth, camera).camera
            view = VirtualScene(meshes).view(
                calibration, calibration.world_from_camera, self.booth.disturbing(camera)
            )
            self._views[camera, board_y_m] = view
        return self._views[camera, board_y_m]

    @property
    def true_radius_m(self) -> float:
        """The ball's, as it is; ``radius_m`` is what the operator states."""
        return self.radius_m * violations.ball_scale(self.booth.violations, self.booth.seed)

    @property
    def oval_share(self) -> float:
        return violations.oval_share(self.booth.violations)

    def axis(self, step: str, time_s: float) -> Array:
        """Long axis (3,) of a ball that is oval."""
        heading = self._path.heading(time_s) if step == BALL else 0.0
        return violations.oval_axis(self.booth.seed, heading)

    def resting_m(self, step: str, time_s: float) -> Array:
        """True centre (3,) of the ball that rests in a step; what hangs still swings a little."""
        x, y, height = 0.0, 0.0, 0.0
        if step == FRONT:
            y = -self.front_m
        elif kind_of(step) == AROUND:
            x, y = self.around_m[place_of(step)]
        elif (stated_m := raised_height_m(step)) is not None:
            stated_mm = round(1e3 * stated_m)
            rng = np.random.default_rng((self.booth.seed, 11, stated_mm))
            height = stated_m + rng.uniform(-_TAPE_M, _TAPE_M)
            if step.startswith(HANGING):
                x, y = violations.hung_m(self.booth.seed, stated_mm, height, time_s)
        bow = violations.bow_m(self.booth.violations, self.booth.seed, np.array(x), np.array(y))
        return np.array([x, y, height + float(bow) + self.true_radius_m])

    def _moving(self, step: str, time_s: float) -> list[Capsule]:
        if kind_of(step) in (EMPTY, WALL):
            return []
        radius_m, switches = self.true_radius_m, self.booth.violations
        waved = step == BALL
        center = self.ball_center_m(time_s) if waved else self.resting_m(step, time_s)
        shapes = [ball(center, radius_m, self.axis(step, time_s), self.oval_share)]
        if waved:
            shapes += self._path.person(
                center, time_s, radius_m, covers=violations.HAND in switches
            )
            if violations.HELPER in switches:
                shapes += self._path.helper(time_s)
        elif step.startswith(STAND):
            foot = center * (1.0, 1.0, 0.0)
            shapes.append(Capsule(foot, center - (0.0, 0.0, radius_m + 0.012), 0.012))
        return shapes

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

    def heading(self, time_s: float) -> float:
        """Direction of the person from the ball, radians."""
        return self.heading_rad + self.turn_rad_s * time_s

    def helper(self, time_s: float) -> list[Capsule]:
        """Trunk, arm and head of somebody who walks along the edge of the booth."""
        angle = self.heading_rad + 2.0 + 0.35 * np.sin(0.4 * time_s)
        foot = 0.85 * np.array([np.cos(angle), np.sin(angle), 0.0])
        up, side = np.array([0.0, 0.0, 1.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        hand = foot - 0.2 * foot + (1.0 + 0.2 * np.sin(1.3 * time_s)) * up
        return [
            Capsule(foot + 0.15 * up, foot + 1.3 * up, 0.16),
            Capsule(foot + 1.58 * up, foot + 1.65 * up, 0.085),
            Capsule(foot + 1.3 * up + 0.2 * side, hand + 0.2 * side, 0.045),
            ball(hand + 0.2 * side, 0.06),
        ]

    def person(
        self, center_m: Array, time_s: float, radius_m: float, covers: bool = False
    ) -> list[Capsule]:
        """Fingers, hand, arm, trunk and head of whoever holds the ball.

        ``covers``: the grip moves around the ball, and palm and fingers lie over it.
        """
        heading = self.heading(time_s)
        away = np.array([np.cos(heading), np.sin(heading), 0.0])
        across = np.array([-away[1], away[0], 0.0])
        shoulder = center_m + 0.5 * away
        shoulder[2] = np.clip(center_m[2] + 0.05, 0.75, 1.4)
        grip = shoulder - center_m - (0.0, 0.0, 0.35)
        grip /= np.linalg.norm(grip)
        if covers:
            turn = 0.9 * np.sin(0.31 * time_s + self.heading_rad) * np.pi
            grip = np.cos(turn) * grip + np.sin(turn) * np.cross(across, grip)
            grip = grip / np.linalg.norm(grip)
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
            if covers:
                knuckle = center_m + (radius_m + 0.004) * tip / np.linalg.norm(tip)
                flat = 0.15 * grip + side
                end = center_m + (radius_m + 0.002) * flat / np.linalg.norm(flat)
                parts += [Capsule(hand, knuckle, 0.014), Capsule(knuckle, end, 0.011)]
        trunk = shoulder + 0.22 * away - 0.1 * across
        hip = trunk.copy()
        hip[2] = 0.15
        parts.append(Capsule(hip, trunk - (0.0, 0.0, 0.1), 0.15))
        chin = trunk + np.array([0.0, 0.0, 0.22])
        parts.append(Capsule(chin, chin + np.array([0.0, 0.0, 0.07]), 0.08))
        return parts
