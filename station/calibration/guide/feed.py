"""The cameras' frames for calibration and checks: live ones of the running booth, or recordings
replayed through the same capture processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from station.calibration.detect.detections import uncalibrated
from station.calibration.guide.recorded_clock import RecordedClock
from station.core.config import BoothConfig
from station.core.errors import CalibrationError
from station.core.kinect_v1 import depth_of_raw
from station.core.rig import CameraCalibration
from station.core.service import die_with_parent
from station.messaging.asking import RefusedError, command
from station.messaging.intake import FrameIntake, LiveFrame
from station.messaging.messages import DesiredState, Request
from station.messaging.topics import TOPICS
from station.messaging.transport import publisher
from station.sensors.base import DeviceInfo
from station.sensors.recording import read_raw

_POLL_S = 0.05
_WAITING = 120
"""Frames that may wait; each is 0.6 MB. Of a replay further ones are read from disk again."""
_NOT_HELD = np.zeros((0, 0), np.uint16)
_STOP_S = 5.0
_GATHER_S = 20.0


@dataclass(frozen=True, slots=True)
class TimedFrame:
    """One depth image, with its time on a clock that all cameras share."""

    camera: str
    time_s: float
    depth: NDArray[np.uint16]
    """(height, width) in units of scale_m, 0 = no reading; empty where only `pixels` has it."""
    scale_m: float
    clock_resets: int = 0
    """Number of resets of the camera's clock so far."""
    file: Path | None = None
    """The frame in its recording, where it is replayed."""

    def pixels(self) -> NDArray[np.uint16]:
        """``depth``, from its file where it is not held."""
        if self.depth.size or self.file is None:
            return self.depth
        return depth_of_raw(read_raw(self.file))

    def depth_m(self) -> NDArray[np.float32]:
        return self.pixels().astype(np.float32) * np.float32(self.scale_m)

    def on_disk(self) -> TimedFrame:
        """The same frame without its pixels, if these can be read again."""
        if self.file is None:
            return self
        return replace(self, depth=_NOT_HELD)


class Feed:
    """The newest frame of each camera. Use it in a ``with`` statement."""

    def __init__(
        self, config: BoothConfig, clocks: Mapping[str, RecordedClock] | None = None
    ) -> None:
        """``clocks``: of recordings that are replayed; their replay is started here."""
        self._config, self._clocks = config, dict(clocks or {})
        self._names = [camera.name for camera in config.cameras]
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        folder = config.runtime.folder
        self._wishes = publisher(self._context, folder, "desired", "desired") if clocks else None
        self._intake = FrameIntake(self._context, folder, self._names)
        self._wished_s = 0.0
        self._waiting: deque[TimedFrame] = deque(maxlen=None if clocks else _WAITING)

    def __enter__(self) -> Feed:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(linger=0)

    @property
    def replays(self) -> bool:
        """True for recordings, false for live cameras."""
        return bool(self._clocks)

    @property
    def over(self) -> bool:
        """All recordings have been seen once and no frame waits; live cameras never end."""
        ended = bool(self._clocks) and all(clock.over for clock in self._clocks.values())
        return ended and not self._waiting

    def cameras(self, timeout_s: float) -> dict[str, CameraCalibration]:
        """Every camera as it comes from the factory, once all of them give frames.

        Raises:
            CalibrationError: naming the cameras that give none, and why.
        """
        if not self._clocks:
            try:
                command(self._config, Request("start"), repeats=True)
            except RefusedError as refused:
                raise CalibrationError(str(refused)) from None
        deadline_s = time.monotonic() + timeout_s
        while missing := [
            name
            for name in self._names
            if name not in self._intake.sensors or name not in self._intake.last_frame_s
        ]:
            if time.monotonic() > deadline_s:
                why = "; ".join(f"camera {name} {self._why(name)}" for name in missing)
                raise CalibrationError(f"{why}; {self._remedy(missing)}")
            self._receive(_POLL_S)
        return {
            name: uncalibrated(
                name,
                DeviceInfo(
                    serial=sensor.serial,
                    model=sensor.model,
                    width=sensor.width,
                    height=sensor.height,
                    K=np.array(sensor.K),
                    distortion=np.array(sensor.distortion),
                    depth_scale_m=sensor.depth_scale_m,
                    tick_hz=sensor.tick_hz,
                    tick_bits=sensor.tick_bits,
                ),
            )
            for name, sensor in ((name, self._intake.sensors[name]) for name in self._names)
        }

    def frames(self, timeout_s: float = 0.2) -> list[TimedFrame]:
        """All frames since the last call, but no more than a few seconds of them.

        Raises:
            CalibrationError: a camera has gone silent.
        """
        self._receive(timeout_s)
        now_s = time.monotonic()
        limit_s, last_s = self._config.sync.silent_after_s, self._intake.last_frame_s
        ended = {name for name, clock in self._clocks.items() if clock.over}
        silent = [name for name in last_s if now_s - last_s[name] > limit_s and name not in ended]
        if silent:
            why = "; ".join(f"camera {name} {self._why(name)}" for name in silent)
            again = "run the same command again; it goes on from what is kept"
            raise CalibrationError(f"{why}; {self._remedy(silent)}; {again}")
        taken = list(self._waiting)
        self._waiting.clear()
        return taken

    def newest(self) -> list[TimedFrame]:
        """The newest frame of each camera since the last call, for callers slower than the cameras.

        Of a replay all frames, so that the result does not depend on the machine's speed.
        """
        frames = self.frames()
        return frames if self._clocks else list({frame.camera: frame for frame in frames}.values())

    def _why(self, name: str) -> str:
        return f"gives no frames{self._intake.why(name)}"

    def _remedy(self, silent: Sequence[str]) -> str:
        if self.replays:
            return "stop other programs: the computer may be too busy for a replay"
        if 1 < len(silent) == len(self._names):
            return "stop other programs if the computer is busy; check the cameras' power supply"
        return "check its cable, see station status"

    def _receive(self, timeout_s: float) -> None:
        """Take all that has come; wait for the first of it."""
        self._wish()
        for live in self._intake.frames(timeout_s):
            for frame in self._timed(live):
                self._waiting.append(frame if len(self._waiting) < _WAITING else frame.on_disk())

    def _timed(self, live: LiveFrame) -> list[TimedFrame]:
        """A frame that has come; before it those of its recording that came too fast."""
        header, scale_m = live.header, live.header.depth_scale_m
        clock = self._clocks.get(header.camera)
        if clock is None:
            resets = header.clock_resets
            return [TimedFrame(header.camera, header.host_time_s, live.depth, scale_m, resets)]
        # Replays have the clocks of their recordings, whatever becomes of the replay's.
        held = {header.device_ticks: live.depth}
        return [
            TimedFrame(header.camera, time_s, held.get(ticks, _NOT_HELD), scale_m, file=file)
            for ticks, time_s, file in clock.frames(header)
        ]

    def _wish(self) -> None:
        """Capture processes of a replay have no control that tells them to stream."""
        if self._wishes is None or set(self._intake.health) != set(self._names):
            return
        now_s = time.monotonic()
        if now_s - self._wished_s > 1.0 / TOPICS["desired"].rate_hz:
            self._wished_s = now_s
            self._wishes.send_multipart([b"desired", DesiredState(True).pack()])


def gather_frames(
    feed: Feed, names: Iterable[str], frames: int, progress: Callable[[str], None]
) -> dict[str, list[TimedFrame]]:
    """The next frames of every camera.

    Raises:
        CalibrationError: naming the camera that gave too few.
    """
    taken: dict[str, list[TimedFrame]] = {name: [] for name in names}
    deadline_s = time.monotonic() + _GATHER_S
    while any(len(seen) < frames for seen in taken.values()):
        if time.monotonic() > deadline_s or feed.over:
            break
        for frame in feed.frames():
            if len(taken[frame.camera]) < frames:
                taken[frame.camera].append(frame)
        progress(f"{min(len(seen) for seen in taken.values())} of {frames} frames received")
    few = [name for name, seen in taken.items() if len(seen) < frames // 2]
    if few:
        raise CalibrationError(_too_few_words(few, replays=feed.replays))
    return taken


def _too_few_words(few: Sequence[str], *, replays: bool) -> str:
    """Words on cameras that gave too few frames."""
    one = len(few) == 1
    words = (
        f"camera {few[0]} gave too few frames"
        if one
        else f"cameras {', '.join(few)} gave too few frames"
    )
    if not replays:
        return f"{words}; see station status and do it again"
    lasting = (
        "its recording has to last 3 s or longer"
        if one
        else "their recordings have to last 3 s or longer"
    )
    return f"{words}; {lasting}; stop other programs if the computer is busy"


@contextmanager
def live_feed(config: BoothConfig) -> Iterator[Feed]:
    """The frames of the booth that runs."""
    with Feed(config) as feed:
        yield feed


@contextmanager
def replayed_feed(config: BoothConfig, recordings: Path) -> Iterator[Feed]:
    """The frames of recordings (one folder a camera), through capture processes of their own.

    Raises:
        FormatError: a recording is missing or torn.
        ConfigError: a camera's driver plays no recordings.
    """
    clocks = {camera.name: RecordedClock(recordings / camera.name) for camera in config.cameras}
    with tempfile.TemporaryDirectory(prefix="booth-replay-") as name:
        folder = Path(name)
        path = folder / "booth.toml"
        lines = ["[runtime]", 'folder = "."', ""]
        for camera in config.cameras:
            recorded = camera.replaying((recordings / camera.name).resolve())
            keys = recorded.model_dump(mode="json", exclude_none=True)
            lines += ["[[cameras]]", *(f"{key} = {_toml(value)}" for key, value in keys.items())]
        path.write_text("\n".join(lines))
        command = [sys.executable, "-m", "station.cli", "capture"]
        log = (folder / "capture.log").open("w")
        children = [
            subprocess.Popen(
                [*command, camera, "--config", str(path)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                preexec_fn=partial(die_with_parent, os.getpid()),
            )
            for camera in clocks
        ]
        try:
            runtime = config.runtime.model_copy(update={"folder": folder})
            with Feed(config.model_copy(update={"runtime": runtime}), clocks) as feed:
                yield feed
        finally:
            for child in children:
                child.terminate()
            for child in children:
                try:
                    child.wait(_STOP_S)
                except subprocess.TimeoutExpired:
                    child.kill()
                    child.wait()
            log.close()


def _toml(value: Any) -> str:
    """A value as TOML: JSON's strings, numbers, truth values and lists are TOML's too."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
