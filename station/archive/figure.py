"""A result's body drawn flat with every measured line on it, for paper. Pure but for reading."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from station.archive.surfaces import Array, Surface
from station.core.geometry import so3_exp

Side = Literal["front", "left", "back"]
VIEWS: tuple[Side, ...] = ("front", "left", "back")
_TURNS = {"front": 0.0, "left": -90.0, "back": 180.0}
"""Degrees about the vertical by which the body is turned to be seen from there."""
PIXELS_PER_M = 420.0
_LIGHT = np.array([0.35, -0.8, 0.5])
_SKIN = np.array([214.0, 219.0, 226.0])
_BEHIND_M = 0.02
"""A line this far behind what is seen of the body is hidden by it."""
Line = list[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class View:
    """The body from one side; coordinates in metres, x to the right, z up."""

    side: Side
    picture: NDArray[np.uint8]
    """(h, w, 3) red, green, blue."""
    left_m: float
    top_m: float
    lines: Mapping[str, Sequence[Line]]
    """Measurement -> the pieces of its line that are seen from here."""
    whole: Mapping[str, Line]
    """Measurement -> its line, also where it runs through the body."""

    @property
    def width_m(self) -> float:
        return self.picture.shape[1] / PIXELS_PER_M

    @property
    def height_m(self) -> float:
        return self.picture.shape[0] / PIXELS_PER_M


def heading_rad(result: Path) -> float:
    """Angle by which the person stood turned from the front, about the vertical."""
    try:
        twist = json.loads((result / "result.json").read_bytes())["pose"]["pelvis"]
    except (OSError, ValueError, KeyError):
        return 0.0
    forward = -so3_exp(np.asarray(twist, np.float64))[:, 1]
    return float(np.arctan2(forward[0], -forward[1]))


def draw_views(surface: Surface, rows: Sequence[Mapping[str, Any]], turn_rad: float) -> list[View]:
    """The body from the front, its left and the back, with what is seen of each line."""
    return [_view(surface, rows, side, np.radians(_TURNS[side]) - turn_rad) for side in VIEWS]


def _view(
    surface: Surface, rows: Sequence[Mapping[str, Any]], side: Side, angle_rad: float
) -> View:
    turn = _about_z(angle_rad)
    points = surface.vertices @ turn.T
    low, high = points.min(axis=0) - 0.02, points.max(axis=0) + 0.02
    size = ((high - low)[[2, 0]] * PIXELS_PER_M).astype(int) + 1
    pixels = (points[:, [0, 2]] - [low[0], high[2]]) * [PIXELS_PER_M, -PIXELS_PER_M]
    picture, depth = _painted(surface, points, pixels, (int(size[0]), int(size[1])))
    lines, whole = {}, {}
    for row in rows:
        path = np.asarray(row["path"], np.float64).reshape(-1, 3) @ turn.T
        if row["closed"] and len(path):
            path = np.vstack([path, path[:1]])
        spots = (path[:, [0, 2]] - [low[0], high[2]]) * [PIXELS_PER_M, -PIXELS_PER_M]
        column = np.clip(spots[:, 0].astype(int), 0, picture.shape[1] - 1)
        line = np.clip(spots[:, 1].astype(int), 0, picture.shape[0] - 1)
        seen = path[:, 1] < depth[line, column] + _BEHIND_M
        lines[str(row["name"])] = _pieces(path, seen)
        whole[str(row["name"])] = [(float(x), float(z)) for x, _, z in path]
    return View(side, picture, float(low[0]), float(high[2]), lines, whole)


def _about_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _painted(
    surface: Surface, points: Array, pixels: Array, size: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """The shaded body, painted from back to front, and its depth (the viewer is at -y)."""
    picture = np.full((*size, 3), 255, np.uint8)
    depth = np.full(size, np.inf, np.float32)
    corners = points[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    towards = np.flatnonzero(normals[:, 1] < 0)
    far = corners[towards, :, 1].mean(axis=1)
    shade = 0.62 + 0.38 * np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    colours = shade[:, None] * _SKIN
    triangles = np.round(pixels[surface.faces]).astype(np.int32)
    for index in towards[np.argsort(-far)]:
        cv2.fillConvexPoly(picture, triangles[index], colours[index].tolist(), cv2.LINE_AA)
        cv2.fillConvexPoly(depth, triangles[index], float(corners[index, :, 1].mean()))
    return picture, depth


def _pieces(path: Array, seen: NDArray[np.bool_]) -> list[Line]:
    """The stretches of a path that are seen."""
    pieces: list[Line] = []
    for (x, _, z), visible, before in zip(path, seen, [False, *seen][: len(seen)], strict=True):
        if not visible:
            continue
        if not before:
            pieces.append([])
        pieces[-1].append((float(x), float(z)))
    return [piece for piece in pieces if len(piece) > 1]
