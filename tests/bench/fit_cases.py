"""The bodies and booths on which the fit is tried, fixed by seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from room import first_with_room, has_room
from unlike_bodies import UnlikeBodies
from unlike_sensor import UnlikeSensor

from station.core.geometry import rigid, so3_exp
from station.core.rig import Rig
from station.simulation.scene import Mesh, box, bumped, chair, default_rig, look_at
from station.simulation.sensor import SimulatedBooth
from station.simulation.violations import INTERFERENCE
from workers.cloud.observed import PointCloud
from workers.scape.learn.database import PARTS, body_database
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]
Group = Literal["family", "unlike", "other", "hard", "rig", "bad"]

_POOL = 30
_SEED = 11
_POSES_TO_CHOOSE_FROM = 300


@dataclass(frozen=True, slots=True)
class Case:
    """One body in one booth."""

    group: Group
    name: str
    body: Mesh | None
    booth: SimulatedBooth
    sensor: UnlikeSensor | None = None
    """None for the usual one."""


class TestBodies:
    """Bodies that the model was not learned from, in poses that it was not learned from."""

    def __init__(self) -> None:
        self._database = body_database()
        self._shapes = self._database.sample("test", _POOL, _SEED)
        self._poses = self._database.sample_poses("test", _POOL, _SEED)

    def body(self, index: int) -> Mesh:
        """One body in the first pose, from its own on, that it has room for."""
        shapes = self._shapes.take(np.array([index]))
        poses = np.roll(self._poses, -index, axis=0)
        posed = (self._database.vertices(shapes, pose[None])[0] for pose in poses)
        faces = self._database.faces
        return on_the_mark(first_with_room(self._database.vertices(shapes)[0], posed, faces), faces)

    @cached_property
    def arms_close(self) -> Mesh:
        """The leanest body, its arms as near to the trunk as any held-out pose has them and the
        body has room for: an arm that is in the trunk can be seen by nobody."""
        poses = self._database.sample_poses("test", _POSES_TO_CHOOSE_FROM, _SEED + 1)
        lowered = [
            sign * poses[:, self._database.bones.index(f"upperarm01.{side}"), 1]
            for side, sign in (("L", 1.0), ("R", -1.0))
        ]
        closest_first = np.argsort(-np.minimum(*lowered), kind="stable")
        leanest = self._shapes.take(self._leanest_first[:1])
        posed = (self._database.vertices(leanest, pose[None])[0] for pose in poses[closest_first])
        faces = self._database.faces
        return on_the_mark(
            first_with_room(self._database.vertices(leanest)[0], posed, faces), faces
        )

    @cached_property
    def pregnant(self) -> Mesh:
        """The leanest woman, her belly 10 cm farther out by a bump that no training body has."""
        women = self._shapes.phenotypes["gender"][self._leanest_first] > 0.5
        roomy = (
            int(index)
            for index in self._leanest_first[women]
            if self._has_room(int(index), self._poses[index])
        )
        body = self.body(next(roomy))
        trunk = [list(PARTS).index(part) for part in ("pelvis", "abdomen", "chest")]
        share = self._database.part_weights[:, trunk].sum(axis=1)
        height = np.ptp(body.vertices[:, 2])
        middle = np.median(body.vertices[share > 0.9], axis=0)
        across = (body.vertices[:, 0] - middle[0]) / 0.19
        up = (body.vertices[:, 2] - 0.61 * height) / 0.21
        inside = np.clip(1.0 - across**2 - up**2, 0.0, 1.0)
        front = np.clip((middle[1] - body.vertices[:, 1]) / 0.04, 0.0, 1.0)
        forward = 0.10 * share * front * inside**2 * (3.0 - 2.0 * inside)
        return Mesh(body.vertices - forward[:, None] * (0.0, 1.0, 0.0), body.faces)

    def _has_room(self, index: int, pose: Array) -> bool:
        shapes = self._shapes.take(np.array([index]))
        neutral, posed = (self._database.vertices(shapes, at)[0] for at in (None, pose[None]))
        return has_room(neutral, posed, self._database.faces)

    @cached_property
    def _leanest_first(self) -> NDArray[np.intp]:
        return np.argsort(self._database.sizes(self._shapes)[1], kind="stable")


def family_cases(bodies: TestBodies, count: int) -> Iterator[Case]:
    """Held-out bodies of the training family in held-out poses, at most 30."""
    for index in range(min(count, _POOL)):
        booth = SimulatedBooth(seed=index, sway_m=0.0)
        yield Case("family", f"test {index:02d}", bodies.body(index), booth)


def unlike_cases(model: BodyModel, count: int) -> Iterator[Case]:
    """Sculpted test bodies before sensors that err otherwise than the fit assumes, at most 40."""
    for index, body in enumerate(UnlikeBodies(model, "test").bodies(count)):
        booth = SimulatedBooth(seed=7000 + index)
        yield Case("unlike", f"test {index:02d}", body.mesh, booth, UnlikeSensor())


def other_cases(folder: Path) -> Iterator[Case]:
    """Bodies of other families, each straight, shifted and turned."""
    for path in sorted(folder.glob("*.npz")):
        data = np.load(path)
        for name, turn_deg, shift in (
            ("straight", 0.0, (0.0, 0.0, 0.0)),
            ("shifted", 0.0, (0.2, 0.05, 0.0)),
            ("turned", 25.0, (0.0, 0.0, 0.0)),
        ):
            vertices = data["vertices"] @ so3_exp([0, 0, np.radians(turn_deg)]).T + shift
            body = Mesh(vertices, data["faces"].astype(np.int32))
            booth = SimulatedBooth(seed=3, sway_m=0.0)
            yield Case("other", f"{path.stem} {name}", body, booth)


def hard_cases(bodies: TestBodies) -> Iterator[Case]:
    """Difficult scans as they occur in a shop."""
    body = bodies.body(0)
    centers = body.vertices[body.faces].mean(axis=1)[:, 2]
    low, high = np.quantile(centers, [0.42, 0.52])
    dark = (centers > 0.97 * body.vertices[:, 2].max()) | ((centers > low) & (centers < high))
    day = SimulatedBooth(seed=5)
    knocked = np.radians(0.3)
    for name, mesh, booth in (
        ("no front-upper", body, replace(day, dead_cameras=("front-upper",))),
        ("no back-lower", body, replace(day, dead_cameras=("back-lower",))),
        ("a fifth dropped", body, replace(day, drop_rate=0.2)),
        ("camera 5 mm off", body, replace(day, moved_cameras={"back-upper": bumped(0.005, 0.0)})),
        (
            "camera 0.3 deg off",
            body,
            replace(day, moved_cameras={"back-lower": bumped(0.0, knocked)}),
        ),
        ("dark hair and briefs", Mesh(body.vertices, body.faces, dark), day),
        ("sway 10 mm", body, replace(day, sway_m=0.01)),
        ("patterns overlap", body, replace(day, violations=frozenset({INTERFERENCE}))),
        ("chair and walls", body, replace(day, clutter=chair((0.75, 0.45)))),
        ("arms close", bodies.arms_close, day),
        ("pregnant", bodies.pregnant, day),
        ("1.45 m", scaled(body, 1.45), day),
        ("2.05 m", scaled(body, 2.05), day),
    ):
        yield Case("hard", name, mesh, booth)


def rig_cases(body: Mesh) -> Iterator[Case]:
    """The same body seen by 2 to 8 cameras."""
    for count in (2, 4, 6, 8):
        booth = SimulatedBooth(rig=rig_of(count), seed=5, sway_m=0.0)
        yield Case("rig", f"{count} cameras", body, booth)


def bad_cases(body: Mesh) -> Iterator[Case]:
    """Input that does not show one whole adult: none of it may become a body that is trusted."""
    day = SimulatedBooth(seed=5)
    centers = body.vertices[body.faces].mean(axis=1)
    middle = 0.5 * np.ptp(body.vertices[:, 2])
    for name, mesh, booth in (
        ("child of 1.05 m", scaled(body, 1.05), day),
        ("upper half", Mesh(body.vertices, body.faces[centers[:, 2] > middle]), day),
        ("lower half", Mesh(body.vertices, body.faces[centers[:, 2] < middle]), day),
        ("left half", Mesh(body.vertices, body.faces[centers[:, 0] > 0.0]), day),
        ("chair alone", None, replace(day, clutter=chair((0.0, 0.0)))),
        ("empty booth", None, day),
    ):
        yield Case("bad", name, mesh, booth)


def bad_clouds(body: Mesh) -> Iterator[tuple[str, PointCloud]]:
    """Clouds that hold no body, or no numbers."""
    good = sampled(body, 50_000)
    holed = good.points.copy()
    holed[1000] = np.nan
    rng = np.random.default_rng(1)
    fog = rng.uniform((-0.4, -0.3, 0.0), (0.4, 0.3, 1.8), good.points.shape)
    wardrobe = sampled(box((-0.4, -0.3, 0.0), (0.4, 0.3, 1.8)), 50_000)
    yield "no points", _with_points(good, good.points[:0])
    yield "NaN", _with_points(good, holed)
    yield "millimetres", _with_points(good, 1e3 * good.points)
    yield "lying down", _with_points(good, good.points[:, [0, 2, 1]])
    yield "feet up", _with_points(good, good.points * (1, -1, -1) + (0, 0, 1.8))
    yield "a wardrobe", wardrobe
    yield "fog", _with_points(good, fog)


def _with_points(cloud: PointCloud, points: Array) -> PointCloud:
    """Other points, at most as many, with the normals as they come."""
    count = len(points)
    return replace(
        cloud,
        points=points,
        normals=cloud.normals[:count],
        sigma_m=cloud.sigma_m[:count],
        camera=cloud.camera[:count],
    )


def sampled(body: Mesh, count: int) -> PointCloud:
    """About so many points of a body's surface above the soles, with 1 mm of noise."""
    o3d.utility.random.seed(count)
    vertices, faces = body.vertices, body.faces
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
    )
    mesh.compute_triangle_normals()
    cloud = mesh.sample_points_uniformly(count, use_triangle_normal=True)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    above = points[:, 2] > 0.012
    points, normals = points[above], normals[above]
    noise = 1e-3 * np.random.default_rng(count).standard_normal((len(points), 1))
    return PointCloud(
        points=points + noise * normals,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        sigma_m=np.full(len(points), 1e-3),
        camera=np.zeros(len(points), np.int16),
        camera_names=("cloud",),
    )


def on_the_mark(vertices: Array, faces: NDArray[np.int32]) -> Mesh:
    """A body moved level, its middle to where a person should stand."""
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return Mesh(vertices - (middle[0], middle[1], 0.0), faces)


def scaled(body: Mesh, stature_m: float) -> Mesh:
    return Mesh(body.vertices * (stature_m / np.ptp(body.vertices[:, 2])), body.faces)


def rig_of(count: int) -> Rig:
    """The usual four; two upright ones, front and back; or columns of two all around the mark."""
    usual = default_rig()
    if count == len(usual.cameras):
        return usual
    if count == 2:
        quarter = rigid(so3_exp([0.0, 0.0, 0.5 * np.pi]), np.zeros(3))
        places = {
            name: look_at((0.3 * side, 1.95 * side, 1.0), (0.0, 0.0, 0.95)) @ quarter
            for name, side in (("front", -1.0), ("back", 1.0))
        }
    else:
        columns = count // 2
        angles = -0.5 * np.pi + 2.0 * np.pi * np.arange(columns) / columns
        places = {
            f"{row}-{index}": look_at((1.7 * np.cos(a), 1.7 * np.sin(a), eye), (0.0, 0.0, target))
            for index, a in enumerate(angles)
            for row, eye, target in (("lower", 0.66, 0.58), ("upper", 1.56, 1.47))
        }
    example = next(iter(usual.cameras.values()))
    cameras = {
        name: replace(example, name=name, serial=f"V{index:08d}", world_from_camera=pose)
        for index, (name, pose) in enumerate(places.items(), start=1)
    }
    return Rig(usual.created, next(iter(cameras)), cameras, 0.0)
