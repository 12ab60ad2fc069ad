"""Pictures of bodies without a display: ray casting (open3d), shading in numpy, text by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from workers.scape.deformation import vertex_normals

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Color = tuple[int, int, int]
"""Blue, green, red, as OpenCV has them."""

VIEWS = {
    "front": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "side": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
    "back": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
}
"""View -> (which world direction points right in the picture, where the camera looks)."""
BACKGROUND = 250
TEXT_COLOR: Color = (52, 48, 46)
_SKIN = (196.0, 208.0, 224.0)
_LIGHT = np.array([0.35, -0.35, 0.87])
_AWAY_M = 4.0
_EDGE_M = 0.025
"""A step in depth that shows as an edge, which is smoothed."""
_SUBPIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_BLOCK = 6
_FONT = "sans"


@dataclass(frozen=True, slots=True)
class Frame:
    """An upright parallel projection of the z-up world."""

    view: str
    width: int
    height: int
    meters_per_pixel: float
    center: tuple[float, float, float]
    """The world point in the picture's middle."""

    @property
    def right(self) -> Array:
        return np.array(VIEWS[self.view][0])

    @property
    def forward(self) -> Array:
        return np.array(VIEWS[self.view][1])

    def pixels(self, points: Array) -> Array:
        """Where points (n, 3) lie in the picture, (n, 2)."""
        offsets = points - np.array(self.center)
        u = offsets @ self.right / self.meters_per_pixel + 0.5 * (self.width - 1)
        v = 0.5 * (self.height - 1) - offsets[:, 2] / self.meters_per_pixel
        return np.stack([u, v], axis=1)

    def depths(self, points: Array) -> Array:
        """How far from the camera's plane points (n, 3) are, (n,) metres."""
        return (points - np.array(self.center)) @ self.forward + _AWAY_M

    def rays(self, pixels: Array) -> NDArray[np.float32]:
        """Rays (n, 6) through picture points (n, 2)."""
        u = (pixels[:, 0] - 0.5 * (self.width - 1)) * self.meters_per_pixel
        v = (0.5 * (self.height - 1) - pixels[:, 1]) * self.meters_per_pixel
        rays = np.empty((len(pixels), 6), np.float32)
        rays[:, :3] = (
            np.array(self.center)
            - _AWAY_M * self.forward
            + u[:, None] * self.right
            + v[:, None] * np.array([0.0, 0.0, 1.0])
        )
        rays[:, 3:] = self.forward
        return rays


@dataclass(frozen=True, slots=True)
class Rendering:
    """A picture (h, w, 3) and how far away what it shows is (h, w), infinite at the background."""

    picture: Picture
    depth_m: NDArray[np.float32]


class Scene:
    """A mesh, ready to be looked at from several sides."""

    def __init__(self, vertices: Array, faces: NDArray[np.int32]) -> None:
        """Vertices (P, 3), z up, and faces (K, 3), counter-clockwise seen from outside."""
        self._vertices, self._faces = vertices, faces
        self._normals = vertex_normals(vertices, faces)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
        )

    def render(self, frame: Frame, colors: Array | None = None) -> Rendering:
        """The mesh as a frame shows it, with smooth edges.

        Args:
            colors: (K, 3) of the triangles, blue, green and red up to 255; skin by default.
        """
        shape = (frame.height, frame.width)
        color = np.full((frame.height * frame.width, 3), float(BACKGROUND))
        depth = np.full(frame.height * frame.width, np.inf, np.float32)
        near = np.flatnonzero(_near(frame.pixels(self._vertices), self._faces, shape))
        color[near], depth[near] = self._seen(frame, _centers(near, frame.width), colors)
        edges = _edges(depth.reshape(shape))
        if len(edges):
            centers = _centers(edges, frame.width)
            around = np.concatenate([centers + np.array(aside) for aside in _SUBPIXELS])
            mixed, _ = self._seen(frame, around, colors)
            color[edges] = mixed.reshape(len(_SUBPIXELS), -1, 3).mean(axis=0)
        picture = np.clip(color + 0.5, 0, 255).astype(np.uint8)
        return Rendering(picture.reshape(*shape, 3), depth.reshape(shape))

    def _seen(
        self, frame: Frame, pixels: Array, colors: Array | None
    ) -> tuple[Array, NDArray[np.float32]]:
        """What is seen at picture points (n, 2): colours (n, 3) and depths (n,)."""
        found = self._scene.cast_rays(o3d.core.Tensor(frame.rays(pixels)))
        depth = found["t_hit"].numpy()
        hit = np.flatnonzero(np.isfinite(depth))
        triangle = found["primitive_ids"].numpy().ravel()[hit]
        uv = found["primitive_uvs"].numpy()[hit].astype(np.float64)
        share = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        normal = np.einsum("nk,nki->ni", share, self._normals[self._faces[triangle]])
        normal /= np.sqrt(np.einsum("ni,ni->n", normal, normal))[:, None] + 1e-12
        headlight = np.abs(normal @ frame.forward)
        shade = 0.34 + 0.46 * headlight + 0.20 * np.clip(normal @ _LIGHT, 0.0, 1.0)
        own = np.array(_SKIN) if colors is None else colors[triangle]
        color = np.full((len(pixels), 3), float(BACKGROUND))
        color[hit] = shade[:, None] * own
        return color, depth


def _centers(flat: NDArray[np.intp], width: int) -> Array:
    return np.stack([flat % width, flat // width], axis=1).astype(np.float64)


def _near(pixels: Array, faces: NDArray[np.int32], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Pixels (h, w) that a triangle can cover, and some more: no ray is cast at the others."""
    corners = [pixels[faces[:, i]] for i in range(3)]
    sides = [(corners[i], corners[i - 1]) for i in range(3)]
    # A triangle's vertices and its sides' middles: no point of it lies farther from all of them.
    farthest = 0.5 * float(max(np.abs(start - end).max() for start, end in sides))
    marks = np.concatenate([pixels, *(0.5 * (start + end) for start, end in sides)])
    height, width = -(-shape[0] // _BLOCK), -(-shape[1] // _BLOCK)
    blocks = np.zeros((height, width), np.uint8)
    u, v = np.floor_divide(marks, _BLOCK).astype(int).T
    blocks[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] = 1
    reach = 2 * int(np.ceil(farthest / _BLOCK)) + 1
    blocks = cv2.dilate(blocks, np.ones((reach, reach), np.uint8)).astype(np.uint8)
    return np.kron(blocks, np.ones((_BLOCK, _BLOCK), bool))[: shape[0], : shape[1]] > 0


def _edges(depth: NDArray[np.float32]) -> NDArray[np.intp]:
    """Flat indices of pixels beside which the depth steps."""
    near = np.where(np.isfinite(depth), depth, 10.0 * _AWAY_M).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.dilate(near, kernel) - cv2.erode(near, kernel)
    return np.flatnonzero(step.ravel() > _EDGE_M)


def render_mesh(
    vertices: Array,
    faces: NDArray[np.int32],
    view: str,
    *,
    width: int,
    height: int,
    meters_per_pixel: float,
    center: Array,
    colors: Array | None = None,
) -> Picture:
    """The picture alone, (height, width, 3)."""
    x, y, z = (float(value) for value in center)
    frame = Frame(view, width, height, meters_per_pixel, (x, y, z))
    return Scene(vertices, faces).render(frame, colors).picture


def draw_line(
    picture: Picture, line: Array, color: Color, *, thickness: int = 2, closed: bool = False
) -> None:
    """A smooth line through picture points (n, 2)."""
    fixed = np.rint(line * 16.0).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [fixed], closed, color, thickness, cv2.LINE_AA, shift=4)


def draw_points(picture: Picture, points: Array, colors: NDArray[np.uint8]) -> None:
    """Points (n, 2) as single pixels in colours (n, 3) or (3,); later ones lie on top."""
    u, v = np.rint(points).astype(int).T
    height, width = picture.shape[:2]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    picture[v[inside], u[inside]] = colors[inside] if colors.ndim == 2 else colors


def write_text(
    picture: Picture,
    text: str,
    at: tuple[int, int],
    *,
    size: int = 14,
    color: Color = TEXT_COLOR,
    bold: bool = False,
) -> None:
    """Text whose first letter stands at a picture point."""
    weight = 600 if bold else 400
    cv2.putText(picture, text, at, color, cv2.FontFace(_FONT), size, weight)


def text_width(text: str, *, size: int = 14, bold: bool = False) -> int:
    """How many pixels wide a text is."""
    weight = 600 if bold else 400
    box = cv2.getTextSize((4096, 256), text, (0, 128), cv2.FontFace(_FONT), size, weight)
    return int(box[2])


def png(picture: Picture) -> bytes:
    """The picture as a PNG file's content."""
    done, encoded = cv2.imencode(
        ".png", picture, [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    )
    assert done
    return bytes(encoded.tobytes())
