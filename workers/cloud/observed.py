"""A person as the cameras saw them: the merged cloud, each camera's image, and findings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import Image
from station.core.errors import InputError
from station.core.rig import CameraCalibration, PredictedError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 1500
"""Fewer points do not show a body."""
POSSIBLE_HEIGHTS_M = (1.0, 2.6)
"""A cloud that is lower or higher than this is not a standing person in metres."""

RAISED_FLOOR = "floor-raised"
"""Code of the finding that a person stands on something: heights are not those above z = 0."""
UNKNOWN_FLOOR = "floor-unknown"
"""Code of the finding that a bare cloud does not show where the floor is."""
LOWERED_FLOOR = "floor-lowered"
"""Code of the finding that a person stands below z = 0: cameras or their calibration are off."""
TWO_PEOPLE = "two-people"
"""Code of the finding that more than one person was seen."""
OFF_FLOOR = frozenset({RAISED_FLOOR, LOWERED_FLOOR, UNKNOWN_FLOOR})
"""Codes after which nothing is measured that ends on the floor."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that the operator should know of."""

    code: str
    """"motion", "camera-blind", "frames-missing", "leaning", "rough", `TWO_PEOPLE`, or one of
    `OFF_FLOOR`."""
    camera: str | None
    value: float | None
    message: str


@dataclass(frozen=True, slots=True)
class CameraView:
    """One camera's cleaned image, (h, w) each."""

    name: str
    calibration: CameraCalibration
    depth_m: Image
    """Averaged, corrected, filtered; 0 = no reading."""
    person: Mask
    background: Mask
    """Measured, and not the person."""


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points (n, 3) on the person in the world frame."""

    points: Array
    normals: Array
    """(n, 3), unit, towards the camera."""
    sigma_m: Array
    """(n,): standard deviation along the ray."""
    camera: NDArray[np.int16]
    """(n,): index into camera_names."""
    camera_names: tuple[str, ...]
    excess_noise_m: float = 0.0
    """Standard deviation of the noise that averaging the frames has left, beyond that of
    independent readings."""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The origin of a bare cloud's points in its own frame, turned z up."""
    scatter_m: float = 0.0
    """Standard deviation of a bare cloud's points about the skin; 0 where cameras say it."""
    blank: int = 0
    """Points of a bare cloud's file that have no reading (NaN) and are not among these."""

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class Preprocessed:
    """The input of the fit."""

    cloud: PointCloud
    views: tuple[CameraView, ...]
    """Empty for a bare cloud, else one of each of its cameras, in their order."""
    findings: tuple[Finding, ...]
    predicted: PredictedError | None = None
    """Errors that the calibration adds by its own statement; None for bare clouds and old files."""


def check_shows_a_body(cloud: PointCloud) -> None:
    """Refuse a cloud that no body can be fitted to.

    Raises:
        InputError: it has values that are not numbers, or is no standing adult in metres.
    """
    if not (np.isfinite(cloud.points).all() and np.isfinite(cloud.normals).all()):
        raise InputError(
            "the cloud holds values that are not numbers; repair the file or scan again"
        )
    if len(cloud) < MIN_POINTS:
        raise InputError(f"the cloud has {len(cloud)} points; a body needs {MIN_POINTS}")
    height_m = float(np.ptp(cloud.points[:, 2]))
    if not POSSIBLE_HEIGHTS_M[0] < height_m < POSSIBLE_HEIGHTS_M[1]:
        raise InputError(
            f"the cloud is {height_m:.2f} m high; a standing adult in metres, z up, was expected: "
            "scan the whole person, from the soles to the top of the head"
        )
