"""The times of a recording's frames, whatever the speed of its replay."""

from __future__ import annotations

from pathlib import Path

from station.core.errors import CalibrationError
from station.messaging.messages import FrameHeader
from station.sensors.clock import DeviceClock
from station.sensors.recording import check_recording


class RecordedClock:
    """The original times of a recording's frames, independent of the speed of the replay.

    Four recordings are replayed by four processes that start one after the other and keep pace
    each by itself; what the frames have in common is written in the recordings.
    """

    def __init__(self, folder: Path) -> None:
        listed = check_recording(folder)
        self._frames = {ticks: (index, s) for index, (s, ticks, _) in enumerate(listed)}
        self._files = {ticks: file for _, ticks, file in listed}
        self._last_index = -1
        self._last = len(listed) - 1
        self._clock: DeviceClock | None = None
        self.over = False
        """It has been seen once; from here on it starts over."""
        self.missed = 0
        """Frames of it that did not come, so far."""

    def file(self, header: FrameHeader) -> Path | None:
        """The file of a frame."""
        return self._files.get(header.device_ticks)

    def time_s(self, header: FrameHeader) -> float | None:
        """Time at which a frame was taken; None when the recording has begun anew."""
        found = self._frames.get(header.device_ticks)
        if found is None:
            raise CalibrationError(
                f"camera {header.camera} shows a frame that its recording does not hold; "
                "is another station running on these recordings?"
            )
        index, seconds = found
        if self.over:
            return None
        if index <= self._last_index:
            self.missed += self._last - self._last_index
            self.over = True
            return None
        self.missed += index - self._last_index - 1
        if self._clock is None:
            self._clock = DeviceClock(header.tick_hz, 32)
        self._last_index = index
        self.over = index == self._last
        return self._clock.host_time_s(header.device_ticks, seconds)
