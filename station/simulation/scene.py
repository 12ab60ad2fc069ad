"""A virtual booth: bodies, floor, walls and objects seen by ray casting (open3d, no display)."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import ArrayLike, NDArray

from station.core.depth.correction import DepthCorrection
from station.core.errors import InputError
from station.core.geometry import rigid, transform
from station.core.lens import rays as lens_rays
from station.core.rig import CameraCalibration, Rig
from station.simulation.interference import BASELINE_M, Projector
from station.simulation.noise import Image, TrueView

Array = NDArray[np.float64]
Triangles = NDArray[np.int32]

WIDTH, HEIGHT = 640, 480
FOCAL_PX = 585.0
_WALL_DISTANCE_M = 2.1
_SHADOW_TOLERANCE_M = 0.01
_BUMP_M = 0.1
_BUMP_WAVES = 100
_BUMP_HALVINGS = 6
"""Halvings of a box's edges: a floor's triangles come to 66 mm."""
_FINE_VERTICES = 100
"""A mesh of fewer has not been subdivided yet."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """A surface: vertices (n, 3) in metres, world frame; faces (k, 3)."""

    vertices: Array
    faces: Triangles
    dark: NDArray[np.bool_] | None = None
    """(k,): triangles that give no reading (dark hair, underwear)."""


def load_mesh(path: Path) -> Mesh:
    """A body from .npz (vertices, faces), .ply or .obj, in metres.

    Raises:
        InputError: naming the file and what is wrong with it.
    """
    if not path.is_file():
        raise InputError(f"{path} is not a file; give a mesh: .npz, .ply or .obj")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                vertices = archive["vertices"].astype(np.float64)
                faces = archive["faces"].astype(np.int32)
        else:
            # Its own warnings would stand before the error that says what to do.
            with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
                mesh = o3d.io.read_triangle_mesh(str(path))
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int32)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as cause:
        raise InputError(
            f"{path} cannot be read as a mesh ({cause}); give .npz, .ply or .obj"
        ) from None
    if vertices.ndim != 2 or not len(faces) or not np.isfinite(vertices).all():
        raise InputError(f"{path} holds no usable mesh; give .npz, .ply or .obj in metres")
    if not 0.05 < np.ptp(vertices, axis=0).max() < 10.0:
        size = np.ptp(vertices, axis=0).max()
        raise InputError(f"{path} is {size:.3g} m large; a body in metres was expected")
    return Mesh(vertices, faces)


def sphere(center_m: ArrayLike, radius_m: float) -> Mesh:
    """A ball."""
    shape = o3d.geometry.TriangleMesh.create_sphere(radius_m, 40)
    return Mesh(
        np.asarray(shape.vertices) + np.asarray(center_m), np.asarray(shape.triangles, np.int32)
    )


def box(low_m: Sequence[float], high_m: Sequence[float]) -> Mesh:
    """An upright box: a wall, a stool, a shelf."""
    size = np.subtract(high_m, low_m)
    shape = o3d.geometry.TriangleMesh.create_box(*size)
    return Mesh(np.asarray(shape.vertices) + low_m, np.asarray(shape.triangles, np.int32))


def uneven(flat: Mesh, axis: int, sigma_m: float, rng: np.random.Generator) -> Mesh:
    """A floor or a board that is off flat by a standard deviation along an axis, in soft bumps.

    Heights are Gaussian, and so is their correlation, which falls to 0.6 over 0.1 m.
    """
    if sigma_m == 0.0:
        return flat
    shape = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(flat.vertices), o3d.utility.Vector3iVector(flat.faces)
    ).subdivide_midpoint(_BUMP_HALVINGS)
    vertices = np.asarray(shape.vertices).copy()
    waves = rng.normal(0.0, 1.0 / _BUMP_M, (2, _BUMP_WAVES))
    phases = rng.uniform(0.0, 2.0 * np.pi, _BUMP_WAVES)
    across = np.delete(vertices, axis, axis=1)
    vertices[:, axis] += (
        sigma_m * np.sqrt(2.0 / _BUMP_WAVES) * np.cos(across @ waves + phases).sum(1)
    )
    return Mesh(vertices, np.asarray(shape.triangles, np.int32))


def bent(flat: Mesh, height_m: Callable[[Array, Array], Array]) -> Mesh:
    """A floor raised by a height over x, y (metres)."""
    shape = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(flat.vertices), o3d.utility.Vector3iVector(flat.faces)
    )
    if len(flat.vertices) < _FINE_VERTICES:
        shape = shape.subdivide_midpoint(_BUMP_HALVINGS)
    vertices = np.asarray(shape.vertices).copy()
    vertices[:, 2] += height_m(vertices[:, 0], vertices[:, 1])
    return Mesh(vertices, np.asarray(shape.triangles, np.int32))


def rod(start_m: Sequence[float], end_m: Sequence[float], radius_m: float) -> Mesh:
    """A round rod: a stick, an arm."""
    start, end = np.asarray(start_m, float), np.asarray(end_m, float)
    length = float(np.linalg.norm(end - start))
    shape = o3d.geometry.TriangleMesh.create_cylinder(radius_m, length, 16, 1)
    z = (end - start) / length
    x = np.cross(z, (0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0))
    x /= np.linalg.norm(x)
    world_from_rod = rigid(np.stack([x, np.cross(z, x), z], axis=1), 0.5 * (start + end))
    return Mesh(
        transform(world_from_rod, np.asarray(shape.vertices)), np.asarray(shape.triangles, np.int32)
    )


def booth_walls() -> tuple[Mesh, ...]:
    """Floor and three walls; the fourth side is the entrance."""
    far = _WALL_DISTANCE_M
    return (
        box((-far, -far, -0.05), (far, far, 0.0)),
        box((-far - 0.05, -far, 0.0), (-far, far, 2.4)),
        box((-far, far, 0.0), (far, far + 0.05, 2.4)),
        box((-far, -far - 0.05, 0.0), (far, -far, 2.4)),
    )


def fixed_posts() -> tuple[Mesh, ...]:
    """Square posts behind the cameras, on which these hang: each camera sees those opposite."""
    half = 0.04
    return tuple(
        box((x - half, y - half, 0.0), (x + half, y + half, 2.2))
        for x in (-0.45, 0.45)
        for y in (-1.75, 1.75)
    )


def chair(at_m: tuple[float, float]) -> tuple[Mesh, ...]:
    """A stool with a back, at a place on the floor."""
    x, y = at_m
    return (
        box((x - 0.2, y - 0.2, 0.42), (x + 0.2, y + 0.2, 0.46)),
        box((x - 0.2, y + 0.17, 0.46), (x + 0.2, y + 0.2, 0.9)),
        *(
            rod((x + dx, y + dy, 0.0), (x + dx, y + dy, 0.42), 0.02)
            for dx in (-0.17, 0.17)
            for dy in (-0.17, 0.17)
        ),
    )


def look_at(eye_m: Sequence[float], target_m: Sequence[float]) -> Array:
    """world_from_camera (4, 4) of an upright camera (OpenCV axes)."""
    eye = np.asarray(eye_m, float)
    forward = np.asarray(target_m, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return rigid(np.stack([right, down, forward], axis=1), eye)


def default_rig() -> Rig:
    """Four Kinects 1.7 m from the mark, two in front and two behind, each seeing half the height.

    They stand a little to either side, so that the flanks are seen. Each field of view is 1.8 m
    wide (arms held off the trunk) and 1.3 m high; the halves overlap at the hips.
    """
    places = {
        "front-lower": ((0.45, -1.64, 0.66), (0.0, 0.0, 0.58)),
        "front-upper": ((-0.45, -1.64, 1.56), (0.0, 0.0, 1.47)),
        "back-lower": ((-0.45, 1.64, 0.66), (0.0, 0.0, 0.58)),
        "back-upper": ((0.45, 1.64, 1.56), (0.0, 0.0, 1.47)),
    }
    K = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]])
    cameras = {
        name: CameraCalibration(
            name=name,
            serial=f"V{index:08d}",
            model="kinect-v1",
            width=WIDTH,
            height=HEIGHT,
            K=K,
            distortion=np.zeros(5),
            depth_correction=DepthCorrection(),
            world_from_camera=look_at(eye, target),
            covariance=None,
        )
        for index, (name, (eye, target)) in enumerate(places.items(), start=1)
    }
    return Rig("2026-01-01T00:00:00Z", "front-upper", cameras, 0.0)


@dataclass
class VirtualScene:
    """Meshes that cameras look at."""

    meshes: Sequence[Mesh]
    _dark: NDArray[np.bool_] = field(init=False)
    _scene: o3d.t.geometry.RaycastingScene = field(init=False)

    def __post_init__(self) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = np.concatenate([mesh.vertices for mesh in self.meshes]).astype(np.float32)
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in self.meshes)])
        faces = np.concatenate(
            [mesh.faces + start for mesh, start in zip(self.meshes, starts, strict=False)]
        )
        self._scene.add_triangles(vertices, faces.astype(np.uint32))
        self._dark = np.concatenate(
            [
                np.zeros(len(mesh.faces), bool) if mesh.dark is None else mesh.dark
                for mesh in self.meshes
            ]
        )

    def view(
        self,
        camera: CameraCalibration,
        world_from_camera: Array,
        others: Collection[Projector] = (),
    ) -> TrueView:
        """The view of a perfect sensor with the camera's lens at a pose.

        Args:
            others: projectors of further sensors that shine, too.
        """
        height, width = camera.height, camera.width
        turned = lens_rays(camera).astype(np.float64) @ world_from_camera[:3, :3].T
        found = self._scene.cast_rays(_rays(world_from_camera[:3, 3], turned))
        # The rays have unit depth along the axis, so the parameter is the depth.
        depth = found["t_hit"].numpy()
        hit = np.isfinite(depth)
        depth = np.where(hit, depth, 0.0).astype(np.float32)
        normals = found["primitive_normals"].numpy()[hit]
        cosine = np.abs(np.einsum("ni,ni->n", normals, turned[hit])) / _lengths(turned[hit])
        incidence = np.zeros((height, width), np.float32)
        incidence[hit] = np.arccos(np.clip(cosine, 0, 1))
        lit, reflects = np.zeros_like(hit), np.ones_like(hit)
        lit[hit] = self._lit(world_from_camera, turned[hit] * depth[hit][:, None])
        reflects[hit] = ~self._dark[found["primitive_ids"].numpy()[hit]]
        foreign = None
        if others:
            foreign = np.zeros((height, width), np.float32)
            own = Projector(camera, world_from_camera)
            foreign[hit] = self._foreign(own, others, turned[hit] * depth[hit][:, None], normals)
        return TrueView(depth, incidence, lit, reflects, foreign)

    def _foreign(
        self, own: Projector, others: Collection[Projector], away: Array, normals: Array
    ) -> Image:
        """Light (n,) of other projectors on points (n, 3), from the camera, in shares of the own
        one's."""
        places = away + own.world_from_camera[:3, 3]
        outwards = normals * -np.sign(np.einsum("ni,ni->n", normals, away))[:, None]
        total = np.zeros(len(places))
        for other in others:
            light = other.brightness(places, outwards)
            reached = light > 0.0
            reached[reached] = self._reached(other.place_m, places[reached] - other.place_m)
            total += np.where(reached, light, 0.0)
        return own.in_shares(total, places, outwards)

    def _lit(self, world_from_camera: Array, away: Array) -> NDArray[np.bool_]:
        """Mask of the points (n, 3), from the camera, that its projector beside it reaches."""
        projector = transform(world_from_camera, (BASELINE_M, 0.0, 0.0))
        return self._reached(projector, away - (projector - world_from_camera[:3, 3]))

    def _reached(self, projector: Array, towards: Array) -> NDArray[np.bool_]:
        """Mask (n,) of the ways (n, 3) from a projector that nothing stands in."""
        short = towards * (1.0 - _SHADOW_TOLERANCE_M / _lengths(towards)[:, None])
        return ~self._scene.test_occlusions(_rays(projector, short), tfar=1.0).numpy()


def _rays(origin: Array, directions: Array) -> o3d.core.Tensor:
    """Rays from one point in directions (..., 3)."""
    rays = np.empty((*directions.shape[:-1], 6), np.float32)
    rays[..., :3], rays[..., 3:] = origin, directions
    return o3d.core.Tensor.from_numpy(rays)


def _lengths(vectors: Array) -> Array:
    """Lengths (n,) of vectors (n, 3); numpy's own take three times as long."""
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))


def bumped(shift_m: float, turn_rad: float) -> Array:
    """Twist (6,), rotation first, of a camera that somebody bumped into: shifted sideways and
    turned about its x axis."""
    return np.array((turn_rad, 0.0, 0.0, shift_m, 0.0, 0.0))


def astray(shift_m: float, turn_rad: float, rng: np.random.Generator) -> Array:
    """Twist (6,), rotation first, of these sizes in directions that the generator chooses."""
    turn, shift = rng.standard_normal((2, 3))
    turn *= turn_rad / np.linalg.norm(turn)
    shift *= shift_m / np.linalg.norm(shift)
    return np.concatenate([turn, shift])
