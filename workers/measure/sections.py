"""Plane sections of a mesh and the tape around them (pure geometry, metres)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]
Faces = NDArray[np.int32]


def section_points(vertices: Array, faces: Faces, point: Array, normal: Array) -> Array:
    """Where the edges of triangles (k, 3) cross a plane, (n, 3)."""
    distance = (vertices - point) @ normal
    corner = distance[faces]
    tail, head = faces, np.roll(faces, -1, axis=1)
    crossing = (corner < 0) != (np.roll(corner, -1, axis=1) < 0)
    a, b = tail[crossing], head[crossing]
    share = distance[a] / (distance[a] - distance[b])
    return np.asarray(vertices[a] + share[:, None] * (vertices[b] - vertices[a]))


def hull_loop(points: Array, normal: Array) -> Array:
    """The convex hull (m, 3) of points in a plane, in order: the way of a tight tape.

    Raises:
        ValueError: fewer than three points, or all on a line.
    """
    x = np.cross(normal, (0.0, 1.0, 0.0) if abs(normal[1]) < 0.9 else (1.0, 0.0, 0.0))
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    if len(points) < 3:
        raise ValueError("the plane does not cut this part of the body")
    try:
        hull = ConvexHull(np.stack([points @ x, points @ y], axis=1))
    except QhullError:
        raise ValueError("the plane does not cut this part of the body") from None
    return np.asarray(points[hull.vertices])


def loop_length(points: Array, *, closed: bool) -> float:
    """Length of a polyline (n, 3)."""
    steps = np.diff(points, axis=0, append=points[:1]) if closed else np.diff(points, axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def surface_path(vertices: Array, faces: Faces, start: Array, end: Array, outward: Array) -> Array:
    """From start to end over the surface, (n, 3): a tape in the plane of both and of `outward`.

    The section's points beyond the straight line, bridged where they are hollow.
    """
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    normal = np.cross(along, outward)
    normal /= np.linalg.norm(normal)
    up = np.cross(normal, along)
    points = section_points(vertices, faces, start, normal) - start
    x, y = points @ along, points @ up
    near = (x > 0) & (x < length) & (y > -0.02) & (y < 0.08)
    chain = sorted({(0.0, 0.0), (length, 0.0), *zip(x[near], y[near], strict=True)})
    hull: list[tuple[float, float]] = []
    for candidate in chain:
        while len(hull) >= 2 and _turns_left(hull[-2], hull[-1], candidate):
            hull.pop()
        hull.append(candidate)
    return np.array([start + px * along + py * up for px, py in hull])


def _turns_left(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) >= 0
