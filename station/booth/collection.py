"""One scan while its framesets are collected (pure)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field

from station.booth.frameset import Frameset
from station.core.errors import BoothError
from station.core.kinect_v1 import FRAME_RATE_HZ
from station.core.rig import Rig
from station.core.scans import ScanId
from station.messaging.intake import LiveFrame

LATE = "the request for this scan expired before the scan was started; scan again"


@dataclass(frozen=True, slots=True)
class Order:
    """The operator's request for a scan."""

    scan_id: ScanId
    label: str
    valid_until_s: float
    """Deadline for starting the scan; after it the operator has been told that the request
    expired."""

    def late(self, now_s: float) -> bool:
        return now_s > self.valid_until_s


@dataclass(slots=True)
class Collection:
    """A scan being collected."""

    order: Order
    rig: Rig
    wanted: int
    deadline_s: float
    sets: list[Frameset[LiveFrame]] = field(default_factory=list)
    complete_s: float = 0.0
    """Time at which its last frameset arrived."""

    def add(self, found: Frameset[LiveFrame], now_s: float) -> bool:
        """Add a frameset; True if it was the last one."""
        self.sets.append(found)
        self.complete_s = now_s
        return len(self.sets) >= self.wanted

    def depth_scale_m(self) -> float:
        """Metres per unit of its depth images, which a bundle has one of.

        Raises:
            BoothError: its cameras have several.
        """
        frames = [frame for found in self.sets for frame in found.frames.values()]
        scales = {frame.header.depth_scale_m for frame in frames}
        if len(scales) > 1:
            raise BoothError(
                "the cameras' depth images are in different units; use sensors of one kind"
            )
        return scales.pop()


def went_silent_words(
    silent: Sequence[str], recorded: Set[str], off: Set[str] = frozenset()
) -> str:
    """Cause and remedy where cameras stopped sending frames during a scan; empty if none did.

    Args:
        recorded: as in `check_words`.
        off: those that were switched off.
    """
    if not silent:
        return ""
    if set(silent) <= off:
        return "the sensors were stopped during the scan; run station start first; scan again"
    remedy = check_words(silent, recorded)
    return (
        f"camera {silent[0]} went silent; {remedy}; scan again"
        if len(silent) == 1
        else f"cameras {', '.join(silent)} went silent; {remedy}; scan again"
    )


def too_slow_words(count: int, wanted: int, within_s: float, tolerance_s: float) -> str:
    """Cause and remedy where cameras work and too few framesets come.

    Args:
        tolerance_s: widest spread of a frameset. Cameras take their pictures when they like: the
            nearest of another one is up to half a frame away.
    """
    # The first comes up to a frame late.
    needed_s = (wanted + 1) / FRAME_RATE_HZ
    if needed_s > within_s:
        return (
            f"{wanted} pictures of a scan take {needed_s:.1f} s, and it may take {within_s:g} s: "
            "raise scan.max_duration_s in booth.toml, or lower scan.framesets"
        )
    if tolerance_s < 0.5 / FRAME_RATE_HZ:
        return (
            f"only {count} of the {wanted} pictures of a scan came within {within_s:g} s: pictures "
            "of the cameras are farther apart than sync.tolerance_s allows; raise it in booth.toml"
        )
    return (
        f"only {count} of the {wanted} pictures of a scan came within {within_s:g} s: this "
        "computer is too busy; stop other programs, then scan again"
    )


def check_words(silent: Sequence[str], recorded: Set[str]) -> str:
    """Remedy for cameras that send no frames; ``recorded``: all that play recordings."""
    if recorded >= set(silent):
        return "check the recording" if len(silent) == 1 else "check the recordings"
    return "check its cable" if len(silent) == 1 else "check their cables"


def silence_in_words(why: Mapping[str, str]) -> str:
    """Cameras that send no frames, those of one reason together.

    Args:
        why: camera -> the reason in brackets, or nothing.
    """
    together: dict[str, list[str]] = {}
    for name, reason in why.items():
        together.setdefault(reason, []).append(name)
    return "; ".join(
        f"camera {names[0]} sends no frames{reason}"
        if len(names) == 1
        else f"cameras {', '.join(names)} send no frames{reason}"
        for reason, names in together.items()
    )
