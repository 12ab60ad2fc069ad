"""The frames of a recording and their times, whatever the speed of its replay."""

from __future__ import annotations

from pathlib import Path

from station.core.errors import CalibrationError
from station.messaging.messages import FrameHeader
from station.sensors.clock import DeviceClock
from station.sensors.recording import check_recording


class RecordedClock:
    """A recording's frames with their original times, independent of the speed of the replay.

    Four recordings are replayed by four processes that start one after the other and keep pace
    each by itself; what the frames have in common is written in the recordings. Frames that came
    faster than a busy machine could take them are named with the next that did come.
    """

    def __init__(self, folder: Path) -> None:
        listed = check_recording(folder)
        self._listed = listed
        self._index = {ticks: index for index, (_, ticks, _) in enumerate(listed)}
        self._next = 0
        self._clock: DeviceClock | None = None
        self.over = False
        """It has been seen once; from here on it starts over."""

    def frames(self, header: FrameHeader) -> list[tuple[int, float, Path]]:
        """The frames up to one that has come: ticks, time at which each was taken, and file.

        Without those that were named before; all that are left when the recording begins anew.

        Raises:
            CalibrationError: the recording has no such frame.
        """
        index = self._index.get(header.device_ticks)
        if index is None:
            raise CalibrationError(
                f"camera {header.camera} shows a frame that its recording does not hold; "
                "is another station running on these recordings?"
            )
        if self.over:
            return []
        if self._clock is None:
            self._clock = DeviceClock(header.tick_hz, 32)
        after = index + 1 if index >= self._next else len(self._listed)
        new = self._listed[self._next : after]
        self._next = after
        self.over = after == len(self._listed)
        host_time_s = self._clock.host_time_s
        return [(ticks, host_time_s(ticks, seconds), file) for seconds, ticks, file in new]
