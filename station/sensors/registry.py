"""The driver that a camera's configuration names, as an object."""

from __future__ import annotations

from station.core.drivers import CameraConfig, driver_class
from station.sensors.base import DepthDriver


def make_driver(camera: CameraConfig) -> DepthDriver:
    """The driver of a camera, not yet opened.

    Raises:
        ConfigError: no driver of that name is installed.
    """
    driver: DepthDriver = driver_class(camera.driver)(camera)
    return driver
