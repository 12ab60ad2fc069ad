"""Errors that a calibration adds to a scan, without noise: a body's points go through the true
sensors and back through the calibration, so that one booth costs milliseconds.

Heights and girths are those of the body's surface moved by these errors; a girth's change is the
mean normal displacement around a slice times 2 pi.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import invert, rigid_fit, so3_log, transform
from station.core.lens import pixel_rays, project
from station.core.rig import Rig
from station.simulation.scene import Mesh
from station.simulation.sensor import SimulatedBooth, SimulatedUnit

Array = NDArray[np.float64]

_FACING = 0.3
_SLICES = np.linspace(0.75, 1.45, 26)
"""Heights of 26 girths between hip and armpit, for a body of 1.7 m."""
_SECTORS = 24
_TRUNK_M = 0.24
"""Arms lie farther from the axis."""


@dataclass(frozen=True, slots=True)
class Distortion:
    """The distortion of one body by a calibration."""

    normal_rms_mm: float
    """Rms of the cloud along the normal, after the best rigid motion."""
    tilt_deg: float
    height_mm: float
    girths_mm: Array


def distortion(booth: SimulatedBooth, rig: Rig, body: Mesh) -> Distortion:
    """A body's points as a calibration places them, against where they are."""
    normals, areas = _normals(body)
    places, truths, directions, weights = [], [], [], []
    for name, found in rig.cameras.items():
        unit = SimulatedUnit.of(booth, name)
        lens = unit.camera
        local = transform(invert(lens.world_from_camera), body.vertices)
        towards = lens.world_from_camera[:3, 3] - body.vertices
        facing = np.einsum("ni,ni->n", normals, towards) / np.linalg.norm(towards, axis=1)
        pixels = project(lens, local)
        size = (lens.width - 1, lens.height - 1)
        good = (facing > _FACING) & ((pixels >= 0) & (pixels <= size)).all(axis=1)
        local, pixels = local[good], pixels[good]
        x, y = (2.0 * pixels / size - 1.0).T
        depth = local[:, 2] + unit.error.offset_m(x, y, local[:, 2])
        inverse = 1.0 / unit.error.decoded_m(depth)
        inverse = found.depth_correction.inverse_at(inverse, x, y)
        ray = np.column_stack([pixel_rays(found, pixels), np.ones(len(pixels))])
        places.append(transform(found.world_from_camera, ray / inverse[:, None]))
        truths.append(body.vertices[good])
        directions.append(normals[good])
        weights.append(areas[good] * facing[good])
    place, truth = np.concatenate(places), np.concatenate(truths)
    direction, weight = np.concatenate(directions), np.concatenate(weights)
    true_from_found = rigid_fit(truth, place, weight)
    tilt = so3_log(true_from_found[:3, :3])[:2]
    aligned = transform(true_from_found, place) - truth
    off = np.einsum("ni,ni->n", aligned, direction)
    # A turn about the vertical and a shift along the floor are nobody's error.
    flat = true_from_found.copy()
    raised = place[:, 2] - truth[:, 2]
    crown = truth[:, 2] > truth[:, 2].max() - 0.06
    return Distortion(
        normal_rms_mm=1e3 * float(np.sqrt(np.average(off**2, weights=weight))),
        tilt_deg=float(np.degrees(np.linalg.norm(tilt))),
        height_mm=1e3 * float(np.average(raised[crown], weights=weight[crown])),
        girths_mm=_girths(
            truth,
            direction,
            weight,
            np.einsum("ni,ni->n", transform(flat, place) - truth, direction),
        ),
    )


def _girths(truth: Array, direction: Array, weight: Array, off: Array) -> Array:
    turn = np.arctan2(direction[:, 1], direction[:, 0])
    sector = ((turn + np.pi) / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
    found = []
    for height in _SLICES:
        inside = (np.abs(truth[:, 2] - height) < 0.03) & (np.abs(direction[:, 2]) < 0.6)
        inside &= np.hypot(truth[:, 0], truth[:, 1]) < _TRUNK_M
        total = np.bincount(sector[inside], weight[inside] * off[inside], minlength=_SECTORS)
        share = np.bincount(sector[inside], weight[inside], minlength=_SECTORS)
        seen = share > 0
        found.append(2e3 * np.pi * float(np.mean(total[seen] / share[seen])))
    return np.array(found)


def _normals(body: Mesh) -> tuple[Array, Array]:
    """Unit normals (n, 3) of the vertices, and areas (n,) in proportion to theirs: a cloud has no
    more points of a hand because the mesh has more vertices there."""
    corners = body.vertices[body.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(body.vertices)
    for k in range(3):
        np.add.at(total, body.faces[:, k], across)
    areas = np.linalg.norm(total, axis=1)
    return np.asarray(total / np.maximum(areas[:, None], 1e-12)), areas
