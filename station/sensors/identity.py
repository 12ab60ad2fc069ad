"""Whether cameras and sensors are those of a calibration (pure)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from station.core.drivers import CameraConfig
from station.core.rig import CameraCalibration
from station.sensors.base import is_serial

_REMEDY = "put the sensors and booth.toml back as they were, or run station calibrate"


def mismatch(calibrated: Mapping[str, str], found: Mapping[str, str]) -> str:
    """All `differences` and what to do about them; empty where there are none."""
    others = differences(calibrated, found)
    return "; ".join([*others, _REMEDY]) if others else ""


def differences(calibrated: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Sentences on cameras and sensors that are not those of a calibration; none if all are.

    Args:
        calibrated, found: camera -> serial number, when it was calibrated and now. What names no
            device is not compared.
    """
    sentences = []
    if gone := [name for name in calibrated if name not in found]:
        sentences.append(
            f"camera {gone[0]} was calibrated and is not in booth.toml"
            if len(gone) == 1
            else f"cameras {', '.join(gone)} were calibrated and are not in booth.toml"
        )
    if new := [name for name in found if name not in calibrated]:
        sentences.append(
            f"camera {new[0]} is in booth.toml and was not calibrated"
            if len(new) == 1
            else f"cameras {', '.join(new)} are in booth.toml and were not calibrated"
        )
    for name, serial in found.items():
        known = calibrated.get(name, "")
        if is_serial(serial) and is_serial(known) and serial != known:
            sentences.append(f"camera {name} is sensor {serial}, but {known} was calibrated")
    return sentences


def configured_serials(cameras: Iterable[CameraConfig]) -> dict[str, str]:
    """Camera -> serial number that booth.toml gives; empty where the driver's cameras have none."""
    serials = {camera.name: getattr(camera, "serial", None) for camera in cameras}
    return {name: serial if isinstance(serial, str) else "" for name, serial in serials.items()}


def calibrated_serials(cameras: Mapping[str, CameraCalibration]) -> dict[str, str]:
    """Camera -> serial number of the sensor that was calibrated."""
    return {name: camera.serial for name, camera in cameras.items()}
