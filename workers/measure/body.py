"""Measures a body in the template's topology by the table of definitions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.measure.definitions import DEFINITIONS, Definition
from workers.measure.sections import hull_loop, loop_length, section_points, surface_path
from workers.scape.deformation import Faces, vertex_normals
from workers.scape.model import BodyModel

Array = NDArray[np.float64]

_LANDMARK_SIGMA_M = 0.0035
"""How far a landmark slides along the skin between fits of the same body."""
_RADIUS_SIGMA_SHARE = 0.5
"""Share of the vertices' deviations that neighbours on one girth have in common."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One value with the line that was measured."""

    name: str
    standard: str
    value_m: float
    interval95_m: tuple[float, float]
    path: Array
    """(n, 3) on the mesh, world frame."""
    closed: bool


def measure_body(model: BodyModel, vertices: Array, vertex_sigma_m: Array) -> list[Measurement]:
    """All measurements of a body as it stands.

    Args:
        vertices: (P, 3) in the template's topology, z up, floor at 0, metres.
        vertex_sigma_m: (P,) standard deviation of the vertices along their normals.
    """
    measured = []
    normals = vertex_normals(vertices, model.faces)
    for definition in DEFINITIONS:
        path, closed = _path(model, vertices, normals, definition)
        value = loop_length(path, closed=closed)
        chosen = [model.landmarks[name] for name in definition.landmarks]
        sigma = float(np.sqrt(np.mean(vertex_sigma_m[chosen] ** 2)))
        half = 1.96 * _sigma(definition, sigma)
        measured.append(
            Measurement(
                definition.name,
                definition.standard,
                value,
                (max(0.0, value - half), value + half),
                path,
                closed,
            )
        )
    return measured


def _sigma(definition: Definition, sigma_m: float) -> float:
    """Standard deviation of a value from those of the surface and of the landmarks."""
    if definition.kind == "girth":
        return 2.0 * np.pi * _RADIUS_SIGMA_SHARE * sigma_m + 0.3 * _LANDMARK_SIGMA_M
    if definition.kind == "height" and definition.name == "height":
        return 1.5 * sigma_m
    return float(np.hypot(np.sqrt(2.0) * sigma_m, np.sqrt(2.0) * _LANDMARK_SIGMA_M))


def _path(
    model: BodyModel, vertices: Array, normals: Array, definition: Definition
) -> tuple[Array, bool]:
    marks = np.array([model.landmarks[name] for name in definition.landmarks])
    points = vertices[marks]
    if definition.kind == "height":
        foot = points[0] * (1.0, 1.0, 0.0)
        return np.stack([points[0], foot]), False
    if definition.kind == "distance":
        return points, False
    if definition.kind == "surface":
        outward = normals[marks].mean(axis=0)
        return surface_path(vertices, model.faces, points[0], points[1], outward), False
    at = points[0] if len(points) == 1 else points[0] + definition.share * (points[1] - points[0])
    axis = np.array([0.0, 0.0, 1.0])
    if definition.axis is not None:
        start, end = (vertices[model.landmarks[name]] for name in definition.axis)
        axis = (end - start) / np.linalg.norm(end - start)
    found = section_points(vertices, _faces_of(model, definition.parts), at, axis)
    return hull_loop(_nearest_piece(found, at), axis), True


def _faces_of(model: BodyModel, parts: tuple[str, ...]) -> Faces:
    wanted = [model.part_names.index(part) for part in parts]
    inside = np.isin(model.part_of_vertex, wanted)
    return model.faces[inside[model.faces].all(axis=1)]


def _nearest_piece(points: Array, at: Array) -> Array:
    """Of a section that falls apart (both thighs, say) the piece that belongs to the landmark."""
    if len(points) < 3:
        return points
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    pairs = tree.query_pairs(0.035, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    _, piece = connected_components(links, directed=False)
    return points[piece == piece[tree.query(at)[1]]]
