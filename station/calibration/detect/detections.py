"""Observations of a calibration: balls and flat surfaces, reduced to patches.

A patch is the mean of a few dozen neighbouring pixels: (u, v, inverse depth, variance). It keeps
what the images say about places *and* about the cameras' depth errors, so that the joint solution
may still change the depth correction, at a thousandth of the images' size. Everything is in inverse
depth (1/m): there a Kinect's noise and quantisation are the same at every range, a depth correction
acts linearly, and a flat surface is linear in the pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from station.core.depth.correction import DepthCorrection
from station.core.errors import FormatError
from station.core.rig import CameraCalibration
from station.sensors.base import DeviceInfo

Array = NDArray[np.float64]

FLOOR = "floor"
_FEWEST_PATCHES = 3
"""Fewer do not make a plane."""
_NEAREST_M, _FARTHEST_M = 0.1, 20.0
"""Ends of what any depth camera measures."""
_LEAST_VARIANCE = 1e-18
"""1/m2, of a patch: nanometres at 1 m."""
_RADIUS_CERTAIN = 0.045
"""Largest standard deviation of a detection's own radius, as a share of the radius, ..."""
_COVERED_CERTAIN, _COVERED = 0.034, 1.1
"""... and that of a ball that is partly covered, which is so many times less certain than a whole
one."""
_WHOLE_SIGMA_PER_M = 3.8e-5
"""A whole ball's radius R at the distance z is measured to k z^3 / R^2, as a share of R: from
`station.calibration.detect.ball_image.normal_equations`, 1.4 to 2.6 m, balls of 70 to 100 mm."""


def uncalibrated(name: str, info: DeviceInfo) -> CameraCalibration:
    """A camera as it comes from the factory: its lens is known, its place is not."""
    return CameraCalibration(
        name=name,
        serial=info.serial,
        model=info.model,
        width=info.width,
        height=info.height,
        K=np.asarray(info.K, np.float64),
        distortion=np.asarray(info.distortion, np.float64),
        depth_correction=DepthCorrection(),
        world_from_camera=np.eye(4),
    )


@dataclass(frozen=True, slots=True)
class BallDetection:
    """The ball in one depth image, before any depth correction."""

    camera: str
    time_s: float
    """Host's monotonic clock, by the clock model."""
    center_m: Array
    """(3,) camera frame; of a ball of the radius that was given."""
    covariance_m2: Array
    """(3, 3) of the centre under the sensor's noise."""
    points: int
    """Pixels on the ball that were used."""
    radius_m: float
    """As measured: what the radius would be if it were not known."""
    radius_sigma_m: float
    patches: Array
    """(k, 4): u, v (pixels), inverse depth (1/m), its variance (1/m2)."""

    def certain(self, radius_m: float) -> bool:
        """True if its own radius tells it from a ball that a hand covers.

        The edge of a hand looks like the ball's and shifts it by more than noise does, so what is
        covered in part must be more certain than a whole ball far away.
        """
        share = self.radius_sigma_m / radius_m
        whole = _WHOLE_SIGMA_PER_M * float(self.center_m[2]) ** 3 / radius_m**2
        return share < min(_RADIUS_CERTAIN, max(_COVERED_CERTAIN, _COVERED * whole))

    def to_json(self) -> dict[str, Any]:
        return {
            "camera": self.camera,
            "time_s": self.time_s,
            "center_m": self.center_m.tolist(),
            "covariance_m2": self.covariance_m2.tolist(),
            "points": self.points,
            "radius_m": self.radius_m,
            "radius_sigma_m": self.radius_sigma_m,
            "patches": _rounded(self.patches),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The detection of its JSON.

        Raises:
            FormatError: a field is missing or is not what it should be.
        """
        try:
            seen = cls(
                camera=str(document["camera"]),
                time_s=float(finite_numbers(document["time_s"], ())),
                center_m=finite_numbers(document["center_m"], (3,)),
                covariance_m2=finite_numbers(document["covariance_m2"], (3, 3)),
                points=int(document["points"]),
                radius_m=float(finite_numbers(document["radius_m"], ())),
                radius_sigma_m=float(finite_numbers(document["radius_sigma_m"], ())),
                patches=finite_numbers(document["patches"], (None, 4)),
            )
            if min(seen.center_m[2], seen.radius_m, seen.radius_sigma_m) <= 0.0:
                raise ValueError("distance, radius and its standard deviation are above 0")
            if np.linalg.norm(seen.center_m) > _FARTHEST_M:
                raise ValueError(f"no camera sees a ball beyond {_FARTHEST_M:g} m")
            if np.linalg.eigvalsh(seen.covariance_m2)[0] <= 0.0:
                raise ValueError("the covariance of the centre is not positive")
            _check_patches(seen.patches)
            return seen
        except (KeyError, TypeError, ValueError, ArithmeticError) as cause:
            raise FormatError(f"a ball detection cannot be read ({cause})") from None


@dataclass(frozen=True, slots=True)
class PlaneObservation:
    """A flat surface in one camera's (averaged) depth image, before any depth correction."""

    camera: str
    surface: str
    """FLOOR, or the wall's name; a board that is moved is another wall at each place."""
    points: int
    patches: Array
    """(k, 4): u, v (pixels), inverse depth (1/m), its variance (1/m2)."""

    def to_json(self) -> dict[str, Any]:
        return {
            "camera": self.camera,
            "surface": self.surface,
            "points": self.points,
            "patches": _rounded(self.patches),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """The observation of its JSON.

        Raises:
            FormatError: a field is missing or is not what it should be.
        """
        try:
            seen = cls(
                camera=str(document["camera"]),
                surface=str(document["surface"]),
                points=int(document["points"]),
                patches=finite_numbers(document["patches"], (None, 4)),
            )
            if len(seen.patches) < _FEWEST_PATCHES:
                raise ValueError(f"{_FEWEST_PATCHES} patches are needed, not {len(seen.patches)}")
            _check_patches(seen.patches)
            return seen
        except (KeyError, TypeError, ValueError, ArithmeticError) as cause:
            raise FormatError(f"a plane observation cannot be read ({cause})") from None


@dataclass(frozen=True, slots=True)
class Observations:
    """All that a calibration is solved from."""

    balls: Sequence[BallDetection]
    """The waved ball, in any order."""
    mark: Sequence[BallDetection] = field(default_factory=tuple)
    """The ball resting on the mark."""
    front: Sequence[BallDetection] = field(default_factory=tuple)
    """The ball resting on the floor in front of the mark; gives the heading where present."""
    planes: Sequence[PlaneObservation] = field(default_factory=tuple)
    around: Mapping[str, Sequence[BallDetection]] = field(default_factory=dict)
    """The ball resting elsewhere: name of the place -> detections."""
    depth_changes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Step -> camera -> relative change of its depths since the empty booth was recorded."""

    @classmethod
    def merged(cls, parts: Iterable[Self]) -> Self:
        """The observations of several cameras of one calibration."""
        listed = list(parts)
        places = dict.fromkeys(place for part in listed for place in part.around)
        return cls(
            balls=[one for part in listed for one in part.balls],
            mark=[one for part in listed for one in part.mark],
            front=[one for part in listed for one in part.front],
            planes=[one for part in listed for one in part.planes],
            around={
                place: [one for part in listed for one in part.around.get(place, ())]
                for place in places
            },
        )


def _check_patches(patches: Array) -> None:
    """Refuse patches (k, 4) that no camera gives.

    Raises:
        ValueError: a depth, or its variance.
    """
    inverse, variance = patches[:, 2], patches[:, 3]
    if np.any(inverse < 1.0 / _FARTHEST_M) or np.any(inverse > 1.0 / _NEAREST_M):
        raise ValueError(f"depths lie between {_NEAREST_M:g} and {_FARTHEST_M:g} m")
    if np.any(variance < _LEAST_VARIANCE) or np.any(variance > 1.0 / _NEAREST_M**2):
        raise ValueError("no sensor has such a variance of an inverse depth")


def _rounded(patches: Array) -> list[list[float]]:
    """Seven digits, far finer than a reading."""
    return [[float(f"{x:.7g}") for x in patch] for patch in patches.tolist()]


def finite_numbers(values: Any, shape: tuple[int | None, ...]) -> Array:
    """An array of some shape; None in it stands for any length.

    Raises:
        ValueError: the values have another shape, or are not finite.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != len(shape) or any(
        want not in (None, have) for want, have in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"{shape} numbers were expected, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("it holds numbers that are not finite")
    return array
