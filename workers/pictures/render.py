"""Pictures of bodies without a display: a depth buffer, smooth shading, text by OpenCV."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from workers.pictures.raster import blended, nearest_triangles
from workers.scape.model.deformation import vertex_normals

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
"""Distance of the camera's plane from the middle of the world."""
_PNG_HEADER = 33
"""Length of a PNG's signature and its first chunk."""
_FONT, _WEIGHT = "sans", 400


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
        """Pixels (n, 2) of points (n, 3)."""
        offsets = points - np.array(self.center)
        u = offsets @ self.right / self.meters_per_pixel + 0.5 * (self.width - 1)
        v = 0.5 * (self.height - 1) - offsets[:, 2] / self.meters_per_pixel
        return np.stack([u, v], axis=1)

    def depths(self, points: Array) -> Array:
        """Distances (n,) of points (n, 3) from the camera's plane, metres."""
        return (points - np.array(self.center)) @ self.forward + _AWAY_M


@dataclass(frozen=True, slots=True)
class Rendering:
    """Picture (h, w, 3) and its depth (h, w) in metres, infinite at the background."""

    picture: Picture
    depth_m: NDArray[np.float32]


class Scene:
    """Mesh that is drawn from several sides."""

    def __init__(self, vertices: Array, faces: NDArray[np.int32]) -> None:
        """Vertices (P, 3), z up, and faces (K, 3), counter-clockwise seen from outside."""
        self._vertices, self._faces = vertices, faces
        self._normals = vertex_normals(vertices, faces)

    def render(self, frame: Frame, colors: Array | None = None) -> Rendering:
        """Draw the mesh with smooth edges.

        Args:
            colors: (K, 3) of the triangles, blue, green and red up to 255; skin by default.
        """
        headlight = np.abs(self._normals @ frame.forward)
        shade = 0.34 + 0.46 * headlight + 0.20 * np.clip(self._normals @ _LIGHT, 0.0, 1.0)
        u, v = frame.pixels(self._vertices).T
        depth = frame.depths(self._vertices)
        nearest, triangle, shown = nearest_triangles(
            u, v, depth, shade, self._faces, frame.height, frame.width
        )
        own = np.array([_SKIN]) if colors is None else np.asarray(colors, np.float64)
        return Rendering(*blended(nearest, triangle, shown, own, float(BACKGROUND)))


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
    """Picture (height, width, 3) of a mesh."""
    x, y, z = (float(value) for value in center)
    frame = Frame(view, width, height, meters_per_pixel, (x, y, z))
    return Scene(vertices, faces).render(frame, colors).picture


def draw_line(picture: Picture, line: Array, color: Color, *, thickness: int = 2) -> None:
    """Draw a smooth line through picture points (n, 2)."""
    fixed = np.rint(line * 16.0).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [fixed], False, color, thickness, cv2.LINE_AA, shift=4)


def draw_points(picture: Picture, points: Array, colors: NDArray[np.uint8]) -> None:
    """Draw points (n, 2) as single pixels in colours (n, 3) or (3,); later ones lie on top."""
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
) -> None:
    """Write text whose first letter is at a picture point."""
    cv2.putText(picture, text, at, color, cv2.FontFace(_FONT), size, _WEIGHT)


def text_width(text: str, *, size: int = 14) -> int:
    """Width of a text in pixels."""
    box = cv2.getTextSize((4096, 256), text, (0, 128), cv2.FontFace(_FONT), size, _WEIGHT)
    return int(box[2])


def png(picture: Picture, about: Mapping[str, str] = MappingProxyType({})) -> bytes:
    """Content of a PNG file, with texts as iTXt chunks under their names."""
    done, encoded = cv2.imencode(
        ".png", picture, [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    )
    assert done
    content = bytes(encoded.tobytes())
    chunks = b"".join(_text_chunk(name, text) for name, text in about.items() if text)
    return content[:_PNG_HEADER] + chunks + content[_PNG_HEADER:]


def _text_chunk(name: str, text: str) -> bytes:
    """iTXt chunk: keyword, not compressed, no language (PNG specification, 11.3.3.4)."""
    data = b"iTXt" + name.encode("ascii") + bytes(5) + text.encode()
    return struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))
