"""Device ticks to host time.

Frames reach the host late by a delay that varies but is never negative: the true relation of the
two clocks is the lower envelope of (host arrival - device time). Its line is the lower convex
hull's segment over the middle of a sliding window; crystals differ by tens to hundreds of ppm.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

_WINDOW_S = 30.0
_BUCKET_S = 0.5
_MAX_DRIFT = 0.05
"""Crystals differ by far less; a replay may play a few per cent slower than its ticks say."""
_MIN_SPAN_S = 2.0
_JUMP_S = 1.0
_STALE_S = 0.1
"""Frames this late, one after the other, show that the line is no longer valid, for example because
a replay is slower than its recording. It is then learned again; after a mere stall it is valid
again at once."""


@dataclass(slots=True)
class DeviceClock:
    """Maps one device's wrapping tick counter to the host's monotonic clock."""

    tick_hz: float
    tick_bits: int
    resets: int = 0
    _epoch_ticks: int = 0
    _last_ticks: int | None = None
    _last_arrival_s: float = 0.0
    _envelope: deque[tuple[float, float]] = field(default_factory=deque)
    """(device seconds, least delay) of each bucket."""

    @property
    def offset_s(self) -> float | None:
        """Host's time minus the device's, by the model, at the last frame; None before any."""
        if not self._envelope:
            return None
        return self._offset_at(self._epoch_ticks / self.tick_hz)

    @property
    def drift(self) -> float | None:
        """Relative rate of the host's clock against the device's; None within the first seconds."""
        if len(self._envelope) < 2:
            return None
        (x0, y0), (x1, y1) = self._envelope[0], self._envelope[-1]
        return (y1 - y0) / (x1 - x0) if x1 - x0 > _MIN_SPAN_S else None

    def host_time_s(self, ticks: int, arrival_s: float) -> float:
        """Time at which a frame was taken, on the host's monotonic clock, in seconds.

        A counter that jumps back, or apart from the host's clock by over a second, was reset: the
        model starts over.
        """
        device_s = self._unwrapped_s(ticks, arrival_s)
        delay_s = arrival_s - device_s
        self._learn(device_s, delay_s)
        offset_s = self._offset_at(device_s)
        if delay_s - offset_s > _STALE_S:
            self._envelope.clear()
            self._learn(device_s, delay_s)
            offset_s = delay_s
        return device_s + min(offset_s, delay_s)

    def _unwrapped_s(self, ticks: int, arrival_s: float) -> float:
        span = 1 << self.tick_bits
        if self._last_ticks is not None:
            forward = (ticks - self._last_ticks) % span
            device_step_s = forward / self.tick_hz
            host_step_s = arrival_s - self._last_arrival_s
            # A whole wrap may pass unseen while a sensor is silent.
            wrap_s = span / self.tick_hz
            missed = max(0, round((host_step_s - device_step_s) / wrap_s))
            if abs(device_step_s + missed * wrap_s - host_step_s) > _JUMP_S:
                self.resets += 1
                self._envelope.clear()
                self._epoch_ticks = ticks
            else:
                self._epoch_ticks += forward + missed * span
        else:
            self._epoch_ticks = ticks
        self._last_ticks, self._last_arrival_s = ticks, arrival_s
        return self._epoch_ticks / self.tick_hz

    def _learn(self, device_s: float, delay_s: float) -> None:
        envelope = self._envelope
        if envelope and device_s - envelope[-1][0] < _BUCKET_S:
            if delay_s < envelope[-1][1]:
                # The bucket keeps its age, so that it expires; the point moves to the better
                # reading.
                envelope[-1] = (envelope[-1][0], delay_s)
        else:
            envelope.append((device_s, delay_s))
        while device_s - envelope[0][0] > _WINDOW_S:
            envelope.popleft()

    def _offset_at(self, device_s: float) -> float:
        points = list(self._envelope)
        span_s = points[-1][0] - points[0][0]
        if span_s < _MIN_SPAN_S:
            return min(delay for _, delay in points)
        hull = _lower_hull(points)
        middle = 0.5 * (points[0][0] + points[-1][0])
        for (x0, y0), (x1, y1) in pairwise(hull):
            if x0 <= middle <= x1:
                slope = max(-_MAX_DRIFT, min(_MAX_DRIFT, (y1 - y0) / (x1 - x0)))
                return y0 + slope * (device_s - x0)
        return hull[0][1]


def _lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Lower convex hull of points sorted by x (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) >= 2:
            (x0, y0), (x1, y1) = hull[-2], hull[-1]
            if (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0:
                break
            hull.pop()
        hull.append((x, y))
    return hull
