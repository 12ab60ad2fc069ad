"""Ball detection in threads beside the process that receives the frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from station.calibration.detect.ball import find_ball
from station.calibration.detect.detections import BallDetection
from station.calibration.guide.feed import TimedFrame
from station.calibration.guide.session import Session
from station.core.kinect_v1 import INDEPENDENT_HZ

_THREADS = 2
_WAITING = 6
"""Largest number of live frames in the queue; further ones are dropped."""
_APART_S = 1.0 / INDEPENDENT_HZ
_EARLY_S, _NEAR_S = 0.1 * _APART_S, 1.5 * _APART_S
_RESET_S = 1.0
"""A frame that is earlier than expected by more is of a clock that was reset."""


class BallFinder:
    """Finds the ball of a session in front of its empty booth. Use it in a ``with`` statement."""

    def __init__(self, session: Session, *, every_frame: bool, held: bool) -> None:
        """``every_frame``: process each frame that is due, even if the search falls behind.

        ``held``: the ball is in a hand, whose fingers may lie on it.
        """
        self._radius_m, self._cameras = session.radius_m, session.lensed_cameras()
        self._backgrounds = {
            name: view.depth_m()
            for name in session.cameras
            if (view := session.background(name)) is not None
        }
        self._every_frame, self._held = every_frame, held
        self._due_s: dict[str, float] = {}
        self._pool = ThreadPoolExecutor(_THREADS)
        self._pending: deque[Future[BallDetection | None]] = deque()

    def __enter__(self) -> BallFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def submit(self, frames: Iterable[TimedFrame]) -> None:
        """Queue frames for the search, at most ``INDEPENDENT_HZ`` per second of each camera."""
        for frame in frames:
            due_s = self._due_s.get(frame.camera, frame.time_s)
            late_s = frame.time_s - due_s
            if -_RESET_S < late_s < -_EARLY_S:
                continue
            if self._every_frame or len(self._pending) < _WAITING:
                # Frames near their due time keep the schedule: of 30 a second 20 are used, not 15.
                beat_s = due_s if abs(late_s) < _NEAR_S else frame.time_s
                self._due_s[frame.camera] = beat_s + _APART_S
                # A replay may be a minute ahead of the search: its frames wait on disk.
                waiting = frame if len(self._pending) < _WAITING else frame.on_disk()
                self._pending.append(self._pool.submit(self._find, waiting))

    @property
    def waiting(self) -> int:
        """Frames that have not been looked at yet."""
        return len(self._pending)

    def found(self, *, wait: bool = False) -> list[BallDetection]:
        """Detections since the last call, in the order of the frames."""
        balls = []
        while self._pending and (wait or self._pending[0].done()):
            ball = self._pending.popleft().result()
            if ball is not None:
                balls.append(ball)
        return balls

    def _find(self, frame: TimedFrame) -> BallDetection | None:
        return find_ball(
            frame.depth_m(),
            self._cameras[frame.camera],
            self._radius_m,
            frame.time_s,
            background_m=self._backgrounds.get(frame.camera),
            held=self._held,
        )
