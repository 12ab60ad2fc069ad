"""Which part of the booth the ball has been through, by camera and by pair, and what is missing.

Pure bookkeeping on detections: the guide on the terminal asks after every few frames, the solution
when it says what is weak.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from station.calibration.detections import BallDetection
from station.calibration.pairwise import Track, match
from station.calibration.rig import CameraCalibration

_ROWS = ("upper", "middle", "lower")
_COLUMNS = ("left", "middle", "right")
LEAST_DETECTIONS = 60
"""Of one camera: six seconds at ten a second."""
_LEAST_IN_CELL = 4
_CELLS_WANTED = 6
LEAST_PAIRED = 60
_LEAST_DEPTH_M = 0.5


@dataclass(frozen=True, slots=True)
class CameraCoverage:
    """What one camera has seen of the ball."""

    camera: str
    detections: int
    cells: NDArray[np.int64]
    """(3, 3): detections in each ninth of the image, upper row first."""
    nearest_m: float
    farthest_m: float

    @property
    def covered(self) -> int:
        """Ninths of the image in which the ball was seen often enough."""
        return int(np.sum(self.cells >= _LEAST_IN_CELL))

    def missing(self) -> list[str]:
        """Ninths of the image where it was not, in words."""
        return [
            "the middle" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"
            for row in range(3)
            for column in range(3)
            if self.cells[row, column] < _LEAST_IN_CELL
        ]


@dataclass(frozen=True, slots=True)
class Coverage:
    """Of all cameras and pairs."""

    cameras: Mapping[str, CameraCoverage]
    pairs: Mapping[tuple[str, str], int]
    """Detections of the first camera at whose time the second saw the ball, too."""

    @property
    def sufficient(self) -> bool:
        """Whether a solution is worth trying."""
        return not self.advice()

    def advice(self) -> list[str]:
        """What to do next, most urgent first."""
        found = []
        for name, seen in self.cameras.items():
            if seen.detections < LEAST_DETECTIONS:
                found.append(
                    f"camera {name} saw the ball in {seen.detections} frames "
                    f"({LEAST_DETECTIONS} are needed): wave it where {name} looks"
                )
            elif seen.covered < _CELLS_WANTED:
                places = ", ".join(seen.missing()[:3])
                found.append(f"wave the ball where camera {name} sees it {places} in its image")
            elif seen.farthest_m - seen.nearest_m < _LEAST_DEPTH_M:
                found.append(f"wave the ball nearer to and farther from camera {name}")
        for name in self._apart():
            found.append(
                f"camera {name} saw the ball too rarely together with the others: "
                "wave it where two cameras see it at a time"
            )
        return found

    def _apart(self) -> list[str]:
        """Cameras that no chain of pairs ties to the first."""
        names = list(self.cameras)
        tied = set(names[:1])
        while True:
            more = {
                other
                for pair, count in self.pairs.items()
                if count >= LEAST_PAIRED and len(tied & set(pair)) == 1
                for other in set(pair) - tied
            }
            if not more:
                return [name for name in names if name not in tied]
            tied |= more


def coverage(
    detections: Sequence[BallDetection], cameras: Mapping[str, CameraCalibration]
) -> Coverage:
    """What has been covered so far by detections in any order."""
    tracks, seen = {}, {}
    for name, camera in cameras.items():
        own = sorted(
            (detection for detection in detections if detection.camera == name),
            key=lambda detection: detection.time_s,
        )
        points = np.array([detection.center_m for detection in own]).reshape(-1, 3)
        tracks[name] = Track(np.array([detection.time_s for detection in own]), points)
        seen[name] = _camera_coverage(camera, points)
    pairs = {(a, b): len(match(tracks[a], tracks[b])[0]) for a, b in combinations(cameras, 2)}
    return Coverage(seen, pairs)


def _camera_coverage(camera: CameraCalibration, points: NDArray[np.float64]) -> CameraCoverage:
    cells = np.zeros((3, 3), np.int64)
    if len(points):
        pixels = points @ camera.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        column = np.clip((3 * pixels[:, 0] / camera.width).astype(int), 0, 2)
        row = np.clip((3 * pixels[:, 1] / camera.height).astype(int), 0, 2)
        np.add.at(cells, (row, column), 1)
    depth = points[:, 2] if len(points) else np.zeros(1)
    return CameraCoverage(camera.name, len(points), cells, float(depth.min()), float(depth.max()))
