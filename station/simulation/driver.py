"""The virtual Kinect as a driver: `driver = "virtual"` in a camera's section of booth.toml."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from station.core.drivers import CameraConfig, ConfigPath
from station.core.errors import DriverError
from station.core.kinect_v1 import DEPTH_SCALE_M, FRAME_RATE_HZ, TICK_BITS, TICK_HZ, depth_of_raw
from station.sensors.base import DepthFrame, DeviceInfo
from station.sensors.recorded import RecordedCamera

if TYPE_CHECKING:
    from station.simulation.sensor import VirtualFrame

_LOOP_FRAMES = 24


class SimulatedCamera(CameraConfig):
    """A camera of the virtual booth, with a person in front of it."""

    driver: str = "virtual"
    body: ConfigPath = Field(description="the virtual person's mesh, metres, z up")
    seed: int = Field(default=0, ge=0, description="of the simulated noise and clock")

    def replaying(self, recording: Path) -> CameraConfig:
        return RecordedCamera(name=self.name, recording=recording)


class VirtualDriver:
    """A simulated sensor in real time: a loop of frames is rendered once, then played."""

    Config = SimulatedCamera

    def __init__(self, camera: SimulatedCamera) -> None:
        self._name, self._body, self._seed = camera.name, camera.body, camera.seed
        self._loop: list[VirtualFrame] = []
        self._start_s = 0.0
        self._sequence = 0

    def open(self) -> DeviceInfo:
        # The ray caster is 230 MB: it is imported only when a simulated sensor is opened.
        from station.simulation.scene import load_mesh
        from station.simulation.sensor import SimulatedBooth, VirtualCamera

        booth = SimulatedBooth(seed=self._seed)
        if self._name not in booth.rig.cameras:
            known = ", ".join(booth.rig.cameras)
            raise DriverError(f"camera {self._name}: the virtual booth has only {known}")
        camera = VirtualCamera(booth, self._name, load_mesh(self._body))
        self._loop = list(camera.frames(_LOOP_FRAMES))
        self._unit = camera.unit
        self._start_s = time.monotonic() + camera.unit.phase_s
        self._sequence = 0
        calibration = booth.rig.cameras[self._name]
        return DeviceInfo(
            serial=calibration.serial,
            model="virtual",
            width=calibration.width,
            height=calibration.height,
            K=calibration.K,
            distortion=calibration.distortion,
            depth_scale_m=DEPTH_SCALE_M,
            tick_hz=TICK_HZ,
            tick_bits=TICK_BITS,
        )

    def read(self, timeout_s: float) -> DepthFrame | None:
        due_s = self._sequence / FRAME_RATE_HZ
        wait_s = self._start_s + due_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait_s, 0.0))
        frame = self._loop[self._sequence % len(self._loop)]
        ticks = self._unit.ticks(self._unit.phase_s + due_s)
        result = DepthFrame(depth_of_raw(frame.raw), ticks, time.monotonic(), self._sequence)
        self._sequence += 1
        return result

    def close(self) -> None:
        self._loop = []
