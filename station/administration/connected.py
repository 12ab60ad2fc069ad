"""Connected Kinects, and the USB controller of each."""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from station.core.errors import DriverError
from station.sensors.freenect import find_library

_DEVICES = Path("/sys/bus/usb/devices")
_MICROSOFT = "045e"
_CAMERAS = {"02ae": "Kinect for Xbox", "02bf": "Kinect for Windows"}
"""USB product of the camera function -> model; audio and motor are devices of their own."""
_NO_SERIAL = "0000000000000000"


@dataclass(frozen=True, slots=True)
class ConnectedCamera:
    """A Kinect's camera function as the kernel shows it."""

    model: str
    controller: str
    """The PCI address of the USB controller that it is connected to."""


class _Attributes(ctypes.Structure):
    """libfreenect's freenect_device_attributes: a linked list."""


_Attributes._fields_ = [
    ("next", ctypes.POINTER(_Attributes)),
    ("camera_serial", ctypes.c_char_p),
]


def connected_cameras(devices: Path = _DEVICES) -> list[ConnectedCamera]:
    """Every Kinect camera that the kernel has found, including those that this user may not
    open."""
    found = []
    for folder in sorted(devices.glob("*")):
        if _text(folder / "idVendor") == _MICROSOFT:
            model = _CAMERAS.get(_text(folder / "idProduct"))
            if model:
                found.append(ConnectedCamera(model, _controller(folder.resolve())))
    return found


def crowded_controllers(cameras: Sequence[ConnectedCamera]) -> dict[str, int]:
    """Controllers that more than one camera is connected to: a Kinect v1 takes most of USB 2's
    bandwidth.

    Returns:
        PCI address -> number of cameras.
    """
    counts = Counter(camera.controller for camera in cameras)
    return {controller: count for controller, count in counts.items() if count > 1}


def serial_numbers() -> list[str]:
    """Serial numbers of the Kinects that this user may open, in the order of the bus.

    Raises:
        DriverError: libfreenect is not installed, or cannot start.
    """
    library = ctypes.CDLL(str(find_library(replay=False)))
    context, attributes = ctypes.c_void_p(), ctypes.POINTER(_Attributes)()
    library.freenect_init.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    library.freenect_list_device_attributes.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    library.freenect_free_device_attributes.argtypes = (ctypes.c_void_p,)
    library.freenect_free_device_attributes.restype = None
    library.freenect_shutdown.argtypes = (ctypes.c_void_p,)
    if library.freenect_init(ctypes.byref(context), None) < 0:
        raise DriverError("libfreenect cannot start USB; is it disabled here?")
    try:
        if library.freenect_list_device_attributes(context, ctypes.byref(attributes)) < 0:
            return []
        found, device = [], attributes
        while device:
            serial = (device.contents.camera_serial or b"").decode("ascii", "replace")
            if serial and serial != _NO_SERIAL:
                found.append(serial)
            device = device.contents.next
        library.freenect_free_device_attributes(attributes)
        return found
    finally:
        library.freenect_shutdown(context)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def _controller(device: Path) -> str:
    """The folder above the root hub (usbN) is the controller's."""
    for parent in (device, *device.parents):
        if parent.name.startswith("usb") and parent.name[3:].isdigit():
            return parent.parent.name
    return "unknown"
