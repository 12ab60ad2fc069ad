"""The view of the empty booth: the floor and everything fixed.

Kept with each calibration. The drift check compares later frames with it, and the ball is looked
for in front of it. Everything is in inverse depth, in which a structured-light sensor's noise is
the same near and far; 0 stands for no reading, so that an edge against nothing is an edge too.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import Image, inverse_depth
from station.core.errors import FormatError
from station.core.files import write_bytes
from station.core.rig import MAX_PIXELS

VERSION = 1
SMOOTHING_PX = 3.0
"""The noise is measured, and edges are compared, after a Gaussian of this width."""
_MOSTLY = 0.5
_MIN_SHARE = 0.2
_FEWEST_FRAMES = 2
"""A noise cannot be told from one."""
_IMAGES = ("inverse_depth", "readings", "noise", "outline_noise")
"""Images of a stored view."""
_LARGEST_VALUE = 8
"""Bytes of a pixel."""
_UNREADABLE = (
    OSError, EOFError, KeyError, ValueError, TypeError, AttributeError, ArithmeticError,
    MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Errors of numpy and zipfile at damaged files: what they name in their headers may be anything."""


@dataclass(frozen=True, slots=True)
class StaticView:
    """One camera's empty booth, (h, w) each."""

    inverse_depth: Image
    """Mean over the frames of 1/z as measured (uncorrected), 1/m; no reading counts as 0."""
    share: Image
    """Share of the frames that have a reading."""
    noise: Image
    """Standard deviation over time of one frame's smoothed surface (see ``smoothed``), 1/m."""
    outline_noise: Image
    """Standard deviation of the inverse depth with 0 for no reading, as outlines are compared."""
    frames: int

    def depth_m(self) -> Image:
        """Mean depth in metres where most frames have a reading, else 0."""
        often = self.share > _MOSTLY
        safe = np.where(often, self.inverse_depth, 1.0)
        return np.where(often, self.share / safe, 0.0).astype(np.float32)

    def save(self, path: Path) -> None:
        """Write the view durably, about 1 MB."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            version=np.array(VERSION),
            inverse_depth=self.inverse_depth,
            readings=np.rint(self.frames * self.share).astype(np.uint16),
            noise=self.noise.astype(np.float16),
            outline_noise=self.outline_noise.astype(np.float16),
            frames=np.array(self.frames),
        )
        write_bytes(path, buffer.getvalue())

    @classmethod
    def load(cls, path: Path, size: tuple[int, int] | None = None) -> StaticView:
        """Read a stored view.

        Args:
            size: (h, w) of the camera's images, where it is known.

        Raises:
            FormatError: naming the file that is missing, torn, of another version or another size.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                _check_shape(archive, "version", ())
                version = int(archive["version"])
                if version != VERSION:
                    raise FormatError(
                        f"{path} has version {version}; this program reads {VERSION}; "
                        "run station calibrate floor"
                    )
                _check_shape(archive, "frames", ())
                frames = int(archive["frames"])
                if frames < _FEWEST_FRAMES:
                    raise ValueError(f"it is of {frames} frames")
                for name in _IMAGES:
                    _check_shape(archive, name, size)
                images = [_finite_image(archive[name]) for name in _IMAGES]
                if len({image.shape for image in images}) > 1:
                    raise ValueError("its images differ in size")
                inverse, readings, noise, outline_noise = images
                return cls(inverse, readings / np.float32(frames), noise, outline_noise, frames)
        except _UNREADABLE as cause:
            raise FormatError(
                f"{path} cannot be read ({cause}); run station calibrate floor"
            ) from None


def _check_shape(archive: Any, name: str, size: tuple[int, ...] | None) -> None:
    """Compare an array's shape before it is unpacked: a small file may hold gigabytes.

    Raises:
        ValueError: it is not the given one, or is no image of a depth camera.
    """
    with archive.zip.open(f"{name}.npy") as stream:
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError(f"{name} is of another version of numpy's format")
        shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    if kind.itemsize > _LARGEST_VALUE or (size is not None and shape != size):
        raise ValueError(f"{name} of {size or 'numbers'} was expected, not {shape} of {kind}")
    if size is None and not (len(shape) == 2 and max(shape) <= MAX_PIXELS):
        raise ValueError(f"{name} is {shape}, no image of at most {MAX_PIXELS} pixels a side")


def _finite_image(values: NDArray[np.generic]) -> Image:
    """An image (h, w) of a stored view.

    Raises:
        ValueError: it is none, or some of its values are not finite.
    """
    image = values.astype(np.float32)
    if image.ndim != 2 or not np.isfinite(image).all():
        raise ValueError(f"an image of finite values was expected, not {values.shape}")
    return image


def raw_inverse_depth(depth: NDArray[np.uint16], scale_m: float) -> Image:
    """1/z in 1/m of a depth frame in units of scale_m; 0 stays 0."""
    return inverse_depth(depth.astype(np.float32) * np.float32(scale_m))


def mean_view(frames: Sequence[NDArray[np.uint16]], scale_m: float) -> tuple[Image, Image]:
    """Mean inverse depth (h, w) of some frames, no reading counting as 0, and the share (h, w) of
    them that have a reading."""
    inverse = [raw_inverse_depth(frame, scale_m) for frame in frames]
    share = np.mean(np.stack(inverse) > 0, axis=0, dtype=np.float32)
    return np.asarray(np.mean(inverse, axis=0), np.float32), np.asarray(share)


def smoothed(inverse: Image, share: Image) -> tuple[Image, Image]:
    """Smoothed images: of the surface, over its readings alone, and with 0 for no reading."""
    with_gaps = np.asarray(cv2.GaussianBlur(inverse, (0, 0), SMOOTHING_PX), np.float32)
    there = cv2.GaussianBlur(share, (0, 0), SMOOTHING_PX)
    return np.asarray(with_gaps / np.maximum(there, _MIN_SHARE), np.float32), with_gaps


def static_view(frames: Iterable[NDArray[np.uint16]], scale_m: float) -> StaticView:
    """Gather frames (h, w) of a booth in which nothing moves.

    Raises:
        ValueError: fewer than two frames; a noise cannot be told from one.
    """
    count = 0
    for frame in frames:
        inverse = raw_inverse_depth(frame, scale_m)
        there = (inverse > 0).astype(np.float32)
        images = np.stack(smoothed(inverse, there))
        if not count:
            first = images
            total, seen = np.zeros_like(inverse), np.zeros_like(inverse)
            level, spread = np.zeros_like(images), np.zeros_like(images)
        total += inverse
        seen += there
        # About the first frame, so that squares of small differences do not drown in float32.
        level += images - first
        spread += np.square(images - first)
        count += 1
    if count < _FEWEST_FRAMES:
        raise ValueError("a static view needs at least two frames")
    variance = (spread - np.square(level) / count) / (count - 1)
    noise, outline_noise = np.sqrt(np.maximum(variance, 0.0))
    n = np.float32(count)
    return StaticView(total / n, seen / n, noise, outline_noise, count)
