"""Booths, sensors and scans on which the watch for moved cameras is tried, fixed by seed.

Nothing here is what `station.calibration.drift` assumes: sensors have a smooth bias, frozen noise,
unknown lenses, a temperature of their own every day and silhouettes that lose their outermost
pixels; people differ from scan to scan, sway, bring bags, move chairs and curtains, hang up coats.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView, static_view
from station.core.geometry import rigid, se3_exp, so3_exp, transform
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import CameraCalibration, Rig
from station.simulation import violations
from station.simulation.noise import NoiselessView
from station.simulation.scene import (
    Mesh,
    VirtualScene,
    booth_walls,
    box,
    chair,
    default_rig,
    fixed_posts,
    sphere,
)
from station.simulation.sensor import SimulatedBooth, SimulatedUnit
from workers.scape.model.body_model import BodyState, load_model

Array = NDArray[np.float64]
Depth = NDArray[np.uint16]
Room = Literal["posts", "bare", "furnished", "one wall"]
Scene = Literal[
    "empty", "person", "bag", "helper", "chair moved", "chair moved, empty", "chair added",
    "chair removed", "curtain moved", "coat hung",
]  # fmt: skip

ROOMS: tuple[Room, ...] = ("posts", "bare", "furnished")
SCENES: tuple[Scene, ...] = (
    "person", "bag", "chair moved", "helper", "empty", "chair added", "chair removed",
    "curtain moved", "coat hung", "chair moved, empty",
)  # fmt: skip
_FURNISHED = ("chair moved", "chair moved, empty", "chair removed", "curtain moved")
STORED_FRAMES, SCAN_FRAMES, CHECK_FRAMES = 45, 10, 30

_RIG_TURN_RAD, _RIG_SHIFT_M = float(np.radians(3.0)), 0.05
"""Mounts differ from booth to booth by about so much."""
_WARMTH_PER_M, _WARMTH_GAIN = 3e-5, 5e-5
"""Change of a warm sensor's inverse depth from day to day, each 0.1 mm at 1.7 m."""
_SILHOUETTE_PER_M, _NOTHING_M = 0.015, 9.0
"""A jump between neighbouring pixels that makes a silhouette, times the squared depth."""
_MOST_ERODED_PX = 2
_ANOTHER_DAY = 0.3
"""Chance that a silhouette loses another number of pixels than when the booth was calibrated."""
_SWAY_M = 0.003
_NUDGE_M = 0.02
_HOLE = np.ones((5, 5), np.uint8)
_CHAIR_M = (0.75, 0.45)
_CURTAIN_X_M = (-1.5, 1.5)
"""A curtain hangs somewhere along the wall behind the person, another along that in front."""
_COAT_M = (0.2, 0.08, 0.45)
"""Half its width, depth and height."""
_BODIES = 64
"""People of all scans."""
_SEES = 0.3
"""Share of readings in the image of a camera that somebody would mount so."""


def random_body(rng: np.random.Generator) -> Mesh:
    """Somebody who stands about where one should."""
    body = _body(int(rng.integers(_BODIES)))
    x, y = rng.normal(0.0, 0.05, 2)
    return placed(body, x, y, rng.normal(0.0, 0.15))


@lru_cache(maxsize=_BODIES)
def _body(number: int) -> Mesh:
    rng = np.random.default_rng((number, 28))
    model = load_model()
    twists = rng.multivariate_normal(model.twist_mean, model.twist_covariance).reshape(-1, 3)
    first = np.zeros((1, 3))
    rotations = model.absolute_rotations(np.concatenate([first, 0.7 * twists]))
    beta = rng.standard_normal(model.beta_count)
    vertices = model.vertices(BodyState(rotations, beta, np.zeros(3)))
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return Mesh(vertices - (middle[0], middle[1], vertices[:, 2].min()), model.faces)


def placed(mesh: Mesh, x: float, y: float, turn_rad: float = 0.0) -> Mesh:
    """A mesh turned about the vertical and moved over the floor."""
    pose = rigid(so3_exp([0.0, 0.0, turn_rad]), (x, y, 0.0))
    return Mesh(transform(pose, mesh.vertices), mesh.faces, mesh.dark)


def leaning(mesh: Mesh, lean_m: float) -> Mesh:
    """Feet stay, the head moves by lean_m."""
    share = np.clip(mesh.vertices[:, 2:] / 1.7, 0.0, 1.2) * (0.6, 0.8, 0.0)
    return Mesh(mesh.vertices + share * lean_m, mesh.faces, mesh.dark)


@dataclass(frozen=True, slots=True)
class Visit:
    """Scene of one scan, twice: before and after half a sway."""

    kind: Scene
    moments: tuple[VirtualScene, ...]
    seed: int
    day: int
    """Scans of one day share the sensors' warmth and silhouettes."""


class DriftBooth:
    """A booth with its four sensors and their stored views of it."""

    def __init__(self, seed: int, room: Room) -> None:
        self.seed, self.room = seed, room
        rng = np.random.default_rng((seed, 21))
        rig = default_rig()
        cameras = {name: _mounted(camera, rng) for name, camera in rig.cameras.items()}
        self._chair_turn = rng.uniform(0.0, 2.0 * np.pi)
        self._fixed = _fixtures(room)
        self._curtains_m = np.random.default_rng((seed, 26)).uniform(*_CURTAIN_X_M, 2)
        empty = VirtualScene([*self._fixed, *self._chair(0.0, 0.0), *self._curtains(0.0)])
        self.sensors: dict[str, DriftSensor] = {}
        for name, camera in rig.cameras.items():
            while True:
                sensor = DriftSensor(_drift_booth(seed, rig, cameras), name, empty)
                # Nobody calibrates a camera that is mounted inside a post and sees nothing.
                if sensor.stored.share.mean() > _SEES:
                    break
                cameras[name] = _mounted(camera, rng)
            self.sensors[name] = sensor

    @property
    def scenes(self) -> tuple[Scene, ...]:
        """Those that the room has the furniture for."""
        if self.room == "furnished":
            return SCENES
        return tuple(scene for scene in SCENES if scene not in _FURNISHED)

    def visit(self, kind: Scene, seed: int, day: int | None = None) -> Visit:
        """One scan's scene, on a day of its own if none is given."""
        rng = np.random.default_rng((self.seed, seed, 22))
        things, people = list(self._fixed), []
        if "empty" not in kind:
            people.append(random_body(rng))
        if kind == "bag":
            angle, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.5, 1.5)
            bag = box((-0.2, -0.12, 0.0), (0.2, 0.12, rng.uniform(0.25, 0.5)))
            x, y = away * np.cos(angle), away * np.sin(angle)
            things.append(placed(bag, x, y, rng.uniform(0.0, np.pi)))
        if kind == "helper":
            side = rng.choice([-1.0, 1.0])
            where = (side * rng.uniform(1.1, 1.8), rng.uniform(-0.9, 0.9))
            people.append(placed(random_body(rng), *where, rng.uniform(0.0, 2.0 * np.pi)))
        things.extend(self._furniture(kind, rng))
        leans = _SWAY_M * rng.uniform(-1.0, 1.0, 2) if people else np.zeros(1)
        moments = [
            VirtualScene([*things, *(leaning(person, lean) for person in people)]) for lean in leans
        ]
        return Visit(kind, tuple(moments), seed, seed if day is None else day)

    def _furniture(self, kind: Scene, rng: np.random.Generator) -> list[Mesh]:
        """Furniture after a change: from a nudge, which looks like a moved camera, to another
        place."""
        angle = rng.uniform(0.0, 2.0 * np.pi)
        by = _NUDGE_M * 30.0 ** rng.random() * np.array([np.cos(angle), np.sin(angle)])
        things = [] if kind == "chair removed" else self._chair(*(by * ("chair moved" in kind)))
        things += self._curtains(float(by[0]) if kind == "curtain moved" else 0.0)
        if kind == "chair added":
            x, y = rng.choice([-1.0, 1.0], 2) * rng.uniform((0.6, 0.5), (1.6, 1.3))
            things += [placed(part, x, y, angle) for part in chair((0.0, 0.0))]
        if kind == "coat hung":
            side = rng.choice([-1.0, 1.0])
            coat = sphere((0.0, 0.0, 0.0), 1.0)
            hung = np.array([rng.uniform(-1.5, 1.5), side * 2.03, rng.uniform(1.0, 1.4)])
            things.append(Mesh(coat.vertices * _COAT_M + hung, coat.faces))
        return things

    def _chair(self, dx: float, dy: float) -> list[Mesh]:
        if self.room != "furnished":
            return []
        x, y = _CHAIR_M
        return [placed(part, x + dx, y + dy, self._chair_turn) for part in chair((0.0, 0.0))]

    def _curtains(self, dx: float) -> list[Mesh]:
        if self.room != "furnished":
            return []
        return [
            _curtain(x + dx, side) for x, side in zip(self._curtains_m, (-1.0, 1.0), strict=True)
        ]


def _curtain(x: float, side: float) -> Mesh:
    """Folds of cloth before the wall at y = 2.1 m times side."""
    across = np.linspace(-0.35, 0.35, 57)
    y = side * (2.03 + 0.03 * np.sin(2.0 * np.pi * across / 0.14))
    low = np.stack([x + across, y, np.full_like(y, 0.1)], axis=1)
    vertices = np.concatenate([low, low + np.array([0.0, 0.0, 2.0])])
    left = np.arange(len(across) - 1)
    up = left + len(across)
    faces = np.concatenate([np.stack([left, left + 1, up], 1), np.stack([left + 1, up + 1, up], 1)])
    return Mesh(vertices, faces.astype(np.int32))


def _mounted(camera: CameraCalibration, rng: np.random.Generator) -> CameraCalibration:
    """A camera on a mount of another booth."""
    sigma = np.array([_RIG_TURN_RAD] * 3 + [_RIG_SHIFT_M] * 3)
    off = se3_exp(sigma * rng.standard_normal(6))
    return replace(camera, world_from_camera=camera.world_from_camera @ off)


def _drift_booth(seed: int, rig: Rig, cameras: Mapping[str, CameraCalibration]) -> SimulatedBooth:
    switches = {violations.BIAS, violations.FROZEN}
    if seed % 2:
        switches |= {violations.LENS, violations.K1, violations.RAW_LAW}
    return SimulatedBooth(
        rig=replace(rig, cameras=dict(cameras)),
        seed=seed,
        bias_m=0.005,
        violations=frozenset(switches),
    )


class DriftSensor:
    """One sensor of a booth, and its stored view of it."""

    def __init__(self, booth: SimulatedBooth, name: str, empty: VirtualScene) -> None:
        self.camera: CameraCalibration = booth.rig.cameras[name]
        self._unit = SimulatedUnit.of(booth, name)
        self._index = list(booth.rig.cameras).index(name)
        self._seed = booth.seed
        rng = np.random.default_rng((booth.seed, self._index, 23))
        self._eroded_px = int(rng.integers(0, _MOST_ERODED_PX + 1))
        moments = Visit("empty", (empty,), -1, -1)
        self.stored: StaticView = static_view(
            self._frames(moments, np.zeros(6), STORED_FRAMES, rng, (0.0, 0.0), self._eroded_px),
            DEPTH_SCALE_M,
        )

    def frames(self, visit: Visit, xi: Array, count: int) -> list[Depth]:
        """Depth frames of a scan by this sensor, moved by xi since it was calibrated."""
        day = np.random.default_rng((self._seed, self._index, visit.day, 24))
        warmth = (day.normal(0.0, _WARMTH_PER_M), day.normal(0.0, _WARMTH_GAIN))
        other = day.random() < _ANOTHER_DAY
        eroded = int(day.integers(0, _MOST_ERODED_PX + 1)) if other else self._eroded_px
        rng = np.random.default_rng((self._seed, self._index, visit.seed, 27))
        return self._frames(visit, xi, count, rng, warmth, eroded)

    def _frames(
        self,
        visit: Visit,
        xi: Array,
        count: int,
        rng: np.random.Generator,
        warmth: tuple[float, float],
        eroded_px: int,
    ) -> list[Depth]:
        pose = self.camera.world_from_camera @ se3_exp(xi)
        found = []
        for moment in visit.moments:
            true = moment.view(self._unit.camera, pose)
            still = NoiselessView.of(true, self._unit.error)
            inverse = 1.0 / np.where(still.depth_m > 0.0, still.depth_m, 1.0)
            warm = 1.0 / (warmth[0] + (1.0 + warmth[1]) * inverse)
            still = replace(
                still, depth_m=np.where(still.depth_m > 0.0, warm, 0.0).astype(np.float32)
            )
            for _ in range(count // len(visit.moments)):
                found.append(eroded(TABLE[still.read(rng)], eroded_px))
        return found


def eroded(depth: Depth, radius_px: int) -> Depth:
    """A frame without the outermost pixels of its silhouettes."""
    if not radius_px:
        return depth
    metres = depth.astype(np.float32) * np.float32(DEPTH_SCALE_M)
    nothing = cv2.morphologyEx((depth == 0).astype(np.uint8), cv2.MORPH_OPEN, _HOLE)
    beyond = np.where(nothing > 0, np.float32(_NOTHING_M), metres)
    farthest = cv2.dilate(beyond, np.ones((2 * radius_px + 1,) * 2, np.uint8))
    return np.where(farthest - metres > _SILHOUETTE_PER_M * np.square(metres), 0, depth).astype(
        np.uint16
    )


@lru_cache(maxsize=8)
def _fixtures(room: Room) -> tuple[Mesh, ...]:
    if room == "one wall":
        return (box((-6.0, 2.1, -4.0), (6.0, 2.2, 6.0)), box((-6.0, -2.2, -4.0), (6.0, -2.1, 6.0)))
    if room == "bare":
        return booth_walls()
    if room == "posts":
        return (*booth_walls(), *fixed_posts())
    shelf = box((-2.1, -0.9, 0.0), (-1.75, -0.1, 1.8))
    return (*booth_walls(), *fixed_posts(), shelf)


def random_move(rng: np.random.Generator, most: Sequence[float] = (0.02, np.radians(1.0))) -> Array:
    """A shift of 0 to 20 mm, a turn of 0 to 1 degree, or both, in random directions."""
    xi = np.zeros(6)
    kind = rng.integers(3)
    if kind != 0:
        xi[3:] = most[0] * rng.random() * direction(rng)
    if kind != 1:
        xi[:3] = most[1] * rng.random() * direction(rng)
    return xi


def direction(rng: np.random.Generator) -> Array:
    """A random unit vector (3,)."""
    found = rng.standard_normal(3)
    return np.asarray(found / np.linalg.norm(found))
