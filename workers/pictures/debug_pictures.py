"""Pictures of the stages of a fit, as --debug writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.core.files import private_folder
from workers.pictures.render import (
    BACKGROUND,
    VIEWS,
    Color,
    Frame,
    Picture,
    Rendering,
    Scene,
    draw_line,
    draw_points,
    png,
    text_width,
    write_text,
)
from workers.scape.fit.observer import Event

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 430, 700
_MARGIN = 1.08
_TITLE_SIZE = 18
_TITLE_AT = (14, 26)
_NAMES = {"front": "front", "side": "left side", "back": "back"}
"""Names of the views; the side that is drawn is the person's left one."""
_NAME_SIZE, _NAME_ABOVE = 15, 14
_ROUNDS_LEFT_OUT = 4
"""Rounds between two that are drawn, of one stage: neighbours look the same."""
_POINT = np.array([170, 90, 20], np.uint8)
_PAIR_NEAR, _PAIR_FAR = np.array([60.0, 160.0, 40.0]), np.array([40.0, 40.0, 220.0])
_FAR_PAIR_M = 0.05
_PAIRS_SHOWN = 2500
_POINTS_SHOWN = 30_000
_WORST_SHOWN_M = 0.003
_OUTSIDE, _INSIDE = np.array([60.0, 60.0, 235.0]), np.array([235.0, 120.0, 50.0])
_MET, _UNSEEN = np.array([225.0, 235.0, 225.0]), np.array([150.0, 150.0, 150.0])
_CLOSE_M = 0.01
_BARE_DARK, _BARE_LIGHT = 60.0, 200.0
_OVER = "blue: points of the scan (those inside or behind the body are hidden)"
_BODY_EVENTS = {
    "start": (2, f"start; {_OVER}"),
    "joint": (4, f"model fitted (pose and shape); {_OVER}"),
    "done": (6, f"result; {_OVER}"),
}
"""Stages that are drawn as the body with the cloud over it: number and title."""


def has_pictures(folder: Path) -> bool:
    """Whether a folder has pictures of a fit."""
    return any(folder.glob("[1-6]-*.png"))


class DebugPictures:
    """Observer of a fit that draws each stage from the front, the side and the back.

    Files in `folder`, in the order of the fit: 1-cloud.png, 2-start.png,
    3-correspondences-NN.png, 4-joint.png, 5-surface.png (an error map), 6-done.png. Correspondences
    are drawn of the first round of each stage of the fit, of every fifth of a long one,
    and of the last.
    """

    def __init__(self, folder: Path, faces: NDArray[np.int32]) -> None:
        self._folder = private_folder(folder)
        self._faces = faces
        self._rounds = self._drawn = 0
        self._gate_m = np.nan
        self._pairs: tuple[Array, Array, Array] | None = None
        self._points: Array = np.empty((0, 3))
        self._normals: Array = np.empty((0, 3))

    def __call__(self, event: Event, arrays: Mapping[str, NDArray[Any]]) -> None:
        if event == "cloud":
            self._points, self._normals = arrays["points"].copy(), arrays["normals"].copy()
            self._write("1-cloud", f"cloud: {len(self._points):,} points", self._bare)
            return
        if event == "correspondences":
            self._see_round(arrays)
            return
        self._draw_round()
        scene = Scene(arrays["vertices"], self._faces)
        if event == "surface":
            self._draw_errors(scene, arrays["residual_m"])
        else:
            number, title = _BODY_EVENTS[event]
            self._write(f"{number}-{event}", title, lambda frame: self._over(scene, frame))

    def _see_round(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._rounds += 1
        # Kept until the next: nobody says of a round that it is the last.
        vertices, on_body, on_cloud = (
            arrays[name].copy() for name in ("vertices", "on_body", "on_cloud")
        )
        self._pairs = vertices, on_body, on_cloud
        gate_m = float(arrays["gate_m"])
        if gate_m != self._gate_m or self._rounds - self._drawn > _ROUNDS_LEFT_OUT:
            self._gate_m = gate_m
            self._draw_round()

    def _draw_round(self) -> None:
        """Draw the pairs of the last round, once."""
        if self._pairs is None:
            return
        vertices, on_body, on_cloud = self._pairs
        self._pairs, self._drawn = None, self._rounds
        scene = Scene(vertices, self._faces)
        away = np.linalg.norm(on_cloud - on_body, axis=1)
        middle_mm = 1e3 * float(np.median(away)) if len(away) else float("nan")
        title = f"round {self._rounds}: {len(away):,} pairs, median {middle_mm:.1f} mm"
        title += f"; green: 0 mm, red: {1e3 * _FAR_PAIR_M:.0f} mm or more"
        name = f"3-correspondences-{self._rounds:02d}"
        self._write(name, title, lambda frame: _paired(scene, on_body, on_cloud, frame))

    def _draw_errors(self, scene: Scene, residual_m: Array) -> None:
        seen = residual_m[np.isfinite(residual_m)]
        rms_mm = 1e3 * float(np.sqrt(np.mean(seen**2))) if len(seen) else float("nan")
        limit = f"{1e3 * _WORST_SHOWN_M:.0f} mm"
        title = (
            f"error: rms {rms_mm:.2f} mm; points lie on the body: white, {limit} or more outside: "
        )
        title += "red, inside: blue; no points: dark grey"
        colors = self._error_colors(residual_m)
        self._write("5-surface", title, lambda frame: scene.render(frame, colors).picture)

    def _frame(self, view: str) -> Frame:
        low, high = np.quantile(self._points, [0.001, 0.999], axis=0)
        extent = high - low
        across = max(extent[0], extent[1])
        scale = _MARGIN * max(extent[2] / (_HEIGHT - 60), across / _WIDTH)
        x, y, z = (float(value) for value in 0.5 * (low + high))
        return Frame(view, _WIDTH, _HEIGHT, float(scale), (x, y, z + 15.0 * float(scale)))

    def _write(self, name: str, title: str, draw: Callable[[Frame], Picture]) -> None:
        picture = np.concatenate([draw(self._frame(view)) for view in VIEWS], axis=1)
        write_text(picture, title, _TITLE_AT, size=_TITLE_SIZE)
        for number, view in enumerate(VIEWS):
            left = int((number + 0.5) * _WIDTH - 0.5 * text_width(_NAMES[view], size=_NAME_SIZE))
            write_text(picture, _NAMES[view], (left, _HEIGHT - _NAME_ABOVE), size=_NAME_SIZE)
        (self._folder / f"{name}.png").write_bytes(png(picture))

    def _bare(self, frame: Frame) -> Picture:
        """Draw the points that face the camera, shaded by their normals."""
        picture = np.full((_HEIGHT, _WIDTH, 3), BACKGROUND, np.uint8)
        facing = -(self._normals @ frame.forward)
        shown = np.flatnonzero(facing > 0.0)
        shown = shown[np.argsort(-frame.depths(self._points[shown]))]
        grey = _BARE_DARK + (_BARE_LIGHT - _BARE_DARK) * facing[shown]
        colors = np.repeat(grey[:, None], 3, axis=1).astype(np.uint8)
        draw_points(picture, frame.pixels(self._points[shown]), colors)
        return picture

    def _over(self, scene: Scene, frame: Frame) -> Picture:
        """Draw the body and the points that it does not hide."""
        shown = scene.render(frame)
        facing = self._normals @ frame.forward < 0.0
        visible = np.flatnonzero(facing & _in_sight(self._points, frame, shown))
        thinned = visible[:: max(1, len(visible) // _POINTS_SHOWN)]
        draw_points(shown.picture, frame.pixels(self._points[thinned]), _POINT)
        return shown.picture

    def _error_colors(self, residual_m: Array) -> Array:
        """Colours (K, 3) by how far points lie outside (red) or inside (blue) each triangle."""
        known = np.isfinite(residual_m)
        value = np.where(known, residual_m, 0.0)[self._faces]
        count = known[self._faces].sum(axis=1)
        mean = value.sum(axis=1) / np.maximum(count, 1)
        share = np.clip(np.abs(mean) / _WORST_SHOWN_M, 0.0, 1.0)[:, None]
        side = np.where((mean > 0.0)[:, None], _OUTSIDE, _INSIDE)
        colors = (1.0 - share) * _MET + share * side
        colors[count == 0] = _UNSEEN
        return np.asarray(colors)


def _paired(scene: Scene, on_body: Array, on_cloud: Array, frame: Frame) -> Picture:
    """Draw the body and lines to the points of its correspondences: green near, red far."""
    shown = scene.render(frame)
    visible = np.flatnonzero(_in_sight(on_body, frame, shown))
    some = visible[:: max(1, len(visible) // _PAIRS_SHOWN)]
    starts, ends = frame.pixels(on_body[some]), frame.pixels(on_cloud[some])
    away = np.linalg.norm(on_cloud[some] - on_body[some], axis=1, keepdims=True)
    share = np.clip(away / _FAR_PAIR_M, 0.0, 1.0)
    colors = (1.0 - share) * _PAIR_NEAR + share * _PAIR_FAR
    for start, end, (blue, green, red) in zip(starts, ends, colors.astype(int), strict=True):
        color: Color = (int(blue), int(green), int(red))
        draw_line(shown.picture, np.stack([start, end]), color, thickness=1)
    draw_points(shown.picture, ends, colors.astype(np.uint8))
    return shown.picture


def _in_sight(points: Array, frame: Frame, shown: Rendering) -> NDArray[np.bool_]:
    """Mask (n,) of points that the body does not hide."""
    u, v = np.rint(frame.pixels(points)).astype(int).T
    depth = shown.depth_m[np.clip(v, 0, frame.height - 1), np.clip(u, 0, frame.width - 1)]
    return np.asarray(frame.depths(points) < depth + _CLOSE_M)
