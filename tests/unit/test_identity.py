"""Cameras and sensors that are not those of a calibration are named, and nothing else is."""

from __future__ import annotations

import pytest

from station.core.drivers import CameraConfig
from station.sensors.freenect import FreenectCamera
from station.sensors.identity import configured_serials, differences

CALIBRATED = {"front": "A1", "back": "A2", "side": "replayed:side"}


@pytest.mark.parametrize(
    ("found", "told"),
    [
        (CALIBRATED, []),
        # What plays a recording, or has no number in booth.toml, may be any sensor.
        ({"front": "recorded:monday", "back": "", "side": "A3"}, []),
        (
            {"front": "A1", "side": ""},
            ["camera back was calibrated and is not in booth.toml"],
        ),
        (
            {"side": ""},
            ["cameras front, back were calibrated and are not in booth.toml"],
        ),
        ({**CALIBRATED, "top": "A4"}, ["camera top is in booth.toml and was not calibrated"]),
        (
            {**CALIBRATED, "top": "A4", "low": ""},
            ["cameras top, low are in booth.toml and were not calibrated"],
        ),
        (
            {**CALIBRATED, "front": "A2", "back": "A1"},
            [
                "camera front is sensor A2, but A1 was calibrated",
                "camera back is sensor A1, but A2 was calibrated",
            ],
        ),
    ],
)
def test_what_differs_is_named(found: dict[str, str], told: list[str]) -> None:
    assert differences(CALIBRATED, found) == told


def test_not_every_drivers_cameras_have_serial_numbers() -> None:
    front = FreenectCamera(name="front", serial="A1")
    cameras = [front, CameraConfig(name="back", driver="other")]
    assert configured_serials(cameras) == {"front": "A1", "back": ""}
