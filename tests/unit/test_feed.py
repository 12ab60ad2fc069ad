"""Frames for a calibration: the times of replayed recordings are those of the day."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from station.calibration.guide.feed import Feed, gather_frames, replayed_feed
from station.calibration.guide.recorded_clock import RecordedClock
from station.core.config import BoothConfig
from station.core.errors import CalibrationError, FormatError
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.messaging.messages import FrameHeader
from station.sensors.recorded import RecordedCamera
from station.sensors.recording import RecordedFrame, write_recording

_HZ = 60_000_000
_FIRST_TICK = 2**32 - 4 * 2_000_000
"""The counter wraps after four frames."""


def _record(folder: Path, count: int = 12, start_s: float = 100.0) -> None:
    frames = [
        RecordedFrame(
            start_s + index / 30.0,
            (_FIRST_TICK + index * 2_000_000) % 2**32,
            np.full((480, 640), 600 + index, np.uint16),
        )
        for index in range(count)
    ]
    write_recording(folder, frames, tick_hz=_HZ)


def _header(ticks: int) -> FrameHeader:
    return FrameHeader("front", "A", 640, 480, 1e-4, ticks, _HZ, 5.0, 5.0, 1, 0)


def test_a_replays_times_are_those_of_its_recording(tmp_path: Path) -> None:
    """Replays start one after the other and keep pace badly: the ball was decimetres apart."""
    _record(tmp_path / "a")
    clock = RecordedClock(tmp_path / "a")
    order = [0, 1, 4, 5, 9, 11]
    come = [clock.frames(_header((_FIRST_TICK + i * 2_000_000) % 2**32)) for i in order]
    assert [len(named) for named in come] == [1, 1, 3, 1, 4, 2]
    times = [time_s for named in come for _, time_s, _ in named]
    assert np.allclose(times, [100.0 + i / 30.0 for i in range(12)], atol=1e-5)
    assert clock.over
    assert clock.frames(_header(_FIRST_TICK)) == []


def test_a_replay_that_starts_over_without_its_last_frame_is_over(tmp_path: Path) -> None:
    _record(tmp_path / "a")
    clock = RecordedClock(tmp_path / "a")
    assert len(clock.frames(_header(_FIRST_TICK + 2_000_000))) == 2
    assert len(clock.frames(_header(_FIRST_TICK))) == 10
    assert clock.over
    assert clock.frames(_header(_FIRST_TICK)) == []


def test_a_frame_of_another_recording_is_refused(tmp_path: Path) -> None:
    _record(tmp_path / "a")
    with pytest.raises(CalibrationError, match="camera front shows a frame"):
        RecordedClock(tmp_path / "a").frames(_header(17))


def _config(*names: str) -> BoothConfig:
    cameras = tuple(RecordedCamera(name=name, recording=Path("elsewhere")) for name in names)
    return BoothConfig(cameras=cameras)


def test_recordings_are_replayed_through_capture_processes(tmp_path: Path) -> None:
    for name in ("front", "back"):
        _record(tmp_path / name, 30)
    with replayed_feed(_config("front", "back"), tmp_path) as feed:
        cameras = feed.cameras(20.0)
        taken = gather_frames(feed, cameras, 10, lambda _: None)
    assert cameras["front"].K[0, 0] == 585.0
    assert cameras["front"].model == "kinect-v1"
    for frames in taken.values():
        assert len(frames) == 10
        times = np.array([frame.time_s for frame in frames])
        assert (np.diff(times) > 0.03).all()
        assert 100.0 <= times[0] < 101.0
        values = [frame.depth_m()[0, 0] for frame in frames]
        assert (np.diff(values) > 0).all()


def test_a_replay_is_not_over_while_its_frames_wait(tmp_path: Path) -> None:
    """A short recording that ended before its reader began was called too short."""
    _record(tmp_path / "front", 30)
    with replayed_feed(_config("front"), tmp_path) as feed:
        feed.cameras(20.0)
        deadline_s = time.monotonic() + 60.0
        while not all(clock.over for clock in feed._clocks.values()):
            assert time.monotonic() < deadline_s
            feed._receive(0.1)
        assert not feed.over
        assert len(gather_frames(feed, ["front"], 30, lambda _: None)["front"]) == 30


def test_a_slow_reader_of_a_replay_misses_nothing(tmp_path: Path) -> None:
    """Frames that came while it was busy were lost, and the step was refused on a slow machine."""
    names = ("front", "back")
    for name in names:
        _record(tmp_path / name, 90)
    seen: dict[str, list[float]] = {name: [] for name in names}
    with replayed_feed(_config(*names), tmp_path) as feed:
        feed.cameras(20.0)
        deadline_s = time.monotonic() + 60.0
        while not feed.over:
            assert time.monotonic() < deadline_s
            time.sleep(1.0)
            for frame in feed.newest():
                seen[frame.camera].append(float(frame.depth_m()[0, 0]))
    expected = TABLE[600:690] * np.float32(DEPTH_SCALE_M)
    for name in names:
        assert np.allclose(seen[name], expected)


def test_a_recording_that_is_too_short_is_told_how_long_it_has_to_be(
    tmp_path: Path, one_camera: BoothConfig
) -> None:
    name = one_camera.cameras[0].name
    _record(tmp_path / "step" / name, count=6)
    with replayed_feed(one_camera, tmp_path / "step") as feed:
        feed.cameras(20.0)
        with pytest.raises(CalibrationError, match="its recording has to last 3 s or longer"):
            gather_frames(feed, [name], 60, lambda _: None)


def test_several_cameras_with_too_few_frames_have_recordings_of_their_own() -> None:
    """It said "camera a, b gave too few frames; its recording"."""
    frames = SimpleNamespace(over=True, replays=True)
    with pytest.raises(CalibrationError, match="cameras a, b gave too few frames; their recording"):
        gather_frames(cast(Feed, frames), ["a", "b"], 60, lambda _: None)


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    _record(tmp_path / "front")
    with (
        pytest.raises(FormatError, match="back"),
        replayed_feed(_config("front", "back"), tmp_path),
    ):
        pass


def test_a_station_that_does_not_run_is_said(tmp_path: Path) -> None:
    from station.calibration.guide.feed import live_feed
    from station.core.config import RuntimeConfig
    from station.core.errors import BoothError

    config = _config("front").model_copy(
        update={"runtime": RuntimeConfig(folder=tmp_path, command_timeout_s=0.3)}
    )
    with live_feed(config) as feed, pytest.raises(BoothError, match="station run"):
        feed.cameras(1.0)


@pytest.mark.parametrize(
    ("victims", "remedy"),
    [(("front",), "check its cable"), (("front", "back"), "computer is busy")],
)
def test_cameras_that_fall_silent_together_are_not_told_to_check_a_cable(
    tmp_path: Path, victims: tuple[str, ...], remedy: str
) -> None:
    """On a starved computer four cables were suspected."""
    config = _config("front", "back")
    config = config.model_copy(
        update={"runtime": config.runtime.model_copy(update={"folder": tmp_path})}
    )
    with Feed(config) as feed:
        for name in ("front", "back"):
            feed._intake.last_frame_s[name] = 0.0 if name in victims else time.monotonic()
        with pytest.raises(CalibrationError, match=remedy):
            feed.frames(0.01)
