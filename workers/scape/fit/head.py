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
"""Distance from which a head is looked at again: after the middle steps 33 sculpted bodies and 80
of the family are 1.1 to 2.7 mm from the points of their heads, one with its face 4 cm below its
place 4.8."""
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
    on its head and lie nearer to the other's."""
    least_m = head_off_m(model, target.tree, fit.vertices)
    if least_m < _OFF_M:
        return fit
    best = fit
    for start in _nodding(model, fit.state):
        tried = fit_jointly(model, sampling, target, start, fit.cameras, _AGAIN, observer=observer)
        off_m = head_off_m(model, target.tree, tried.vertices)
        if off_m < least_m:
            best, least_m = tried, off_m
    return best


def head_off_m(model: BodyModel, cloud: OrientedTree, vertices: Array) -> float:
    """Distance of points from the head of a body (P, 3) along their normals, rms; 0 without any."""
    head, neck = (model.part_names.index(name) for name in ("head", "neck"))
    part = model.part_of_vertex
    near = np.flatnonzero((part == head) | (part == neck))
    skin = OrientedTree.build(vertices[near], vertex_normals(vertices, model.faces)[near])
    low, high = vertices[part == head].min(axis=0), vertices[part == head].max(axis=0)
    inside = (cloud.points > low - _REACH_M) & (cloud.points < high + _REACH_M)
    around = np.flatnonzero(inside.all(axis=1))[::_EVERY]
    points, normals = cloud.points[around], cloud.normals[around]
    found, vertex = skin.pairs(points, normals, max_distance_m=_REACH_M, max_angle_rad=_TURN_RAD)
    own = part[near[vertex]] == head
    if not own.any():
        return 0.0
    points, normals, vertex = points[found[own]], normals[found[own]], near[vertex[own]]
    places = attached(model, vertices, points, vertex).of(vertices, model.faces)
    off = np.einsum("ni,ni->n", points - places, normals)
    return float(np.sqrt(np.mean(off**2)))


def _nodding(model: BodyModel, state: BodyState) -> list[BodyState]:
    """The state with the head held higher, and lower."""
    twists = model.relative_twists(state.rotations)
    found = []
    for nod in _NODS_RAD:
        turned = twists.copy()
        turned[model.part_names.index("head"), 0] += nod
        found.append(replace(state, rotations=model.absolute_rotations(turned)))
    return found
