"""Check of the cameras with every scan: its background against the calibration's empty booth.

A camera that moved stays moved. What hardly alarms is therefore told only if the next scan says the
same: alarms of cameras that stand still are hardly above the limit, and mostly single. So are views
that a person and things fill.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView
from station.calibration.guide.store import CalibrationStore
from station.calibration.moves.look import Look
from station.calibration.moves.motion import CameraMove
from station.calibration.moves.reference import DriftReference
from station.core.errors import BoothError, CalibrationError
from station.core.rig import CameraCalibration

_CHANGED = "another calibration was put into use during this scan; scan again"


class Doubts:
    """Alarms that wait for the next scan."""

    def __init__(self) -> None:
        self._last: dict[str, CameraMove] = {}

    def confirmed(self, move: CameraMove) -> bool:
        """Whether this scan's estimate, with that of the scan before, says that a camera moved."""
        before = self._last.pop(move.camera, None)
        if not (move.moved or move.lost):
            return False
        self._last[move.camera] = move
        return move.certain or (before is not None and move.agrees(before))

    def forget(self) -> None:
        """Nothing was seen before: another calibration is in use."""
        self._last.clear()


class DriftWatch:
    """The check against the calibration in use; it reloads when another is put into use."""

    def __init__(self, store: CalibrationStore) -> None:
        self._store = store
        self._content = b""
        self._views: Mapping[str, StaticView] = {}
        self._cameras: Mapping[str, CameraCalibration] = {}
        self._references: dict[str, DriftReference] = {}
        self._doubts = Doubts()

    def confirmed(self, move: CameraMove) -> bool:
        """Whether a scan is to be refused for a move; each scan's is asked for once, in order."""
        return self._doubts.confirmed(move)

    def prepare(self, camera: CameraCalibration) -> None:
        """Prepare the check of a camera, a quarter of a second, before a scan waits for it.

        Raises:
            CalibrationError: the calibration's empty booth cannot be read, or the camera is of
                another calibration than the one in use.
        """
        self._follow()
        if camera.name not in self._views:
            return
        used = self._cameras.get(camera.name)
        if used is None or used.to_json() != camera.to_json():
            raise CalibrationError(_CHANGED)
        if camera.name not in self._references:
            self._references[camera.name] = DriftReference.prepare(camera, self._views[camera.name])

    def look(
        self, camera: CameraCalibration, frames: Sequence[NDArray[np.uint16]], scale_m: float
    ) -> Look | None:
        """Look at frames of one moment; None where nothing was stored of the camera.

        Raises:
            CalibrationError: as `prepare`; or the camera's images are of another size than when it
                was calibrated.
        """
        self.prepare(camera)
        view = self._views.get(camera.name)
        if view is None:
            return None
        if frames[0].shape != view.inverse_depth.shape:
            height, width = frames[0].shape
            raise CalibrationError(
                f"camera {camera.name} gives images of {width} x {height}, not those that it was "
                "calibrated with; run station calibrate"
            )
        return Look.of(self._references[camera.name], view, frames, scale_m)

    def _follow(self) -> None:
        try:
            content = self._store.in_use.read_bytes()
            if content == self._content:
                return
            self._references, self._views, self._content = {}, {}, b""
            self._doubts.forget()
            views, cameras = self._store.scene(), self._store.rig_in_use().cameras
            changed = self._store.in_use.read_bytes() != content
        except (BoothError, OSError) as error:
            raise CalibrationError(
                f"this scan could not be checked for moved cameras ({error}); scan again; if it "
                "happens again, run station calibrate"
            ) from None
        if changed:
            raise CalibrationError(_CHANGED)
        self._views, self._cameras, self._content = views, cameras, content
