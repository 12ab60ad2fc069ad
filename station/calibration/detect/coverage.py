"""Coverage of the booth by the waved ball, and advice on what to do next.

It uses each camera's image regions and distances, and the moments at which two cameras saw the
ball together; no pose is needed, so that it can be shown while the ball is waved. Whether the
calibration is good is decided by its solution.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from station.calibration.detect.detections import BallDetection
from station.core.lens import project
from station.core.rig import CameraCalibration

_ENOUGH_SEEN = 120
_ENOUGH_TOGETHER = 40
_TOGETHER_S = 0.06
_CELL_SEEN = 4
_CELLS = 6
"""Regions to be filled, of nine: not every one can be reached within the booth."""
_DEPTH_SPREAD_M = 0.12
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")
_GO = {"top": "higher", "bottom": "lower", "middle": "in the middle"}


class Coverage:
    """Counts detections as they come, those that are certain enough for a solution."""

    def __init__(
        self, cameras: Mapping[str, CameraCalibration], reference: str, radius_m: float
    ) -> None:
        self._cameras, self._reference, self._radius_m = cameras, reference, radius_m
        self._seen = dict.fromkeys(cameras, 0)
        self._covered = dict.fromkeys(cameras, 0)
        self._cells = {name: np.zeros((3, 3), np.int64) for name in cameras}
        self._depths: dict[str, tuple[float, float]] = dict.fromkeys(cameras, (0.0, 0.0))
        """Sums of the distances and of their squares."""
        self._last_s: dict[str, float] = {}
        self._together: dict[tuple[str, str], int] = {}
        """Detections of the first camera just after one of the second."""

    def add(self, ball: BallDetection) -> None:
        """Take one more detection."""
        if not ball.certain(self._radius_m):
            self._covered[ball.camera] += 1
            return
        camera = self._cameras[ball.camera]
        z = float(ball.center_m[2])
        u, v = project(camera, ball.center_m)
        row = int(np.clip(3 * v / camera.height, 0, 2))
        column = int(np.clip(3 * u / camera.width, 0, 2))
        self._cells[ball.camera][row, column] += 1
        self._seen[ball.camera] += 1
        total, squares = self._depths[ball.camera]
        self._depths[ball.camera] = (total + z, squares + z * z)
        for other, time_s in self._last_s.items():
            if other != ball.camera and abs(time_s - ball.time_s) < _TOGETHER_S:
                pair = (ball.camera, other)
                self._together[pair] = self._together.get(pair, 0) + 1
        self._last_s[ball.camera] = ball.time_s

    def counts(self) -> dict[str, int]:
        """Detections of each camera."""
        return dict(self._seen)

    def covered(self) -> dict[str, int]:
        """Detections of each camera that are not certain enough: partly covered, or far away."""
        return dict(self._covered)

    def links(self) -> dict[str, tuple[str, int]]:
        """The camera that ties each to the reference, directly or not, and the number of moments.

        The strongest ties first (Prim's tree).
        """
        tied: dict[str, tuple[str, int]] = {}
        inside, outside = [self._reference], [n for n in self._cameras if n != self._reference]
        while outside:
            count, near, far = max((self._moments(a, b), a, b) for a in inside for b in outside)
            tied[far] = (near, count)
            inside.append(far)
            outside.remove(far)
        return tied

    def _moments(self, a: str, b: str) -> int:
        """Moments at which two cameras saw the ball, each counted once whoever was first."""
        return max(self._together.get(pair, 0) for pair in ((a, b), (b, a)))

    @property
    def share(self) -> float:
        """Share of what is needed, 0 to 1."""
        return float(np.mean([min(1.0, have) for have, _ in self._needs()]))

    @property
    def enough(self) -> bool:
        return all(have >= 1.0 for have, _ in self._needs())

    def advice(self) -> str:
        """Advice for the operator, in one line."""
        have, words = min(self._needs(), key=lambda need: need[0])
        return "everything is covered" if have >= 1.0 else words

    def _needs(self) -> list[tuple[float, str]]:
        """Each need: how much of it there is (1 = enough), and what to do about it."""
        needs = []
        for name, count in self._seen.items():
            words = f"hold the ball in front of {name} ({count} of {_ENOUGH_SEEN} times seen well)"
            needs.append((count / _ENOUGH_SEEN, words))
            if count:
                needs += [(self._spread_m(name) / _DEPTH_SPREAD_M, self._nearer_words(name))]
                filled = int((self._cells[name] >= _CELL_SEEN).sum())
                needs.append((filled / _CELLS, self._where_words(name)))
        for name, (near, count) in self.links().items():
            words = (
                f"hold the ball where both {name} and {near} see it ({count} of {_ENOUGH_TOGETHER})"
            )
            needs.append((count / _ENOUGH_TOGETHER, words))
        return needs

    def _spread_m(self, name: str) -> float:
        total, squares = self._depths[name]
        count = self._seen[name]
        return float(np.sqrt(max(squares / count - (total / count) ** 2, 0.0)))

    def _nearer_words(self, name: str) -> str:
        return f"move the ball nearer to {name} and farther away"

    def _where_words(self, name: str) -> str:
        row, column = divmod(int(np.argmin(self._cells[name])), 3)
        side = f", to the {_COLUMNS[column]}" if column != 1 else ""
        return f"in the image of {name}, hold the ball {_GO[_ROWS[row]]}{side}"
