"""Pictures of the model, without a display: its first components, and a case beside its fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workers.pictures.render import Picture, png, render_mesh, write_text
from workers.scape.model.body_model import BodyModel

Array = NDArray[np.float64]

_METERS_PER_PIXEL = 0.005
_WIDTH, _HEIGHT = 330, 430
_CENTER_Z = 0.95
_WORST_SHOWN_M = 0.01
_GOOD, _BAD = np.array([215.0, 215.0, 215.0]), np.array([40.0, 40.0, 230.0])


def draw_components(model: BodyModel, count: int, path: Path) -> None:
    """The mean body and the first components at -3 and +3 standard deviations, front and side."""
    rows = []
    for component in range(count):
        row = []
        for deviations in (-3.0, 0.0, 3.0):
            beta = np.zeros(model.beta_count)
            beta[component] = deviations
            surface = model.neutral_surface(replace(model.neutral_state(), beta=beta))
            surface = surface - (0.0, 0.0, surface[:, 2].min())
            for view in ("front", "side"):
                row.append(_picture(model, surface, view))
            write_text(row[-2], f"component {component + 1}: {deviations:+.0f} sigma", (8, 16))
        rows.append(np.hstack(row))
    _write(path, np.vstack(rows))


def draw_case(model: BodyModel, truth: Array, fit: Array, title: str, path: Path) -> None:
    """A body, the model's fit to it, and where they differ (red: a centimetre and more)."""
    rows = []
    low = truth[:, 2].min()
    away = np.linalg.norm(fit - truth, axis=1)[model.faces].mean(axis=1)
    share = np.clip(away / _WORST_SHOWN_M, 0.0, 1.0)[:, None]
    colors = (1.0 - share) * _GOOD + share * _BAD
    for view in ("front", "side", "back"):
        shift = np.array([*truth[:, :2].mean(axis=0), low])
        pictures = [_picture(model, truth - shift, view), _picture(model, fit - shift, view)]
        pictures.append(_picture(model, truth - shift, view, colors))
        rows.append(np.hstack(pictures))
    write_text(rows[0], f"{title}: truth, fit, difference", (8, 16))
    _write(path, np.vstack(rows))


def _picture(model: BodyModel, vertices: Array, view: str, colors: Array | None = None) -> Picture:
    return render_mesh(
        vertices,
        model.faces,
        view,
        width=_WIDTH,
        height=_HEIGHT,
        meters_per_pixel=_METERS_PER_PIXEL,
        center=np.array([0.0, 0.0, _CENTER_Z]),
        colors=colors,
    )


def _write(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png(picture))
