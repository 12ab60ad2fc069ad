"""Which driver a camera's configuration names."""

from __future__ import annotations

from station.core.config import CameraConfig
from station.sensors.base import DepthDriver


def make_driver(camera: CameraConfig) -> DepthDriver:
    """The driver of a camera, not yet opened; only the one in use is imported."""
    if camera.driver == "freenect":
        from station.sensors.freenect import FreenectDriver

        return FreenectDriver(camera.serial, camera.recording)
    if camera.driver == "recorded":
        from station.sensors.recorded import RecordedDriver

        assert camera.recording is not None
        return RecordedDriver(camera.recording, camera.serial)
    from station.simulation.sensor import VirtualDriver

    assert camera.body is not None
    return VirtualDriver(camera.name, camera.body, camera.seed)
