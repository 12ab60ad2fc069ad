"""Matching the frames of several cameras by the time at which they were taken."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Generic, TypeVar

Frame = TypeVar("Frame")

_LONGEST_QUEUE = 20
"""Two thirds of a second: frames of one camera may come half a second after those of the others."""

_RECENT_S = 2.0
"""Framesets that come more rarely are too few for any scan."""
_SURE_SHARE = 0.6
"""Share of the tolerance, which is three quarters of a period at most: a set that is tighter than
half a period cannot be made tighter by the earliest camera's next frame, so it need not wait."""


@dataclass(frozen=True, slots=True)
class Frameset(Generic[Frame]):
    """One frame of every camera, taken within the tolerance."""

    frames: dict[str, Frame]
    time_s: float
    """Time of its last frame."""
    spread_s: float


class FramesetMatcher(Generic[Frame]):
    """Builds framesets in order; each frame is used at most once.

    A set is complete when the heads of all queues lie within the tolerance and the next frame of
    the earliest camera would not make it tighter; the earliest head is dropped while they do not.
    Nothing is decided before the frames that it depends on are there, so the sets follow from the
    frames' times alone, not from the order in which the cameras' frames come. Queues are short: a
    camera that lags behind loses its own frames and uses no memory.
    """

    def __init__(self, cameras: Iterable[str], tolerance_s: float) -> None:
        self._queues: dict[str, deque[tuple[float, Frame]]] = {name: deque() for name in cameras}
        self._tolerance_s, self._sure_s = tolerance_s, _SURE_SHARE * tolerance_s
        self._last_s: dict[str, float] = {}
        self.dropped: dict[str, int] = dict.fromkeys(self._queues, 0)

    def push(self, camera: str, time_s: float, frame: Frame) -> list[Frameset[Frame]]:
        """Add a frame; returns the sets that it completes."""
        queue = self._queues[camera]
        last_s = self._last_s.get(camera, -inf)
        self._last_s[camera] = time_s
        if time_s == last_s:
            # The same frame again.
            self.dropped[camera] += 1
            return []
        if time_s < last_s:
            # A clock that was reset, or a replay that started over: waiting frames are outdated.
            self.dropped[camera] += len(queue)
            queue.clear()
        queue.append((time_s, frame))
        if len(queue) > _LONGEST_QUEUE:
            queue.popleft()
            self.dropped[camera] += 1
        found = []
        while all(self._queues.values()):
            heads = {name: waiting[0][0] for name, waiting in self._queues.items()}
            earliest = min(heads, key=heads.__getitem__)
            spread = max(heads.values()) - heads[earliest]
            close = spread <= self._tolerance_s
            if close and spread > self._sure_s and len(self._queues[earliest]) < 2:
                break
            if close and not self._tighter(earliest, heads, spread):
                found.append(self._take(heads, spread))
            else:
                self._queues[earliest].popleft()
                self.dropped[earliest] += 1
        return found

    def clear(self) -> None:
        """Discard all waiting frames."""
        for queue in self._queues.values():
            queue.clear()

    def _tighter(self, earliest: str, heads: dict[str, float], spread: float) -> bool:
        queue = self._queues[earliest]
        if spread <= self._sure_s or len(queue) < 2:
            return False
        times = [queue[1][0] if name == earliest else time for name, time in heads.items()]
        return max(times) - min(times) < spread

    def _take(self, heads: dict[str, float], spread: float) -> Frameset[Frame]:
        frames = {name: queue.popleft()[1] for name, queue in self._queues.items()}
        return Frameset(frames, max(heads.values()), spread)


def rate_hz(times_s: Sequence[float], now_s: float) -> float:
    """Rate of framesets from the moments of the last ones, oldest first; 0 if none is recent."""
    # Those that came before a pause say nothing of now.
    recent = [moment_s for moment_s in times_s if now_s - moment_s < _RECENT_S]
    passed_s = recent[-1] - recent[0] if recent else 0.0
    return (len(recent) - 1) / passed_s if passed_s > 0.0 else 0.0
