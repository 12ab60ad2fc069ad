"""The calibration itself: every camera's lens, depth correction and place in the world.

Reads and writes ``calibration.json`` (format "booth-calibration", version 1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.core.errors import CalibrationError, FormatError
from station.core.files import read_json, write_json

FORMAT = "booth-calibration"
VERSIONS = frozenset({1})
MAX_PIXELS = 4096
"""On a side of a depth image; no depth sensor has more."""
_ROTATION_TOLERANCE = 1e-4

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DepthCorrection:
    """A camera's systematic depth error, z in metres.

    1/z_true = sum_i a_i (1/z_measured)^i + g . (x, y), with x and y from -1 to 1 over the image's
    width and height.
    """

    coefficients: tuple[float, ...] = ()
    """(a0, a1, ...); empty = no correction."""
    image_gradient: tuple[float, float] = (0.0, 0.0)
    """(gx, gy), 1/m: how much the error changes from the image's middle to its edges."""

    def apply(self, depth_m: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Corrected depths, same shape and type; 0 (no reading) stays 0.

        Where there is an image gradient, depth_m must be a whole image (h, w).
        """
        if not self.coefficients:
            return depth_m
        seen = depth_m > 0
        inverse = 1.0 / np.where(seen, depth_m, 1.0)
        corrected = np.polynomial.polynomial.polyval(inverse, self.coefficients)
        if any(self.image_gradient):
            height, width = depth_m.shape
            gx, gy = self.image_gradient
            corrected = corrected + gx * np.linspace(-1.0, 1.0, width, dtype=np.float32)
            corrected += gy * np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
        # A correction extrapolated beyond its depths must not give points behind the camera.
        usable = seen & (corrected > 0)
        return np.where(usable, 1.0 / np.where(usable, corrected, 1.0), 0.0).astype(depth_m.dtype)

    def to_json(self) -> dict[str, Any]:
        if not self.coefficients:
            return {"model": "none"}
        document = {"model": "inverse-depth-poly", "coefficients": list(self.coefficients)}
        if any(self.image_gradient):
            document["image_gradient"] = list(self.image_gradient)
        return document


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """One depth camera. Camera frame after OpenCV: x right, y down, z forward."""

    name: str
    serial: str
    model: str
    width: int
    height: int
    K: Array
    """Intrinsics, 3x3, pixels."""
    distortion: Array
    """(k1, k2, p1, p2, k3) after OpenCV."""
    depth_correction: DepthCorrection
    world_from_camera: Array
    """4x4 rigid, metres."""
    covariance: Array | None = None
    """6x6 of xi = (rotation vector, translation) in ``world_from_camera @ se3_exp(xi)``."""

    def to_json(self) -> dict[str, Any]:
        return {
            "serial": self.serial,
            "model": self.model,
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "distortion": self.distortion.tolist(),
            "depth_correction": self.depth_correction.to_json(),
            "world_from_camera": self.world_from_camera.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
        }


@dataclass(frozen=True, slots=True)
class Rig:
    """All cameras of a booth in one world frame (z up, floor z = 0, the subject faces -y)."""

    created: str
    """UTC, ISO 8601."""
    reference: str
    cameras: Mapping[str, CameraCalibration]
    residual_rms_m: float

    def camera(self, name: str, source: str = "the calibration") -> CameraCalibration:
        """A camera by name.

        Raises:
            CalibrationError: naming the camera and those that there are.
        """
        try:
            return self.cameras[name]
        except KeyError:
            known = ", ".join(self.cameras) or "none"
            raise CalibrationError(
                f"camera {name} is not in {source} (it has: {known}); calibrate the booth again"
            ) from None

    def to_json(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "version": 1,
            "created": self.created,
            "reference": self.reference,
            "cameras": {name: camera.to_json() for name, camera in self.cameras.items()},
            "residual_rms_m": self.residual_rms_m,
        }

    def save(self, path: Path) -> None:
        """Write the calibration durably; an existing file is replaced in one step."""
        write_json(path, self.to_json())

    @classmethod
    def load(cls, path: Path) -> Rig:
        """Read and check a calibration file.

        Raises:
            FormatError: naming the file, the camera and the field that cannot be used.
        """
        if not path.exists():
            raise FormatError(f"{path} is missing; make it with: station calibrate")
        document = read_json(path, format=FORMAT, versions=VERSIONS)
        try:
            cameras = {
                str(name): _camera(str(name), fields)
                for name, fields in document["cameras"].items()
            }
            rig = cls(
                created=str(document["created"]),
                reference=str(document["reference"]),
                cameras=cameras,
                residual_rms_m=float(document["residual_rms_m"]),
            )
        except KeyError as missing:
            raise FormatError(f"{path}: the field {missing} is missing; calibrate again") from None
        except (ValueError, TypeError, AttributeError, OverflowError) as cause:
            raise FormatError(f"{path}: {cause}; calibrate again") from None
        if not rig.cameras:
            raise FormatError(f"{path}: it contains no camera; calibrate again")
        return rig


def _camera(name: str, fields: Mapping[str, Any]) -> CameraCalibration:
    def matrix(key: str, shape: tuple[int, ...]) -> Array:
        values = np.asarray(fields[key], dtype=np.float64)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"camera {name}: {key} must be {shape} finite numbers")
        return values

    pose = matrix("world_from_camera", (4, 4))
    rotation = pose[:3, :3]
    if (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
        or np.abs(pose[3] - (0, 0, 0, 1)).max() > _ROTATION_TOLERANCE
    ):
        raise ValueError(f"camera {name}: world_from_camera is not a rigid transform")
    K = matrix("K", (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"camera {name}: K must have positive focal lengths")
    width, height = int(fields["width"]), int(fields["height"])
    if not (0 < width <= MAX_PIXELS and 0 < height <= MAX_PIXELS):
        raise ValueError(f"camera {name}: width and height must lie between 1 and {MAX_PIXELS}")
    return CameraCalibration(
        name=name,
        serial=str(fields["serial"]),
        model=str(fields["model"]),
        width=width,
        height=height,
        K=K,
        distortion=matrix("distortion", (5,)),
        depth_correction=_correction(name, fields["depth_correction"]),
        world_from_camera=pose,
        covariance=_covariance(name, fields, matrix),
    )


def _covariance(
    name: str, fields: Mapping[str, Any], matrix: Callable[[str, tuple[int, ...]], Array]
) -> Array | None:
    if fields.get("covariance") is None:
        return None
    found = matrix("covariance", (6, 6))
    scale = max(float(np.abs(found).max()), 1e-30)
    if np.abs(found - found.T).max() > 1e-6 * scale or np.linalg.eigvalsh(found)[0] < -1e-6 * scale:
        raise ValueError(f"camera {name}: covariance is not symmetric and positive")
    return found


def _correction(name: str, fields: Mapping[str, Any]) -> DepthCorrection:
    model = fields.get("model")
    if model == "none":
        return DepthCorrection()
    if model == "inverse-depth-poly":
        coefficients = tuple(float(value) for value in fields["coefficients"])
        if not coefficients or not np.isfinite(coefficients).all():
            raise ValueError(f"camera {name}: depth_correction needs finite coefficients")
        gradient = tuple(float(value) for value in fields.get("image_gradient", (0.0, 0.0)))
        if len(gradient) != 2 or not np.isfinite(gradient).all():
            raise ValueError(f"camera {name}: image_gradient must be two finite numbers")
        return DepthCorrection(coefficients, (gradient[0], gradient[1]))
    raise ValueError(
        f"camera {name}: depth_correction model {model!r} is unknown "
        "(known: none, inverse-depth-poly)"
    )
