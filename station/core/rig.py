"""The calibration: every camera's lens, depth correction and pose in the world.

Reads and writes ``calibration.json`` (format "booth-calibration", version 1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.core.depth.correction import DepthCorrection
from station.core.depth.intrinsics import check_intrinsics
from station.core.depth.json_values import array_of, number, text
from station.core.errors import CalibrationError, FormatError
from station.core.files import read_json, write_json
from station.core.geometry import is_rigid

FORMAT = "booth-calibration"
VERSIONS = frozenset({1})
MAX_PIXELS = 4096
"""On a side of a depth image; no depth sensor has more."""
_FARTHEST_M = 100.0
"""A booth is a room."""
_LARGEST_ERROR_M, _LARGEST_ERROR_RAD = 1.0, float(np.pi)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PredictedError:
    """Standard deviations of what the calibration alone adds to a scan, from its covariance."""

    height_sigma_m: float
    """Height of a person of 1.75 m."""
    girth_sigma_m: float
    """Girth of 1 m: the largest of those at chest, waist and hip."""
    normal_rms_m: float
    """The cloud along the surface's normal, rms over a standing body that is put back where it
    stood."""
    tilt_sigma_rad: float
    """The world's vertical."""

    def widened(self, off_m: float) -> PredictedError:
        """The same with another error, of this standard deviation along an axis, of where cameras
        see a body; a camera sees half of a girth."""
        return PredictedError(
            float(np.hypot(self.height_sigma_m, off_m)),
            float(np.hypot(self.girth_sigma_m, np.pi * off_m)),
            float(np.hypot(self.normal_rms_m, off_m)),
            self.tilt_sigma_rad,
        )

    def to_json(self) -> dict[str, float]:
        return {
            "height_sigma_m": self.height_sigma_m,
            "girth_sigma_m": self.girth_sigma_m,
            "normal_rms_m": self.normal_rms_m,
            "tilt_sigma_rad": self.tilt_sigma_rad,
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> PredictedError:
        names = ("height_sigma_m", "girth_sigma_m", "normal_rms_m", "tilt_sigma_rad")
        if not isinstance(fields, Mapping):
            raise ValueError(f"predicted must hold {', '.join(names)}")
        values = [number(f"predicted: {name}", fields[name]) for name in names]
        for name, value in zip(names, values, strict=True):
            most = _LARGEST_ERROR_RAD if name.endswith("rad") else _LARGEST_ERROR_M
            if not 0.0 <= value <= most:
                raise ValueError(f"predicted: {name} must lie between 0 and {most:.4g}")
        return cls(*values)


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
    """All cameras of a booth in one world frame (z up, floor z = 0, the person faces -y)."""

    created: str
    """UTC, ISO 8601."""
    reference: str
    cameras: Mapping[str, CameraCalibration]
    residual_rms_m: float
    predicted: PredictedError | None = None
    """None in files of older versions, which did not predict anything."""

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
        document = {
            "format": FORMAT,
            "version": 1,
            "created": self.created,
            "reference": self.reference,
            "cameras": {name: camera.to_json() for name, camera in self.cameras.items()},
            "residual_rms_m": self.residual_rms_m,
        }
        if self.predicted is not None:
            document["predicted"] = self.predicted.to_json()
        return document

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
            rig = cls(
                created=text("created", document["created"]),
                reference=text("reference", document["reference"]),
                cameras=_cameras(document["cameras"]),
                residual_rms_m=number("residual_rms_m", document["residual_rms_m"]),
                predicted=(
                    PredictedError.from_json(document["predicted"])
                    if document.get("predicted") is not None
                    else None
                ),
            )
            rig._check()
        except KeyError as missing:
            raise FormatError(f"{path}: the field {missing} is missing; calibrate again") from None
        except ValueError as cause:
            raise FormatError(f"{path}: {cause}; calibrate again") from None
        return rig

    def _check(self) -> None:
        if not self.cameras:
            raise ValueError("it contains no camera")
        if self.reference not in self.cameras:
            known = ", ".join(self.cameras)
            raise ValueError(f"reference {self.reference!a:.80} is none of its cameras ({known})")
        if not 0.0 <= self.residual_rms_m < np.inf:
            raise ValueError("residual_rms_m must be finite and not negative")


def _expect(met: bool | np.bool_, camera: str, words: str) -> None:
    if not met:
        raise ValueError(f"camera {camera}: {words}")


def _cameras(found: object) -> dict[str, CameraCalibration]:
    if not isinstance(found, dict):
        raise ValueError('cameras must be named, as in {"front-upper": {...}}')
    cameras = {}
    for name, fields in found.items():
        # Its frames lie in a folder of this name.
        if name in ("", ".", "..") or set(name) & {"/", "\\"} or not name.isprintable():
            raise ValueError(
                f"camera {name!a:.80}: its name must be one of a folder, without / and \\"
            )
        _expect(isinstance(fields, dict), name, "it must have named fields, as K")
        try:
            cameras[name] = _camera(name, fields)
        except KeyError as missing:
            raise ValueError(f"camera {name}: the field {missing} is missing") from None
    return cameras


def _camera(name: str, fields: Mapping[str, Any]) -> CameraCalibration:
    def matrix(key: str, shape: tuple[int, ...]) -> Array:
        values = array_of(fields[key])
        if values is None or values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"camera {name}: {key} must be {shape} finite numbers")
        return values

    pose = matrix("world_from_camera", (4, 4))
    _expect(is_rigid(pose), name, "world_from_camera is not a rigid transform")
    near = (np.abs(pose[:3, 3]) <= _FARTHEST_M).all()
    _expect(near, name, f"world_from_camera must lie within {_FARTHEST_M:g} m of the mark")
    sizes = array_of([fields["width"], fields["height"]])
    if (
        sizes is None
        or sizes.shape != (2,)
        or not all(0 < size <= MAX_PIXELS and size % 1 == 0 for size in sizes)
    ):
        raise ValueError(
            f"camera {name}: width and height must be whole numbers from 1 to {MAX_PIXELS}"
        )
    width, height = (int(fields[side]) for side in ("width", "height"))
    K, distortion = matrix("K", (3, 3)), matrix("distortion", (5,))
    try:
        check_intrinsics(K, distortion, width, height)
        correction = DepthCorrection.from_json(fields["depth_correction"])
    except ValueError as cause:
        raise ValueError(f"camera {name}: {cause}") from None
    return CameraCalibration(
        name=name,
        serial=text(f"camera {name}: serial", fields["serial"] or ""),
        model=text(f"camera {name}: model", fields["model"]),
        width=width,
        height=height,
        K=K,
        distortion=distortion,
        depth_correction=correction,
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
