"""A result beside the truth, coloured by its error: to be looked at, not only counted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from surface_errors import distances_m

from station.simulation.scene import Mesh
from workers.pictures.render import VIEWS, Frame, Scene, png, write_text

Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 430, 700
_GOOD, _BAD = np.array([225.0, 235.0, 225.0]), np.array([40.0, 40.0, 230.0])
_WORST_SHOWN_M = 0.010


def write_error_picture(
    path: Path, title: str, vertices: Array, faces: NDArray[np.int32], truth: Mesh
) -> None:
    """Above the true surface, red where the result is 10 mm off; below the result."""
    away = distances_m(vertices, faces, truth.vertices)[truth.faces].mean(axis=1)
    share = np.clip(away / _WORST_SHOWN_M, 0.0, 1.0)[:, None]
    colors = (1.0 - share) * _GOOD + share * _BAD
    low, high = truth.vertices.min(axis=0), truth.vertices.max(axis=0)
    extent = high - low
    scale = 1.08 * float(max(extent[2] / (_HEIGHT - 60), extent[:2].max() / _WIDTH))
    x, y, z = (float(value) for value in 0.5 * (low + high))
    frames = [Frame(view, _WIDTH, _HEIGHT, scale, (x, y, z)) for view in VIEWS]
    true_scene, found_scene = Scene(truth.vertices, truth.faces), Scene(vertices, faces)
    rows = [
        np.concatenate([true_scene.render(frame, colors).picture for frame in frames], axis=1),
        np.concatenate([found_scene.render(frame).picture for frame in frames], axis=1),
    ]
    picture = np.concatenate(rows, axis=0)
    write_text(picture, title, (14, 26), size=18)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png(picture))
