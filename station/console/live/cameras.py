"""The cameras' newest depth pictures, drawn only while somebody is waiting for one."""

from __future__ import annotations

import asyncio
import json
import logging
import struct
import threading
import time
from pathlib import Path

import numpy as np
import zmq

from station.console.live.picture import PictureMaker
from station.core.config import BoothConfig
from station.core.errors import BoothError
from station.core.files import Version, version_of
from station.core.rig import Rig
from station.messaging.messages import FrameHeader
from station.messaging.transport import subscriber

_IDLE_S = 2.0
"""Time without a viewer after which frames are no longer received."""
_FORGET_S = 1.5
"""Age beyond which a picture is not shown."""


class Pictures:
    """One thread for any number of viewers. A viewer that requests nothing costs nothing."""

    def __init__(self, config: BoothConfig, log: logging.Logger) -> None:
        self._config, self._log = config, log
        self._names = [camera.name for camera in config.cameras]
        self._waiting: list[asyncio.Future[bytes]] = []
        self._lock = threading.Lock()
        self._wanted = threading.Event()
        self._stop = threading.Event()
        self._makers: dict[str, PictureMaker] = {}
        self._version: Version | None = None
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._wanted.set()
        self._thread.join(5.0)

    async def next(self) -> bytes:
        """The next pictures of all cameras: a length, a JSON header of that length, JPEG files.

        The header's `cameras` lists name, bytes and somebody (null: it cannot be seen), in the
        files' order.
        """
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        with self._lock:
            self._waiting.append(future)
        self._wanted.set()
        return await future

    def _run(self) -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        while not self._stop.is_set():
            self._wanted.wait()
            if self._stop.is_set():
                break
            try:
                self._serve(context)
            except (BoothError, OSError, ValueError, zmq.ZMQError) as error:
                # ValueError: a frame whose header and pixels do not fit together.
                self._log.warning("depth pictures: %s", error)
                self._stop.wait(1.0)
        context.destroy(linger=0)

    def _serve(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        """Receive until nobody has requested a picture for a while."""
        names = [f"camera-{name}" for name in self._names]
        frames = subscriber(context, self._config.runtime.folder, names, ["depth"])
        newest: dict[str, list[zmq.Frame]] = {}
        came_s: dict[str, float] = {}
        asked_s = next_s = time.monotonic()
        try:
            while not self._stop.is_set() and time.monotonic() - asked_s < _IDLE_S:
                if frames.poll(max(1, int(1000 * (next_s - time.monotonic())))):
                    topic, *parts = frames.recv_multipart(copy=False)
                    name = bytes(topic.buffer).decode().removeprefix("depth/")
                    newest[name], came_s[name] = parts, time.monotonic()
                now_s = time.monotonic()
                if now_s < next_s:
                    continue
                next_s = now_s + 1.0 / self._config.console.preview_hz
                with self._lock:
                    waiting, self._waiting = self._waiting, []
                if not waiting:
                    continue
                asked_s = now_s
                fresh = {n: p for n, p in newest.items() if now_s - came_s[n] < _FORGET_S}
                try:
                    packed = self._packed(fresh)
                except BaseException:
                    with self._lock:
                        # Who still waits gets the pictures after the fault.
                        self._waiting[:0] = [future for future in waiting if not future.done()]
                    raise
                _give(waiting, packed)
        finally:
            frames.close()
            with self._lock:
                if not self._waiting:
                    self._wanted.clear()

    def _packed(self, newest: dict[str, list[zmq.Frame]]) -> bytes:
        self._follow_calibration()
        listed, files = [], []
        for name in self._names:
            if name not in newest:
                listed.append({"name": name, "bytes": 0, "somebody": None})
                continue
            packed, pixels = newest[name]
            header = FrameHeader.unpack(packed.buffer)
            depth = np.frombuffer(pixels.buffer, np.uint16).reshape(header.height, header.width)
            file, somebody = self._makers[name].jpeg(depth, header.depth_scale_m)
            listed.append({"name": name, "bytes": len(file), "somebody": somebody})
            files.append(file)
        head = json.dumps({"cameras": listed}).encode()
        return b"".join([struct.pack("<I", len(head)), head, *files])

    def _follow_calibration(self) -> None:
        """Use the calibration that is in use now."""
        path: Path = self._config.calibration
        version = version_of(path) if path.exists() else None
        if self._makers and version == self._version:
            return
        self._version = version
        try:
            known = {} if version is None else Rig.load(path).cameras
        except BoothError as error:
            self._log.warning("pictures are drawn without a calibration: %s", error)
            known = {}
        volume = self._config.volume
        self._makers = {name: PictureMaker(known.get(name), volume) for name in self._names}


def _give(waiting: list[asyncio.Future[bytes]], packed: bytes) -> None:
    def give(future: asyncio.Future[bytes]) -> None:
        if not future.done():
            future.set_result(packed)

    for future in waiting:
        loop = future.get_loop()
        if not loop.is_closed():
            loop.call_soon_threadsafe(give, future)
