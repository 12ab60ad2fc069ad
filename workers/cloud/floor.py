"""The floor of a bare cloud, and signs that the cloud is in other units or lies down."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from station.core.errors import InputError
from workers.cloud.observed import POSSIBLE_HEIGHTS_M

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
Z_UP = {
    "z": np.eye(3),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
}
"""Axis of a file that points up -> rotation to z up; "-y" of one that points down, as in camera
frames."""
_UNIT_WORDS = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches"}
_ADULTS_M = (1.2, 2.3)
"""Statures that tell a unit from the others."""
_STRAY_SHARE = 0.002
"""Share of the points at either end of an axis that do not count to its length."""
_BAND_M = 0.01
_CELL_M = 0.05
_FLOOR_M2 = 0.5
"""Least area of a floor; two feet cover 0.06."""
_FLOOR_OVER_LEGS = 3.0
"""Least ratio of its area to that of a band 0.2 m above it."""
_LEGS_M = 0.2
_LOWEST_SHARE = 0.3
"""Share of the cloud's height in which a floor is searched for."""
_CLEARANCE_M = 0.015
"""Points so near to the floor are taken away with it: noise of the floor, and soles."""
_FOOT_M, _AROUND_FEET_M, _FEWEST_NEAR = 0.06, 0.15, 50
"""Height of feet above the floor, how far around them it is what they stand on, and its fewest
points."""
_VOXEL_M = 0.04
_SECOND_PERSON_SHARE, _SECOND_PERSON_HEIGHT_M = 0.15, 1.1
"""Share of the largest piece's points, and height, of what else may be a person (`one_person`)."""
_THICK_M = 0.03
"""Least standard deviation of such a person's points along a level direction: 0.07 and more of the
demo bodies' are, and less than 0.02 of a wall or a pole."""
_PLANE_ROUNDS = 4
_LEVEL = np.tan(np.radians(1.5))
"""Slope of a floor from which the cloud is not level: the body would lean by it, and stand on one
foot's edge."""
_STEEPEST = np.cos(np.radians(20.0))
"""Least z component of the normal of a plane that may be a floor in a frame that is not level."""
_PLANES, _PLANE_POINTS = 400, 2000
"""Planes through three points that are tried, and points that vote for them."""


def check_units(points: Array, unit: str, up: str) -> None:
    """Refuse a cloud that is in other units than was said, or lies down.

    Args:
        points: (n, 3), in metres by the stated unit, z up by the stated axis.
        unit: one of `UNITS_M`.
        up: the stated axis, one of `Z_UP`.

    Raises:
        InputError: naming the option that helps.
    """
    low, high = np.quantile(points, [_STRAY_SHARE, 1.0 - _STRAY_SHARE], axis=0)
    *across_m, height_m = high - low
    least, most = _ADULTS_M
    if POSSIBLE_HEIGHTS_M[0] < height_m < POSSIBLE_HEIGHTS_M[1]:
        return
    stated = height_m / UNITS_M[unit]
    for other, scale in UNITS_M.items():
        if other != unit and least < stated * scale < most:
            raise InputError(
                f"the cloud is {stated:.4g} {_UNIT_WORDS[unit]} high, which looks like "
                f"{_UNIT_WORDS[other]}; use --unit {other}"
            )
    length_m = max(across_m)
    if height_m < least and least < length_m < most:
        longest = np.abs(Z_UP[up][int(np.argmax(across_m))])
        raise InputError(
            f"the cloud is {length_m:.2f} m long and {height_m:.2f} m high: is it lying down? "
            f"say which axis points up: --up {'xyz'[int(np.argmax(longest))]}"
        )


def standing_on(points: Array) -> tuple[Mask, float] | None:
    """Points (n,) of a person who stands on a floor that was scanned too, and the floor's height
    below them in metres; None where no floor was scanned.

    What stands apart from the person goes with the floor, unless it may be another person: whose
    measurements are asked for is not known then.

    Args:
        points: (n, 3), metres, z up.

    Raises:
        InputError: the floor is tilted.
    """
    start_m = _floor_band(points)
    if start_m is None:
        _check_tilted_floor(points)
        return None
    plane = np.array([0.0, 0.0, start_m + 0.5 * _BAND_M])
    plane = _fitted(points, plane, 2.0 * _BAND_M)
    if np.linalg.norm(plane[:2]) > _LEVEL:
        raise _not_level(float(np.arctan(np.linalg.norm(plane[:2]))))
    above_m = points[:, 2] - points[:, :2] @ plane[:2] - plane[2]
    over = above_m > _CLEARANCE_M
    person = np.flatnonzero(over)[_people(points[over])]
    plane[2] += _under_feet_m(points, above_m, person)
    kept = np.zeros(len(points), bool)
    kept[person] = True
    middle = np.median(points[person, :2], axis=0)
    return kept, float(middle @ plane[:2] + plane[2])


def _under_feet_m(points: Array, above_m: Array, person: NDArray[np.intp]) -> float:
    """Height above the whole floor's plane of what lies around the feet: a mat, or a dip.

    Args:
        points: (n, 3).
        above_m: (n,), their heights above the plane.
        person: indices of the person's.
    """
    feet = points[person[above_m[person] < _FOOT_M], :2]
    floor = np.abs(above_m) < _CLEARANCE_M
    if not len(feet):
        return 0.0
    beside = cKDTree(feet).query(points[floor, :2], distance_upper_bound=_AROUND_FEET_M)[0]
    near = np.isfinite(beside)
    return float(np.median(above_m[floor][near])) if near.sum() >= _FEWEST_NEAR else 0.0


def _fitted(points: Array, plane: Array, within_m: float) -> Array:
    """The plane z = plane @ (x, y, 1) through the points that lie near to a rough one."""
    near = np.abs(points[:, 2] - points[:, :2] @ plane[:2] - plane[2]) < within_m
    for _ in range(_PLANE_ROUNDS):
        basis = np.column_stack([points[near, :2], np.ones(int(near.sum()))])
        plane = np.linalg.lstsq(basis, points[near, 2], rcond=None)[0]
        near = np.abs(points[:, 2] - points[:, :2] @ plane[:2] - plane[2]) < _CLEARANCE_M
    return plane


def _floor_band(points: Array) -> float | None:
    """Lower end of the horizontal band that a floor fills."""
    low, high = np.quantile(points[:, 2], [_STRAY_SHARE, 1.0 - _STRAY_SHARE])
    bands = np.arange(low - _BAND_M, low + _LOWEST_SHARE * (high - low), _BAND_M)
    areas = np.array([_area_m2(points, start) for start in bands])
    best = int(np.argmax(areas))
    above = _area_m2(points, bands[best] + _LEGS_M)
    if areas[best] < max(_FLOOR_M2, _FLOOR_OVER_LEGS * above):
        return None
    return float(bands[best])


def _check_tilted_floor(points: Array) -> None:
    """Refuse a cloud with a floor that no horizontal band holds: lowest points are no soles there.

    Raises:
        InputError: a slanted plane through some of the lowest points is as large as a floor.
    """
    low, high = np.quantile(points[:, 2], [_STRAY_SHARE, 1.0 - _STRAY_SHARE])
    lowest = points[points[:, 2] < low + _LOWEST_SHARE * (high - low)]
    if not len(lowest):
        # The cloud has hardly any height.
        return
    draw = np.random.default_rng(len(points)).integers(len(lowest), size=(3, _PLANES))
    first, second, third = lowest[draw]
    normals = np.cross(second - first, third - first)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals *= np.sign(normals[:, 2:])
    slanted = normals[:, 2] > _STEEPEST
    if not slanted.any():
        return
    normals, first = normals[slanted], first[slanted]
    voters = lowest[:: max(1, len(lowest) // _PLANE_POINTS)]
    away = np.abs(voters @ normals.T - np.einsum("pi,pi->p", first, normals))
    best = int(np.argmax((away < _BAND_M).sum(axis=0)))
    over_m = (points - first[best]) @ normals[best]
    area, above = (
        _covered_m2(points[np.abs(over_m - level_m) < _BAND_M]) for level_m in (0.0, _LEGS_M)
    )
    if area <= max(_FLOOR_M2, _FLOOR_OVER_LEGS * above):
        return
    slope = -normals[best, :2] / normals[best, 2]
    rough = np.append(slope, first[best, 2] - slope @ first[best, :2])
    slope = _fitted(points, rough, _CLEARANCE_M)[:2]
    # Noise spreads a small level floor over several bands; it passes for none then.
    if np.linalg.norm(slope) > _LEVEL:
        raise _not_level(float(np.arctan(np.linalg.norm(slope))))


def _not_level(tilt_rad: float) -> InputError:
    return InputError(
        f"the cloud is not level: its floor is tilted by {np.degrees(tilt_rad):.0f} degrees; "
        "turn the cloud until the floor is horizontal, and try again"
    )


def _area_m2(points: Array, start_m: float) -> float:
    """Area that a horizontal band's points cover."""
    inside = (points[:, 2] >= start_m) & (points[:, 2] < start_m + _BAND_M)
    return _covered_m2(points[inside])


def _covered_m2(points: Array) -> float:
    """Area that points cover, seen from above."""
    cells = np.unique(np.floor(points[:, :2] / _CELL_M).astype(np.int64), axis=0)
    return len(cells) * _CELL_M**2


def _people(points: Array) -> NDArray[np.intp]:
    """Indices of a cloud's (n, 3) largest connected piece, and of others that may be people."""
    cells = np.floor((points - points.min(axis=0)) / _VOXEL_M).astype(np.int64) + 1
    shape = tuple(int(size) for size in cells.max(axis=0) + 2)
    cell = np.ravel_multi_index(tuple(cells.T), shape)
    occupied = np.zeros(shape, bool)
    occupied.flat[cell] = True
    labels, _ = ndimage.label(ndimage.binary_dilation(occupied))
    label = labels.flat[cell]
    sizes = np.bincount(label)
    largest = int(np.argmax(sizes))
    people = [
        piece
        for piece in np.flatnonzero(sizes > _SECOND_PERSON_SHARE * sizes[largest])
        if piece == largest or _may_be_person(points[label == piece])
    ]
    return np.flatnonzero(np.isin(label, people))


def _may_be_person(points: Array) -> bool:
    """Whether a piece (n, 3) is as high as people are, and neither a wall nor a pole."""
    thickness_m = np.sqrt(np.linalg.eigvalsh(np.cov(points[:, :2].T))[0])
    return bool(np.ptp(points[:, 2]) > _SECOND_PERSON_HEIGHT_M and thickness_m > _THICK_M)
