"""Kinect v1 through libfreenect (ctypes), or its replay library: the very same code.

Raw 11-bit disparities become depth by the formula of station.core.kinect_v1 for every unit: each
unit's deviation from it is smooth, and the calibration's depth correction removes it.
"""

from __future__ import annotations

import _ctypes
import ctypes
import os
import queue
import threading
import time
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from station.core.drivers import CameraConfig, ConfigPath
from station.core.errors import DriverError, FormatError
from station.core.kinect_v1 import FRAME_RATE_HZ, HEIGHT, WIDTH, depth_of_raw
from station.sensors.base import DepthFrame, DeviceInfo
from station.sensors.recorded import kinect_v1
from station.sensors.recording import check_recording

LIBRARY = "libfreenect.so.0.5"
LIBRARY_VARIABLE = "FREENECT_LIBRARY"
_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib", "/usr/local/lib")
_REPLAY_FOLDER = "fakenect"
_RESOLUTION_MEDIUM = 1
_DEPTH_11BIT = 0
_DEVICE_CAMERA = 2
_LOG_ERROR = 1
_WAITING_FRAMES = 4
_SILENT_S = 3.0
_FAILURES_IN_A_ROW = 3

_DepthCallback = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32)


class _FrameMode(ctypes.Structure):
    _fields_ = (
        ("reserved", ctypes.c_uint32),
        ("resolution", ctypes.c_int),
        ("format", ctypes.c_int32),
        ("bytes", ctypes.c_int32),
        ("width", ctypes.c_int16),
        ("height", ctypes.c_int16),
        ("data_bits_per_pixel", ctypes.c_int8),
        ("padding_bits_per_pixel", ctypes.c_int8),
        ("framerate", ctypes.c_int8),
        ("is_valid", ctypes.c_int8),
    )


class _Arrival(NamedTuple):
    """A frame as the library handed it over."""

    raw: NDArray[np.uint16]
    ticks: int
    received_s: float
    sequence: int


class _Timeval(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("microseconds", ctypes.c_long))


def find_library(*, replay: bool) -> Path:
    """libfreenect, or its replay library.

    Raises:
        DriverError: it is not installed; names the Debian package.
    """
    named = os.environ.get(LIBRARY_VARIABLE)
    candidates = [Path(named)] if named else [Path(folder) / LIBRARY for folder in _FOLDERS]
    for candidate in candidates:
        path = candidate.parent / _REPLAY_FOLDER / LIBRARY if replay else candidate
        if path.exists():
            return path
    what = "libfreenect's replay library" if replay else "libfreenect"
    raise DriverError(
        f"{what} ({LIBRARY}) is not installed; apt-get install libfreenect0.5, or read recordings "
        "with driver = 'recorded'"
    )


class FreenectCamera(CameraConfig):
    """A Kinect v1 by its serial number, or a recording played by libfreenect's replay library."""

    driver: str = "freenect"
    serial: str = Field(default="", description="the sensor's serial number")
    recording: ConfigPath | None = Field(
        default=None, description="a recording folder (INDEX.txt) to play instead of a sensor"
    )

    @model_validator(mode="after")
    def _has_a_source(self) -> Self:
        if not self.serial and self.recording is None:
            raise ValueError("the driver freenect needs the key serial or recording")
        return self

    def replaying(self, recording: Path) -> CameraConfig:
        return self.model_copy(update={"recording": recording})


class FreenectDriver:
    """One Kinect v1 by serial, or one recording by folder (one a process)."""

    Config = FreenectCamera

    def __init__(self, camera: FreenectCamera) -> None:
        self._serial, self._recording = camera.serial, camera.recording
        self._name = (
            f"recording {camera.recording}" if camera.recording else f"Kinect {camera.serial}"
        )
        self._library: ctypes.CDLL | None = None
        self._context, self._device = ctypes.c_void_p(), ctypes.c_void_p()
        self._frames: queue.Queue[_Arrival] = queue.Queue(_WAITING_FRAMES)
        self._stop = threading.Event()
        self._pump: threading.Thread | None = None
        self._failure = ""
        self._sequence = 0
        self._last_s = 0.0

    def open(self) -> DeviceInfo:
        return self._open(sequence=0)

    def _open(self, sequence: int) -> DeviceInfo:
        """Open it; `sequence` is its first frame's number."""
        if self._recording is not None:
            try:
                check_recording(self._recording)
            except FormatError as cause:
                raise DriverError(str(cause)) from None
            os.environ["FAKENECT_PATH"] = str(self._recording)
        path = find_library(replay=self._recording is not None)
        try:
            self._library = ctypes.CDLL(str(path))
        except OSError as cause:
            raise DriverError(f"{path} cannot be loaded ({cause}); reinstall it") from None
        _declare(self._library)
        self._open_device(self._library)
        self._stop.clear()
        # Before the first frame can come: the gap would count as lost frames.
        self._failure, self._sequence, self._last_s = "", sequence, time.monotonic()
        self._pump = threading.Thread(target=self._run_events, name="freenect", daemon=True)
        self._pump.start()
        return kinect_v1(self._serial or f"replayed:{self._recording and self._recording.name}")

    def _open_device(self, library: ctypes.CDLL) -> None:
        if library.freenect_init(ctypes.byref(self._context), None) < 0:
            raise DriverError(f"{self._name}: libfreenect cannot start USB; is it disabled here?")
        library.freenect_set_log_level(self._context, _LOG_ERROR)
        library.freenect_select_subdevices(self._context, _DEVICE_CAMERA)
        count = library.freenect_num_devices(self._context)
        if count < 1:
            self._release()
            raise DriverError(f"{self._name}: no Kinect is connected; check USB and its power")
        if self._recording is not None:
            result = library.freenect_open_device(self._context, ctypes.byref(self._device), 0)
        else:
            result = library.freenect_open_device_by_camera_serial(
                self._context, ctypes.byref(self._device), self._serial.encode()
            )
        if result < 0:
            self._release()
            raise DriverError(
                f"{self._name} cannot be opened ({count} connected): check the serial number "
                "(station setup lists those connected), whether another program uses it, and the "
                "permission (install deploy/60-booth-cameras.rules)"
            )
        mode = library.freenect_find_depth_mode(_RESOLUTION_MEDIUM, _DEPTH_11BIT)
        # Kept as an attribute: the library calls it for as long as the device is open.
        self._callback = _DepthCallback(self._on_depth)
        library.freenect_set_depth_callback(self._device, self._callback)
        if (
            library.freenect_set_depth_mode(self._device, mode) < 0
            or library.freenect_start_depth(self._device) < 0
        ):
            self._release()
            raise DriverError(
                f"{self._name}: its depth stream does not start; unplug it and plug it in again"
            )

    def _on_depth(self, device: int, data: int, ticks: int) -> None:
        del device
        received_s = time.monotonic()
        # A copy and no more: the library's clock waits for this call.
        raw = np.frombuffer(ctypes.string_at(data, 2 * WIDTH * HEIGHT), np.uint16)
        arrived = _Arrival(raw, int(ticks), received_s, self._sequence)
        self._sequence += 1
        try:
            self._frames.put_nowait(arrived)
        except queue.Full:
            # The reader is late: the gap in the sequence shows the loss.
            return

    def _run_events(self) -> None:
        library = self._library
        assert library is not None
        timeout = _Timeval(0, 100_000)
        failures = 0
        while not self._stop.is_set() and failures < _FAILURES_IN_A_ROW:
            if library.freenect_process_events_timeout(self._context, ctypes.byref(timeout)) < 0:
                # A USB transfer may be interrupted; only a device that is gone, or a recording at
                # its end, fails again and again. Without a pause that would spin.
                failures += 1
                time.sleep(1.0 / FRAME_RATE_HZ)
            else:
                failures = 0
        if failures:
            self._failure = f"{self._name} was disconnected or its recording ended; check its cable"

    def read(self, timeout_s: float) -> DepthFrame | None:
        try:
            arrived = self._frames.get(timeout=timeout_s)
        except queue.Empty:
            if self._failure and self._recording is not None and self._sequence:
                self._play_again()
                return None
            if self._failure:
                raise DriverError(self._failure) from None
            if time.monotonic() - self._last_s > _SILENT_S:
                raise DriverError(f"{self._name} sends no frames; reopening it") from None
            return None
        self._last_s = arrived.received_s
        depth = depth_of_raw(arrived.raw.reshape(HEIGHT, WIDTH))
        return DepthFrame(depth, arrived.ticks, arrived.received_s, arrived.sequence)

    def _play_again(self) -> None:
        """A recording at its end starts over, as a sensor whose clock was reset."""
        self.close()
        self._open(self._sequence)

    def close(self) -> None:
        self._stop.set()
        if self._pump is not None:
            self._pump.join(timeout=2.0)
            if self._pump.is_alive():
                # The library hangs in a call; releasing it now would crash the process.
                return
            self._pump = None
        self._release()

    def _release(self) -> None:
        if self._library is None:
            return
        if self._device:
            self._library.freenect_stop_depth(self._device)
            self._library.freenect_close_device(self._device)
        if self._context:
            self._library.freenect_shutdown(self._context)
        self._device, self._context = ctypes.c_void_p(), ctypes.c_void_p()
        if self._recording is not None:
            # The replay library stays at a recording's end until it is loaded anew.
            _ctypes.dlclose(self._library._handle)
        self._library = None


def _declare(library: ctypes.CDLL) -> None:
    """Argument types: pointers would be cut to 32 bits otherwise."""
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    for name, arguments in {
        "freenect_init": (pointer, pointer),
        "freenect_set_log_level": (pointer, integer),
        "freenect_select_subdevices": (pointer, integer),
        "freenect_num_devices": (pointer,),
        "freenect_open_device": (pointer, pointer, integer),
        "freenect_open_device_by_camera_serial": (pointer, pointer, ctypes.c_char_p),
        "freenect_set_depth_callback": (pointer, _DepthCallback),
        "freenect_set_depth_mode": (pointer, _FrameMode),
        "freenect_start_depth": (pointer,),
        "freenect_stop_depth": (pointer,),
        "freenect_close_device": (pointer,),
        "freenect_shutdown": (pointer,),
        "freenect_process_events_timeout": (pointer, pointer),
    }.items():
        function = getattr(library, name)
        function.argtypes = arguments
        function.restype = integer
    library.freenect_find_depth_mode.argtypes = (integer, integer)
    library.freenect_find_depth_mode.restype = _FrameMode
    library.freenect_set_log_level.restype = None
    library.freenect_select_subdevices.restype = None
    library.freenect_set_depth_callback.restype = None
