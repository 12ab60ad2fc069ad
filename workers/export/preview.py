"""preview.png: front, side and back of the body with the main measurements."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from workers.measure.body import Measurement
from workers.render import draw_line, pixels, render_mesh, write_text

Array = NDArray[np.float64]

_SHOWN = {
    "front": ("height", "chest_girth", "waist_girth", "hip_girth", "shoulder_width"),
    "side": ("waist_girth",),
    "back": ("arm_length_left", "thigh_girth_right", "calf_girth_left", "back_waist_length"),
}
_SIZE = (360, 640)
_MARGIN = 1.12


def preview(
    vertices: Array, faces: NDArray[np.int32], measurements: Sequence[Measurement]
) -> bytes:
    """The picture as PNG."""
    width, height = _SIZE
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = high - low
    scale = _MARGIN * max(extent[2] / height, max(extent[0], extent[1]) / width)
    frame = {
        "width": width, "height": height, "meters_per_pixel": scale, "center": 0.5 * (low + high),
    }  # fmt: skip
    by_name = {measurement.name: measurement for measurement in measurements}
    columns = []
    for view, names in _SHOWN.items():
        picture = render_mesh(vertices, faces, view, **frame)
        for name in names:
            row = by_name[name]
            line = pixels(row.path, view, **frame)
            draw_line(picture, line, closed=row.closed)
            corner = int(min(line[:, 0].max() + 6, width - 120)), int(line[:, 1].mean())
            write_text(picture, f"{name.split('_')[0]} {100 * row.value_m:.1f} cm", corner)
        columns.append(picture)
    done, encoded = cv2.imencode(".png", np.concatenate(columns, axis=1))
    assert done
    return encoded.tobytes()
