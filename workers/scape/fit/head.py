"""A second look at a head that its points do not lie on.

Scalp and neck slide along themselves. Of a head that is held higher or lower than most, everything
can lie in its place but the face, a few centimetres from its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from workers.scape.evidence.correspondence import OrientedTree
from workers.scape.fit.annealing import COARSE, MIDDLE
from workers.scape.fit.joint import JointResult, fit_jointly
from workers.scape.fit.normal_equations import Target
from workers.scape.fit.observer import Observer
from workers.scape.fit.sampling import Sampling
from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.attachment import attached

Array = NDArray[np.float64]

_OFF_M = 3.3e-3
"""Distance, beyond the points' noise, from which a head is looked at again: after the middle steps
33 sculpted bodies and 80 of the family are at most 2.3 mm from the points of their heads, one with
its face 4 cm below its place 4.6."""
_GAIN = 0.8
"""Share of that distance that another pose of the head leaves at most where it is right."""
_AGAIN = (*COARSE[-3:], *MIDDLE)
"""Steps from each pose of the head that is tried."""
_NODS_RAD = tuple(np.radians(nod) for nod in (-20.0, 20.0))
_REACH_M = 0.03
_TURN_RAD = np.radians(45.0)
"""Largest distance and angle between a point and the vertex that it is compared with."""
_EVERY = 2
"""Every so many points are compared."""


def settle_head(
    model: BodyModel,
    sampling: Sampling,
    target: Target,
    fit: JointResult,
    observer: Observer,
) -> JointResult:
    """The fit after its middle steps, or one from a head held higher or lower if points do not lie
    on its head and lie clearly nearer to the other's."""
    points = points_of_head(model, target, fit.vertices)
    off_m = head_off_m(model, target, points, fit.vertices)
    if off_m < _OFF_M:
        return fit
    best, least_m = fit, _GAIN * off_m
    for start in _nodding(model, fit.state):
        tried = fit_jointly(model, sampling, target, start, fit.cameras, _AGAIN, observer=observer)
        off_m = head_off_m(model, target, points, tried.vertices)
        if off_m < least_m:
            best, least_m = tried, off_m
    return best


def points_of_head(model: BodyModel, target: Target, vertices: Array) -> NDArray[np.intp]:
    """Indices of points whose nearest skin is the head of a body (P, 3)."""
    mine = _on_head(model)
    low, high = vertices[mine].min(axis=0), vertices[mine].max(axis=0)
    places = target.tree.points
    inside = (places > low - _REACH_M) & (places < high + _REACH_M)
    around = np.flatnonzero(inside.all(axis=1))[::_EVERY]
    found, vertex = _paired(model, target, around, vertices)
    return around[found[mine[vertex]]]


def head_off_m(
    model: BodyModel, target: Target, points: NDArray[np.intp], vertices: Array
) -> float:
    """Distance of some points from head and neck of a body (P, 3) along their normals, rms, beyond
    their noise; a point without skin near it counts as `_REACH_M`."""
    found, vertex = _paired(model, target, points, vertices)
    off = np.full(len(points), _REACH_M)
    paired = points[found]
    places = attached(model, vertices, target.tree.points[paired], vertex)
    offset = target.tree.points[paired] - places.of(vertices, model.faces)
    off[found] = np.einsum("ni,ni->n", offset, target.tree.normals[paired])
    square = off**2 - target.sigma_m[points] ** 2
    return float(np.sqrt(max(0.0, square.mean()))) if len(points) else 0.0


def _paired(
    model: BodyModel, target: Target, points: NDArray[np.intp], vertices: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Those of some points that have skin of head or neck near them, and its nearest vertex."""
    neck = model.part_of_vertex == model.part_names.index("neck")
    near = np.flatnonzero(_on_head(model) | neck)
    skin = OrientedTree.build(vertices[near], vertex_normals(vertices, model.faces)[near])
    found, vertex = skin.pairs(
        target.tree.points[points],
        target.tree.normals[points],
        max_distance_m=_REACH_M,
        max_angle_rad=_TURN_RAD,
    )
    return found, near[vertex]


def _on_head(model: BodyModel) -> NDArray[np.bool_]:
    return np.asarray(model.part_of_vertex == model.part_names.index("head"))


def _nodding(model: BodyModel, state: BodyState) -> list[BodyState]:
    """The state with the head held higher, and lower."""
    twists = model.relative_twists(state.rotations)
    found = []
    for nod in _NODS_RAD:
        turned = twists.copy()
        turned[model.part_names.index("head"), 0] += nod
        found.append(replace(state, rotations=model.absolute_rotations(turned)))
    return found
