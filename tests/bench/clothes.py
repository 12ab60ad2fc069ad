"""Loose clothes on bodies in the model's topology, as sensors see them.

Cloth hangs in tubes from where the body is widest: it spans hollows, comes back to the body slowly
below, is wider than the body by an ease that grows downwards, lies in folds, and ends in a hem. The
eases are those of cutting tables: a T-shirt is 8 to 20 cm wider than the chest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from hair import joined
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from station.simulation.scene import Mesh
from workers.scape.model.body_model import BodyModel
from workers.scape.verdict.seen import TRUNK

Array = NDArray[np.float64]
Garment = Literal["vest", "shirt", "sweater", "shorts", "trousers", "skirt"]

EASES_M: dict[Garment, tuple[float, float]] = {
    "vest": (0.08, 0.16), "shirt": (0.08, 0.18), "sweater": (0.08, 0.18),
    "shorts": (0.06, 0.12), "trousers": (0.06, 0.14), "skirt": (0.10, 0.25),
}  # fmt: skip
_FOLD_SHARES = (0.1, 0.4)
"""Depth of each of three folds' waves, as a share of the distance of the cloth."""
_FOLDS = (5, 10)
_TAPERS = (0.2, 0.5)
"""Slopes at which cloth comes back to the body, metres a metre."""
_TWIST_RAD_M = 3.0
_STEP_M, _ANGLES = 0.01, 120
_GAP_M = 0.003
_LEAST_POINTS = 10
_SIDES = ("left", "right")


@dataclass(frozen=True, slots=True)
class _Tube:
    """Cloth around some of the body's points (N, 3), along a straight axis."""

    points: Array
    start: Array
    end: Array
    ease_m: float
    """Girth beyond that of the points."""
    rise_m: float
    """Length over which it is reached."""


def with_clothes(
    model: BodyModel, body: Mesh, kind: Garment, rng: np.random.Generator
) -> tuple[Mesh, float]:
    """A body that faces -y, with a garment, and the garment's ease in metres.

    Args:
        body: its first P vertices are the template's.
    """
    ease_m = float(rng.uniform(*EASES_M[kind]))
    vertices = body.vertices[: model.vertex_count]
    tubes = _tubes(model, vertices, kind, ease_m)
    return joined([body, *(_cloth(tube, rng) for tube in tubes)]), ease_m


def _tubes(model: BodyModel, vertices: Array, kind: Garment, ease_m: float) -> Iterator[_Tube]:
    at = {name: vertices[index] for name, index in model.landmarks.items()}

    def of(*names: str) -> Array:
        return vertices[model.of_parts(names)]

    def above(point: Array, level_m: float) -> Array:
        return np.array([point[0], point[1], level_m])

    def between(*names: str) -> Array:
        return np.asarray(np.mean([at[name] for name in names], axis=0))

    crotch_m = at["crotch"][2]
    waist = between("waist_front", "waist_back")
    if kind in ("vest", "shirt", "sweater"):
        middle = between("armpit_left", "armpit_right")
        shoulders_m = between("acromion_left", "acromion_right")[2] - 0.01
        trunk = of(*TRUNK, "shoulder_left", "shoulder_right")
        ends = above(middle, shoulders_m), above(middle, crotch_m + 0.03)
        yield _Tube(trunk, *ends, ease_m, rise_m=0.2)
        for side in _SIDES if kind != "vest" else ():
            armpit = between(f"acromion_{side}", f"armpit_{side}")
            elbow = between(f"elbow_{side}")
            end = armpit + 0.65 * (elbow - armpit) if kind == "shirt" else elbow
            yield _Tube(of(f"upper_arm_{side}"), armpit, end, 0.8 * ease_m, rise_m=0.05)
            if kind == "sweater":
                forearm = of(f"forearm_{side}")
                yield _Tube(forearm, elbow, at[f"wrist_{side}"], 0.5 * ease_m, rise_m=0.001)
    if kind == "skirt":
        hem = above(waist, between("knee_left", "knee_right")[2] + 0.03)
        yield _Tube(of(*TRUNK, "thigh_left", "thigh_right"), waist, hem, ease_m, rise_m=0.3)
    if kind in ("shorts", "trousers"):
        hips = of("pelvis", "abdomen")
        yield _Tube(hips, waist, above(waist, crotch_m + 0.02), 0.6 * ease_m, rise_m=0.1)
        for side in _SIDES:
            thigh, shin = of(f"thigh_{side}"), of(f"shin_{side}")
            start = above(thigh[thigh[:, 2] < crotch_m - 0.05].mean(axis=0), crotch_m + 0.04)
            knee = shin[shin[:, 2] > at[f"knee_{side}"][2] - 0.06].mean(axis=0)
            end = start + 0.6 * (knee - start) if kind == "shorts" else knee
            yield _Tube(thigh, start, end, ease_m, rise_m=0.05)
            if kind == "trousers":
                ankle = at[f"ankle_{side}"]
                yield _Tube(shin, knee, above(ankle, ankle[2] - 0.03), ease_m, rise_m=0.001)


def _cloth(tube: _Tube, rng: np.random.Generator) -> Mesh:
    """The tube, open at both ends."""
    axis = tube.end - tube.start
    length_m = float(np.linalg.norm(axis))
    along = axis / length_m
    across = np.cross(along, (0.0, 1.0, 0.0))
    across /= np.linalg.norm(across)
    basis = np.stack([across, np.cross(along, across)])
    angle = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    at_m = (tube.points - tube.start) @ along
    flat = (tube.points - tube.start) @ basis.T
    folds, depth = rng.integers(*_FOLDS, 3), rng.uniform(*_FOLD_SHARES)
    phases, taper = rng.uniform(0.0, 2.0 * np.pi, 3), rng.uniform(*_TAPERS)
    levels_m = np.arange(0.0, length_m, _STEP_M)
    rings, hanging_m = [], np.zeros(_ANGLES)
    for level_m in levels_m:
        near = flat[np.abs(at_m - level_m) < 1.5 * _STEP_M]
        body_m = _reach(near, rays) if len(near) > _LEAST_POINTS else np.zeros(_ANGLES)
        hanging_m = np.maximum(body_m + _GAP_M, hanging_m - taper * _STEP_M)
        off_m = min(1.0, level_m / tube.rise_m) * tube.ease_m / (2.0 * np.pi)
        turned = np.outer(folds, angle) + (phases + _TWIST_RAD_M * level_m)[:, None]
        radius_m = hanging_m + off_m * np.maximum(1.0 + depth * np.sin(turned).sum(axis=0), 0.0)
        rings.append(tube.start + level_m * along + radius_m[:, None] * (rays @ basis))
    first = np.arange((len(levels_m) - 1) * _ANGLES)
    beside = first - first % _ANGLES + (first + 1) % _ANGLES
    faces = np.concatenate(
        [
            np.stack([first, first + _ANGLES, beside], axis=1),
            np.stack([beside, first + _ANGLES, beside + _ANGLES], axis=1),
        ]
    )
    return Mesh(np.concatenate(rings), faces.astype(np.int32))


def _reach(points: Array, rays: Array) -> Array:
    """Distances (A,) from the origin to the convex hull of points (N, 2) along rays (A, 2)."""
    hull = ConvexHull(points)
    facing = rays @ hull.equations[:, :2].T
    with np.errstate(divide="ignore"):
        reach = np.where(facing > 0.0, -hull.equations[:, 2] / facing, np.inf)
    return np.maximum(reach.min(axis=1), 0.0)
