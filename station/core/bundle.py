"""The scan bundle: what capture hands to reconstruction (format "booth-bundle", version 1)."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.core.depth.json_values import number, shown, text, whole
from station.core.depth.png import image_of_png, png_of, png_size
from station.core.errors import BundleError, CalibrationError, DiskReadError
from station.core.files import OF_THE_DISK, private_folder, read_json, read_regular, write_json
from station.core.rig import Rig

FORMAT = "booth-bundle"
VERSIONS = frozenset({1})
MANIFEST = "bundle.json"
CALIBRATION = "calibration.json"
_ENCODERS = 2
_PNG_SLACK_BYTES = 1 << 16
"""Allowance beyond twice the pixels' own size, which not even a PNG of noise reaches."""
MAX_CAMERAS, MAX_FRAMES = 64, 1000
LEAST_READINGS = 2000
"""Readings of all cameras in the booth's volume below which nobody stands there."""
NOBODY = (
    "the booth is empty: the cameras see nobody in its volume; "
    "ask the person to stand on the mark, or check volume in booth.toml"
)
_MAX_COUNT = 1 << 63


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """The file of one depth frame, and the time at which it was taken."""

    file: str
    """Path inside the bundle, with forward slashes."""
    device_ticks: int
    tick_hz: float
    host_time_s: float
    """Host's monotonic clock after the clock model."""
    sequence: int


@dataclass(frozen=True, slots=True)
class Bundle:
    """A scan bundle's manifest and calibration; frames are read when asked for."""

    folder: Path
    scan_id: str
    created: str
    label: str
    booth: str
    """Name of the booth; empty where the bundle does not say."""
    depth_scale_m: float
    """Metres per unit of the depth images."""
    rig: Rig
    frames: Mapping[str, tuple[FrameRecord, ...]]
    spread_s_max: float

    def read_frame(self, camera: str, record: FrameRecord) -> NDArray[np.uint16]:
        """One depth image (height, width) in units of depth_scale_m, 0 = no reading.

        Raises:
            BundleError: the file is missing, torn, or not a 16-bit image of the camera's size.
            DiskReadError: the disk refuses.
        """
        path = self.folder / record.file
        # Only links of the bundle itself: the spool may well lie behind one.
        inside = takewhile(lambda parent: parent != self.folder.parent, path.parents)
        if any(parent.is_symlink() for parent in inside):
            raise BundleError(f"{path} is reached through a symbolic link; scan again")
        calibration = self.rig.cameras[camera]
        expected = (calibration.height, calibration.width)
        most_bytes = 2 * 2 * calibration.height * calibration.width + _PNG_SLACK_BYTES
        try:
            data = read_regular(path, most_bytes)
        except OSError as cause:
            kind = DiskReadError if cause.errno in OF_THE_DISK else BundleError
            raise kind(f"{path} cannot be read ({cause.strerror}); scan again") from None
        except ValueError as cause:
            raise BundleError(f"{path} {cause}; scan again") from None
        # Checked before decoding: a small file may claim to be an image of gigabytes.
        found = png_size(data)
        if found is None:
            raise BundleError(f"{path} is torn or not a PNG; scan again")
        if found != expected:
            raise BundleError(f"{path} is {found}; camera {camera} needs uint16 {expected}")
        image = image_of_png(data)
        if image is None:
            raise BundleError(f"{path} is torn or not a PNG; scan again")
        if image.dtype != np.uint16 or image.shape != expected:
            raise BundleError(
                f"{path} is {image.dtype} {image.shape}; camera {camera} needs uint16 {expected}"
            )
        return np.asarray(image, dtype=np.uint16)

    def depth_stack(self, camera: str) -> NDArray[np.uint16]:
        """All depth images of a camera, (frames, height, width)."""
        return np.stack([self.read_frame(camera, record) for record in self.frames[camera]])


def read_bundle(folder: Path) -> Bundle:
    """Read and check a bundle's manifest and calibration.

    Raises:
        FormatError: a file is missing, torn, of an unknown version, or contradicts the others;
            the message names it.
        DiskReadError: the disk refuses.
        CalibrationError: a camera of the bundle is not in its calibration.
    """
    path = folder / MANIFEST
    if folder.is_symlink() or not folder.is_dir():
        raise BundleError(f"{folder} is not a folder; give the folder of a scan bundle")
    document = read_json(path, format=FORMAT, versions=VERSIONS, error=BundleError)
    rig = Rig.load(folder / CALIBRATION)
    try:
        frames = {
            camera: _records(camera, fields)
            for camera, fields in _object("cameras", document["cameras"]).items()
        }
        scale = number("depth_scale_m", document["depth_scale_m"])
        spread_s_max = number("spread_s_max", _object("sync", document["sync"])["spread_s_max"])
        bundle = Bundle(
            folder=folder,
            scan_id=text("scan_id", document["scan_id"]),
            created=text("created", document["created"]),
            label=text("label", document.get("label", "")),
            booth=text("booth", document.get("booth", "")),
            depth_scale_m=scale,
            rig=rig,
            frames=frames,
            spread_s_max=spread_s_max,
        )
    except KeyError as missing:
        raise BundleError(f"{path}: the field {missing} is missing; scan again") from None
    except ValueError as cause:
        raise BundleError(f"{path}: {cause}; scan again") from None
    if len(frames) > MAX_CAMERAS or any(len(f) > MAX_FRAMES for f in frames.values()):
        raise BundleError(
            f"{path}: a bundle may have at most {MAX_CAMERAS} cameras with {MAX_FRAMES} frames each"
        )
    if not (math.isfinite(bundle.spread_s_max) and bundle.spread_s_max >= 0.0):
        raise BundleError(f"{path}: spread_s_max is {bundle.spread_s_max}; scan again")
    if not (np.isfinite(scale) and 0.0 < scale < 0.1):
        raise BundleError(
            f"{path}: depth_scale_m is {scale}; a positive number of metres per unit was expected"
        )
    if not any(frames.values()):
        raise BundleError(f"{path}: no camera has a frame; scan again")
    for camera in frames:
        if camera not in rig.cameras:
            known = ", ".join(rig.cameras)
            raise CalibrationError(
                f"{path}: camera {camera} is not in calibration.json (it has: {known}); "
                "calibrate the booth again"
            )
    return bundle


def _object(name: str, found: object) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ValueError(f"{name} is {shown(found)}, not an object {{...}}")
    return found


def _records(camera: str, fields: object) -> tuple[FrameRecord, ...]:
    name = f"camera {camera!a:.80}"
    entries = _object(name, fields)["frames"]
    if not isinstance(entries, list):
        raise ValueError(f"{name}: frames is {shown(entries)}, not a list")
    return tuple(_record(_object(f"{name}: a frame", entry)) for entry in entries)


def _record(entry: Mapping[str, Any]) -> FrameRecord:
    file = text("the name of a frame's file", entry["file"])
    name = PurePosixPath(file)
    if name.is_absolute() or ".." in name.parts:
        raise ValueError(f"the frame file {file!a:.80} lies outside the bundle")
    if not file.isprintable():
        raise ValueError(
            f"the frame file {file!a:.80} has characters that are not allowed in a file name"
        )
    record = FrameRecord(
        file=file,
        device_ticks=whole(f"{file}: device_ticks", entry["device_ticks"], parts=True),
        tick_hz=number(f"{file}: tick_hz", entry["tick_hz"]),
        host_time_s=number(f"{file}: host_time_s", entry["host_time_s"]),
        sequence=whole(f"{file}: sequence", entry["sequence"]),
    )
    if not (math.isfinite(record.tick_hz) and record.tick_hz > 0.0):
        raise ValueError(f"{file}: tick_hz is {record.tick_hz}")
    if not math.isfinite(record.host_time_s):
        raise ValueError(f"{file}: host_time_s is {record.host_time_s}")
    if not all(0 <= count < _MAX_COUNT for count in (record.device_ticks, record.sequence)):
        raise ValueError(f"{file}: device_ticks or sequence is negative or too large")
    return record


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """A depth frame on its way into a bundle."""

    depth: NDArray[np.uint16]
    device_ticks: int
    tick_hz: float
    host_time_s: float
    sequence: int


def write_bundle(
    folder: Path,
    *,
    scan_id: str,
    created: str,
    label: str,
    depth_scale_m: float,
    rig: Rig,
    frames: Mapping[str, Sequence[CapturedFrame]],
    spread_s_max: float,
    booth: str = "",
) -> None:
    """Write a bundle's files into a new folder; the caller publishes it under its final name.

    Args:
        frames: per camera, in order of time.
        booth: name of the booth.

    Raises:
        FileExistsError: the folder is there already.
        OSError: the disk refused; what was written is removed.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700)
    try:
        cameras = {name: _write_frames(folder, name, taken) for name, taken in frames.items()}
        rig.save(folder / CALIBRATION)
        manifest = {
            "format": FORMAT,
            "version": 1,
            "scan_id": scan_id,
            "created": created,
            "label": label,
            "booth": booth,
            "depth_scale_m": depth_scale_m,
            "cameras": cameras,
            "sync": {"spread_s_max": spread_s_max},
        }
        write_json(folder / MANIFEST, manifest)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _write_frames(folder: Path, camera: str, taken: Sequence[CapturedFrame]) -> dict[str, Any]:
    private_folder(folder / "depth" / camera)

    def write(index: int) -> dict[str, Any]:
        frame = taken[index]
        file = f"depth/{camera}/{index:03d}.png"
        try:
            content = png_of(frame.depth)
        except ValueError as cause:
            raise BundleError(f"{folder / file}: the frame {cause}") from None
        (folder / file).write_bytes(content)
        record = FrameRecord(
            file, frame.device_ticks, frame.tick_hz, frame.host_time_s, frame.sequence
        )
        return asdict(record)

    # Encoding releases the interpreter lock; it runs in threads because the person waits for it.
    with ThreadPoolExecutor(max_workers=_ENCODERS) as pool:
        return {"frames": list(pool.map(write, range(len(taken))))}
