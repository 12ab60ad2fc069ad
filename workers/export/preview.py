"""preview.png: front, side and back of the body with the main measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import so3_exp
from station.core.words.terms import plain_name
from workers.measure.body import Measurement
from workers.pictures.render import (
    BACKGROUND,
    Color,
    Frame,
    Picture,
    Rendering,
    Scene,
    draw_line,
    png,
    text_width,
    write_text,
)
from workers.scape.verdict.verdict import Verdict

Array = NDArray[np.float64]

_SHOWN: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "front": (
        ("height", "neck_girth", "wrist_girth_right", "crotch_height", "knee_girth_right"),
        ("chest_girth", "waist_girth", "hip_girth", "thigh_girth_left", "calf_girth_left"),
    ),
    "side": (
        ("head_girth", "underbust_girth", "high_hip_girth", "mid_thigh_girth_left"),
        ("upper_arm_girth_left", "arm_length_left", "ankle_girth_left"),
    ),
    "back": (
        ("shoulder_width", "forearm_length_left"),
        ("across_back_width", "back_waist_length", "elbow_girth_right"),
    ),
}
"""View -> rows named on its left and on its right; a row that was not measured is left out."""
_BODY_PIXELS = 520
_BORDER = 26
_STRIP = 34
"""Height of the strip below the bodies, for the scan's id and the reasons to scan again."""
_GAP = 14
_LINE_GAP = 24
_SIZE = 15
_LINE: Color = (48, 56, 196)
_HIDDEN: Color = (168, 172, 206)
_LEADER: Color = (176, 172, 168)
_WARNING: Color = (40, 60, 170)
_FLOOR: Color = (226, 224, 222)
_BEHIND_M = 0.012
"""Depth behind the skin at which a girth's line counts as hidden: it is on the far side."""
_BENEATH_M = 0.06
"""The same for straight distances, which run beneath the skin on the near side too."""
_STATURE_GAP = 16


@dataclass(frozen=True, slots=True)
class Views:
    """A body drawn from the sides that the preview shows."""

    turn: Array
    """(3, 3): from the world to a body that faces -y; applied from the right."""
    frames: list[Frame]
    renderings: list[Rendering]


def views_of(vertices: Array, faces: NDArray[np.int32], heading_rad: float = 0.0) -> Views:
    """Draw a body (P, 3), without measurements.

    Args:
        heading_rad: rotation of the body about z from -y.
    """
    turn = so3_exp(np.array([0.0, 0.0, heading_rad]))
    vertices = vertices @ turn
    frames = [_frame(vertices, view) for view in _SHOWN]
    with ThreadPoolExecutor(2) as pool:
        return Views(turn, frames, list(pool.map(Scene(vertices, faces).render, frames)))


def preview(
    views: Views,
    measurements: Sequence[Measurement],
    verdict: Verdict,
    about: Mapping[str, str] | None = None,
) -> bytes:
    """Picture of a body and its measurements as PNG.

    Args:
        about: texts that the PNG carries as iTXt chunks; its scan_id is written on the picture.
    """
    about = about or {}
    by_name = {row.name: replace(row, path=row.path @ views.turn) for row in measurements}
    panels = [
        _panel(frame, rendering, _rows(by_name, left), _rows(by_name, right))
        for frame, rendering, (left, right) in zip(
            views.frames, views.renderings, _SHOWN.values(), strict=True
        )
    ]
    picture = np.concatenate(panels, axis=1)
    strip = np.full((_STRIP, picture.shape[1], 3), BACKGROUND, np.uint8)
    scan_id = about.get("scan_id", "")
    end = picture.shape[1] - 20 - text_width(scan_id, size=_SIZE)
    # Pictures of two people lie in one fitting room.
    write_text(strip, scan_id, (end, 20), size=_SIZE, color=_LEADER)
    if verdict.status != "ok":
        words = _shortened("scan again: " + "; ".join(verdict.reasons), end - 40)
        write_text(strip, words, (20, 20), size=_SIZE, color=_WARNING)
    return png(np.concatenate([picture, strip], axis=0), about)


def _rows(by_name: dict[str, Measurement], names: tuple[str, ...]) -> list[Measurement]:
    return [by_name[name] for name in names if name in by_name]


def _label(row: Measurement) -> str:
    return f"{plain_name(row.name)}  {100 * row.value_m:.1f} cm"


def _frame(vertices: Array, view: str) -> Frame:
    """Frame of the whole body, with room for the line of its stature."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = float(high[2] - low[2]) / _BODY_PIXELS
    across = float(np.ptp(vertices[:, 0 if view != "side" else 1]))
    x, y, z = (float(value) for value in 0.5 * (low + high))
    room = 2 * (_STATURE_GAP + 4)
    return Frame(view, int(across / scale) + room, _BODY_PIXELS + 2 * _BORDER, scale, (x, y, z))


def _panel(
    frame: Frame, rendering: Rendering, left: list[Measurement], right: list[Measurement]
) -> Picture:
    """One view with its labels beside the body."""
    columns = [max((text_width(_label(row), size=_SIZE) for row in rows), default=0) + 2 * _GAP
               for rows in (left, right)]  # fmt: skip
    picture = np.full((frame.height, sum(columns) + frame.width, 3), BACKGROUND, np.uint8)
    floor = frame.height - _BORDER
    picture[floor : floor + 2] = _FLOOR
    inner = picture[:, columns[0] : columns[0] + frame.width]
    inner[:] = np.where(rendering.picture < BACKGROUND, rendering.picture, inner)
    for rows, at_left in ((left, True), (right, False)):
        ends = []
        for row in rows:
            line = _drawn(picture, row, frame, rendering, columns[0])
            outermost = line[:, 0].argmin() if at_left else line[:, 0].argmax()
            ends.append(line[outermost])
        _write_labels(picture, rows, np.array(ends), columns, at_left=at_left)
    return picture


def _drawn(
    picture: Picture, row: Measurement, frame: Frame, rendering: Rendering, shift: int
) -> Array:
    """Draw a measurement's line, paler where the body hides it; returns it in the picture."""
    path = np.concatenate([row.path, row.path[:1]]) if row.closed else row.path
    if row.name == "height":
        return _drawn_stature(picture, path, frame, shift)
    path = _finely(path, 2.0 * frame.meters_per_pixel)
    line = frame.pixels(path)
    u, v = np.rint(line).astype(int).T
    u, v = np.clip(u, 0, frame.width - 1), np.clip(v, 0, frame.height - 1)
    behind = _BEHIND_M if row.closed else _BENEATH_M
    hidden = frame.depths(path) > rendering.depth_m[v, u] + behind
    line = line + np.array([shift, 0.0])
    for start, end in _runs(hidden):
        piece = line[start : min(end + 1, len(line))]
        if not (hidden[start] and row.closed):
            draw_line(picture, piece, _HIDDEN if hidden[start] else _LINE)
    return line


def _drawn_stature(picture: Picture, path: Array, frame: Frame, shift: int) -> Array:
    """Draw the stature beside the body, between two ticks."""
    line = frame.pixels(path) + np.array([shift, 0.0])
    line[:, 0] = shift + 4.0
    draw_line(picture, line, _LINE)
    for end in line:
        draw_line(picture, end + np.array([[-5.0, 0.0], [5.0, 0.0]]), _LINE)
    return np.asarray(line.mean(axis=0, keepdims=True))


def _finely(path: Array, step: float) -> Array:
    """Line with points every `step` metres, each of which is seen or hidden."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = np.linspace(0.0, along[-1], max(2, int(along[-1] / step)))
    return np.stack([np.interp(wanted, along, path[:, i]) for i in range(3)], axis=1)


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Ranges of equal values: first index, index after the last."""
    changes = np.flatnonzero(np.diff(mask.astype(np.int8))) + 1
    borders = [0, *changes.tolist(), len(mask)]
    return list(pairwise(borders))


def _write_labels(
    picture: Picture,
    rows: list[Measurement],
    ends: Array,
    columns: list[int],
    *,
    at_left: bool,
) -> None:
    """Write names and values in a column beside the body, each with a thin line to its place."""
    if not rows:
        return
    order = np.argsort(ends[:, 1], kind="stable")
    heights = _spread(ends[order, 1], _LINE_GAP, _LINE_GAP, picture.shape[0] - _BORDER - 6.0)
    for index, height in zip(order, heights, strict=True):
        text = _label(rows[index])
        width = text_width(text, size=_SIZE)
        edge = columns[0] - _GAP if at_left else picture.shape[1] - columns[1] + _GAP
        knee = edge + (6.0 if at_left else -6.0)
        leader = np.array([[knee, height], ends[index]])
        draw_line(picture, leader, _LEADER, thickness=1)
        at = (int(edge - width if at_left else edge), int(height + 5))
        write_text(picture, text, at, size=_SIZE)


def _spread(wanted: Array, gap: float, low: float, high: float) -> Array:
    """Sorted positions close to the wanted ones, at least a gap apart, between low and high."""
    placed = wanted.copy()
    for index in range(len(placed)):
        placed[index] = max(placed[index], low if index == 0 else placed[index - 1] + gap)
    limit = high
    for index in range(len(placed))[::-1]:
        placed[index] = min(placed[index], limit)
        limit = placed[index] - gap
    return np.asarray(placed)


def _shortened(text: str, width: int) -> str:
    """Text, shortened to a width in pixels."""
    if text_width(text, size=_SIZE) <= width:
        return text
    while text and text_width(text + " …", size=_SIZE) > width:
        text = text[:-1]
    return text + " …"
