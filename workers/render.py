"""Pictures of meshes without a display: ray casting (open3d) and shading in numpy."""

from __future__ import annotations

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

VIEWS = {
    "front": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "side": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
    "back": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
}
"""View -> (which world direction points right in the picture, where the camera looks)."""
_LIGHT = np.array([0.35, -0.35, 0.87])
_SKIN = np.array([196, 208, 224], float)
_BACKGROUND = 250


def render_mesh(
    vertices: Array,
    faces: NDArray[np.int32],
    view: str,
    *,
    width: int,
    height: int,
    meters_per_pixel: float,
    center: Array,
) -> Picture:
    """An upright parallel projection (height, width, 3) of a mesh in the z-up world."""
    right, forward = (np.array(axis) for axis in VIEWS[view])
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    x = (np.arange(width) - 0.5 * (width - 1)) * meters_per_pixel
    z = (0.5 * (height - 1) - np.arange(height)) * meters_per_pixel
    rays = np.empty((height, width, 6), np.float32)
    rays[..., :3] = (
        center - 4.0 * forward + x[None, :, None] * right + z[:, None, None] * (0.0, 0.0, 1.0)
    )
    rays[..., 3:] = forward
    found = scene.cast_rays(o3d.core.Tensor(rays))
    hit = np.isfinite(found["t_hit"].numpy())
    normals = found["primitive_normals"].numpy()
    headlight = np.abs(normals @ forward)
    shade = 0.30 + 0.50 * headlight + 0.20 * np.clip(normals @ _LIGHT, 0.0, 1.0)
    picture = np.where(hit[..., None], shade[..., None] * _SKIN, _BACKGROUND)
    return np.clip(picture, 0, 255).astype(np.uint8)


def pixels(
    points: Array, view: str, *, width: int, height: int, meters_per_pixel: float, center: Array
) -> NDArray[np.int32]:
    """Where points (n, 3) lie in such a picture, (n, 2)."""
    right, _ = (np.array(axis) for axis in VIEWS[view])
    offsets = points - center
    u = offsets @ right / meters_per_pixel + 0.5 * (width - 1)
    v = 0.5 * (height - 1) - offsets[:, 2] / meters_per_pixel
    return np.rint(np.stack([u, v], axis=1)).astype(np.int32)


def draw_line(picture: Picture, line: NDArray[np.int32], *, closed: bool) -> None:
    """A measurement's line."""
    cv2.polylines(picture, [line.reshape(-1, 1, 2)], closed, (40, 60, 200), 2, cv2.LINE_AA)


def write_text(picture: Picture, text: str, at: tuple[int, int]) -> None:
    """A value beside its line."""
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA)
