"""Comparison of cameras with their calibration: first of their depths, then of their places."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView, mean_view
from station.calibration.moves.depths import (
    ChangedDepths,
    SeenDepths,
    changed_depths,
    seen_depths,
)
from station.calibration.moves.estimate import estimate_move
from station.calibration.moves.motion import CameraMove
from station.calibration.moves.reference import DriftReference
from station.core.depth.images import Image
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
_UNCHANGED = np.zeros(1)


@dataclass(frozen=True, slots=True)
class Look:
    """One camera's background in some frames, beside what it was when the booth was calibrated."""

    reference: DriftReference
    mean: Image
    share: Image
    """See `station.calibration.detect.scene.mean_view`."""
    frames: int
    depths: SeenDepths | None

    @classmethod
    def of(
        cls,
        reference: DriftReference,
        empty: StaticView,
        frames: Sequence[NDArray[np.uint16]],
        scale_m: float,
    ) -> Look:
        """Compare frames (h, w) in units of scale_m with the stored background."""
        seen = mean_view(frames, scale_m)
        return cls(reference, *seen, len(frames), seen_depths(reference, empty, *seen, len(frames)))

    def move(self, law: Array = _UNCHANGED) -> CameraMove:
        """The camera's displacement, if its depths have changed by this law."""
        inverse = self.mean / np.maximum(self.share, 1e-6)
        mean = self.mean + self.share * np.polynomial.polynomial.polyval(inverse, law)
        return estimate_move(self.reference, np.asarray(mean, np.float32), self.share, self.frames)


def compared(
    looks: Mapping[str, Look], cameras: Iterable[str]
) -> tuple[ChangedDepths | None, list[CameraMove]]:
    """The change of all depths, if there is one, and the displacements that remain, in the order of
    the looks. Depths that changed would pass for cameras that moved.

    Args:
        cameras: all of the booth's.
    """
    changed = changed_depths({n: looks[n].depths if n in looks else None for n in cameras})
    laws = changed.laws if changed is not None else {}
    return changed, [look.move(laws.get(name, _UNCHANGED)) for name, look in looks.items()]


def certainly_moved(
    cameras: Mapping[str, CameraCalibration],
    empty: Mapping[str, StaticView],
    looked: Mapping[str, tuple[Sequence[NDArray[np.uint16]], float]],
) -> list[CameraMove]:
    """Moves of the cameras that no longer stand, without doubt, where they saw the empty booth.

    Args:
        looked: camera -> frames (h, w) and their scale; people may stand in its view.
    """
    looks = {
        name: Look.of(DriftReference.prepare(cameras[name], empty[name]), empty[name], *seen)
        for name, seen in looked.items()
        if name in empty
    }
    return [move for move in compared(looks, cameras)[1] if move.moved and move.certain]
