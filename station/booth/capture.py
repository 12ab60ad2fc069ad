"""The capture process: one sensor through its driver, its frames published as they arrive."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path

import click
import zmq

from station.core.commands import config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import DriverError, FormatError
from station.core.service import Heartbeat, only_process, stop_event
from station.messaging.messages import CameraHealth, DesiredState, FrameHeader, SensorInfo
from station.messaging.topics import TOPICS
from station.messaging.transport import publisher, subscriber
from station.sensors.base import DepthDriver, DepthFrame, DeviceInfo
from station.sensors.clock import DeviceClock
from station.sensors.registry import make_driver

_READ_TIMEOUT_S = 0.1
_BACK_OFF_S = (0.2, 0.5, 1.0, 2.0, 5.0)
_OPENING_S = 60.0
"""Opening a USB sensor may take seconds; a simulated one is rendered first."""


class CaptureProcess:
    """Follows the desired state: opens, publishes, reconnects, closes."""

    def __init__(self, config: BoothConfig, name: str, log: logging.Logger) -> None:
        self._camera = config.camera(name)
        self._name, self._log = name, log
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        folder = config.runtime.folder
        self._out = publisher(self._context, folder, f"camera-{name}", "depth")
        self._wishes = subscriber(self._context, folder, ["desired"], ["desired"])
        self._topic, self._health_topic = f"depth/{name}".encode(), f"health/{name}".encode()
        self._sensor_topic = f"sensor/{name}".encode()
        self._streaming = False
        self._driver: DepthDriver | None = None
        self._info: DeviceInfo | None = None
        self._clock: DeviceClock | None = None
        self._past_resets = 0
        self._state, self._detail = "off", ""
        self._failures = 0
        self._open_at_s = 0.0
        self._told_s = 0.0
        self._frames = self._lost = 0
        self._last_sequence: int | None = None
        self._unreadable = 0
        self._heart = Heartbeat(folder, f"capture {name}")

    def run(self, stop: threading.Event) -> None:
        """Run until told to stop."""
        self._heart.ready()
        try:
            while not stop.is_set():
                self._heart.beat()
                self._follow_desired_state()
                if not self._streaming:
                    self._close("off")
                    stop.wait(_READ_TIMEOUT_S)
                elif self._driver is None:
                    self._open(stop)
                else:
                    self._read()
                self._report_health()
        finally:
            self._close("off")
            self._context.destroy(linger=0)

    def _follow_desired_state(self) -> None:
        while self._wishes.poll(0):
            try:
                wish = DesiredState.unpack(self._wishes.recv_multipart()[-1])
            except FormatError as error:
                self._unreadable += 1
                self._log.warning("%s", error)
                continue
            self._streaming = wish.streaming

    def _open(self, stop: threading.Event) -> None:
        if time.monotonic() < self._open_at_s:
            stop.wait(_READ_TIMEOUT_S)
            return
        if not self._failures:  # else it stays lost, for the reason that is known
            self._state, self._detail = "opening", ""
        self._report_health(now=True)
        driver = make_driver(self._camera)
        self._heart.allow(_OPENING_S)
        try:
            self._info = driver.open()
        except DriverError as error:
            self._failed(driver, error)
            return
        finally:
            self._heart.allow(None)
        self._driver = driver
        if self._clock is not None:
            # A reconnected sensor may start counting anywhere.
            self._past_resets = self._clock_resets() + 1
        self._clock = DeviceClock(self._info.tick_hz, self._info.tick_bits)
        self._last_sequence = None
        self._report_health(now=True)
        self._log.info("streaming from %s", self._info.serial)

    def _read(self) -> None:
        assert self._driver is not None
        try:
            frame = self._driver.read(_READ_TIMEOUT_S)
        except DriverError as error:
            self._failed(self._driver, error)
            return
        if frame is not None:
            first = self._state != "streaming"
            self._state, self._detail, self._failures = "streaming", "", 0
            self._publish(frame)
            if first:
                self._report_health(now=True)

    def _publish(self, frame: DepthFrame) -> None:
        info, clock = self._info, self._clock
        assert info is not None
        assert clock is not None
        if self._last_sequence is not None:
            self._lost += max(0, frame.sequence - self._last_sequence - 1)
        self._last_sequence = frame.sequence
        self._frames += 1
        header = FrameHeader(
            camera=self._name,
            serial=info.serial,
            width=info.width,
            height=info.height,
            depth_scale_m=info.depth_scale_m,
            device_ticks=frame.device_ticks,
            tick_hz=info.tick_hz,
            host_time_s=clock.host_time_s(frame.device_ticks, frame.received_s),
            received_s=frame.received_s,
            sequence=self._frames + self._lost,
            clock_resets=self._clock_resets(),
        )
        self._out.send_multipart([self._topic, header.pack(), frame.depth.data], copy=False)

    def _clock_resets(self) -> int:
        return self._past_resets + (0 if self._clock is None else self._clock.resets)

    def _failed(self, driver: DepthDriver, error: DriverError) -> None:
        driver.close()
        self._driver = None
        wait_s = _BACK_OFF_S[min(self._failures, len(_BACK_OFF_S) - 1)]
        self._failures += 1
        self._open_at_s = time.monotonic() + wait_s
        self._state, self._detail = "lost", str(error)
        self._log.warning("%s; retrying in %.1f s", error, wait_s)
        self._report_health(now=True)

    def _close(self, state: str) -> None:
        if self._driver is not None:
            self._driver.close()
            self._driver = None
        self._state, self._detail, self._failures, self._open_at_s = state, "", 0, 0.0

    def _report_health(self, now: bool = False) -> None:
        moment = time.monotonic()
        if not now and moment - self._told_s < 1.0 / TOPICS["health"].rate_hz:
            return
        self._told_s = moment
        health = CameraHealth(
            self._name, self._state, self._detail, self._frames, self._lost, self._clock_resets()
        )
        self._out.send_multipart([self._health_topic, health.pack()])
        if self._info is not None:
            self._out.send_multipart([self._sensor_topic, self._sensor(self._info).pack()])
        self._heart.report(
            {
                "state": self._state,
                "detail": self._detail,
                "frames": self._frames,
                "lost": self._lost,
                "clock_resets": self._clock_resets(),
                "clock_offset_s": clock.offset_s if (clock := self._clock) else None,
                "clock_drift": clock.drift if clock else None,
                "unreadable_messages": self._unreadable,
            }
        )

    def _sensor(self, info: DeviceInfo) -> SensorInfo:
        return SensorInfo(
            camera=self._name,
            serial=info.serial,
            model=info.model,
            width=info.width,
            height=info.height,
            K=info.K.tolist(),
            distortion=info.distortion.tolist(),
            depth_scale_m=info.depth_scale_m,
            tick_hz=info.tick_hz,
            tick_bits=info.tick_bits,
        )


@click.command()
@click.argument("camera")
@config_option
def capture(camera: str, config_path: Path | None) -> None:
    """Read one sensor and publish its frames; `station run` starts one for each camera.

    \b
    Examples:
      station capture front-upper --config booth.toml
    """
    config = load_config(find_config(config_path))
    config.camera(camera)
    _discard_stdout()
    with only_process(config.runtime.folder, f"capture {camera}") as log:
        CaptureProcess(config, camera, log).run(stop_event())


def _discard_stdout() -> None:
    """Libraries of sensors print there: libfreenect's replay library at each recording's end."""
    with Path(os.devnull).open("wb") as nothing:
        os.dup2(nothing.fileno(), 1)
