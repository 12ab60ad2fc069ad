"""Looks for the ball in frames as they come, beside whoever receives them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor

from station.calibration.ball import find_ball
from station.calibration.detections import BallDetection
from station.calibration.feed import TimedFrame
from station.calibration.session import Session

_THREADS = 2
_WAITING = 6
"""More frames than that do not wait: newer ones come."""


class BallFinder:
    """Finds the ball of a session in front of its empty booth. Use it in a ``with`` statement."""

    def __init__(self, session: Session, *, patient: bool) -> None:
        """``patient``: look at every frame, however long that takes."""
        self._radius_m, self._cameras = session.radius_m, session.lensed_cameras()
        self._backgrounds = {
            name: view.depth_m()
            for name in session.cameras
            if (view := session.background(name)) is not None
        }
        self._patient = patient
        self._pool = ThreadPoolExecutor(_THREADS)
        self._pending: deque[Future[BallDetection | None]] = deque()

    def __enter__(self) -> BallFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def look(self, frames: Iterable[TimedFrame]) -> None:
        """Take frames to look at."""
        for frame in frames:
            if self._patient or len(self._pending) < _WAITING:
                self._pending.append(self._pool.submit(self._find, frame))

    def found(self, *, wait: bool = False) -> list[BallDetection]:
        """What was found since the last call, in the order of the frames."""
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
        )
