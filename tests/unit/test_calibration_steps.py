"""The steps of a calibration on frames that are made up."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from seen_balls import ball

from station.calibration.detect.detections import BallDetection
from station.calibration.detect.scene import static_view
from station.calibration.detect.step_names import MARK
from station.calibration.detect.swing import LOOK_S, whole_swings
from station.calibration.guide import finder, steps
from station.calibration.guide.feed import Feed, TimedFrame
from station.calibration.guide.finder import BallFinder
from station.calibration.guide.operator import Guide
from station.calibration.guide.session import Session
from station.calibration.guide.steps import look_at_empty_booth, look_at_wall, rest_ball, wave_ball
from station.core.errors import CalibrationError
from station.core.kinect_v1 import DEPTH_SCALE_M, INDEPENDENT_HZ, RANDOM_SIGMA, TABLE
from station.sensors.recording import RecordedFrame, check_recording, write_recording
from station.simulation.scene import Mesh, box, bumped, default_rig, load_mesh
from station.simulation.sensor import SimulatedBooth, VirtualCamera

_CAMERAS = ("front-lower", "front-upper")


class _Frames:
    """A feed of a frame of each camera at a time; one camera's clock is reset midway."""

    replays = True

    def __init__(self, moments: int, reset_at: int) -> None:
        self._moments, self._reset_at, self._next = moments, reset_at, 0

    @property
    def over(self) -> bool:
        return self._next == self._moments

    def newest(self) -> list[TimedFrame]:
        moment, self._next = self._next, self._next + 1
        late = moment >= self._reset_at
        return [
            TimedFrame(
                name,
                # Its clock says something else from the reset on.
                0.1 * moment + (500.0 if late and name == _CAMERAS[0] else 0.0),
                np.zeros((4, 4), np.uint16),
                1e-3,
                clock_resets=int(late and name == _CAMERAS[0]),
            )
            for name in _CAMERAS
        ]


def test_what_is_still_looked_at_belongs_to_the_run_it_was_seen_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames pending at a reset of a clock once fell into the next run, seconds off."""

    def find_slowly(*args: Any, **_: Any) -> BallDetection:
        time.sleep(0.002)
        _, camera, _, time_s = args
        return BallDetection(
            camera.name, time_s, np.array([0, 0, 1.5]), np.eye(3), 900, 0.1, 1e-3, np.ones((5, 4))
        )

    monkeypatch.setattr(finder, "find_ball", find_slowly)
    rig = default_rig().cameras
    session = Session.begin(
        tmp_path, "2026-11-21T10:00:00Z", 0.1, {name: rig[name] for name in _CAMERAS}
    )
    feed = cast(Feed, _Frames(moments=40, reset_at=25))
    guide = Guide(attended=False, countdown_s=0.0)
    wave_ball(feed, session, guide, reference="front-upper", lasts_s=1.0)
    seen = Session.load(tmp_path)
    assert seen.runs == 2
    assert len(seen.balls) == 80
    before, after = seen.balls[:50], seen.balls[50:]
    assert max(ball.time_s for ball in before) < 2.45
    assert sum(ball.camera == _CAMERAS[0] for ball in before) == 25
    # How late the other camera's follow depends on which were found first.
    assert min(ball.time_s for ball in after if ball.camera == _CAMERAS[0]) > 2.45
    seen.end_replay("a recording")
    assert Session.load(tmp_path).replayed == "a recording"
    # Another run that was begun, and stopped, shows less than all.
    seen.begin_run()
    assert not Session.load(tmp_path).replayed


@pytest.mark.parametrize("again_seen", [False, True])
def test_what_was_seen_before_is_kept_until_it_is_seen_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, again_seen: bool
) -> None:
    """A step that was begun again, and stopped at once, lost all that was waved before."""

    def find(*args: Any, **_: Any) -> BallDetection | None:
        return ball(args[1].name, args[3]) if again_seen else None

    monkeypatch.setattr(finder, "find_ball", find)
    rig = default_rig().cameras
    session = Session.begin(tmp_path, "2026", 0.1, {name: rig[name] for name in _CAMERAS})
    session.begin_run()
    session.record_balls([ball(_CAMERAS[0], 0.1 * number) for number in range(7)])
    feed = cast(Feed, _Frames(moments=20, reset_at=20))
    guide = Guide(attended=False, countdown_s=0.0)
    wave_ball(feed, session, guide, reference="front-upper", lasts_s=1.0, again=True)
    assert len(Session.load(tmp_path).balls) == (40 if again_seen else 7)


@pytest.mark.parametrize("reset_at", [10, 20])
def test_a_second_attempt_that_is_stopped_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reset_at: int
) -> None:
    """Its first second replaced a complete first attempt; the step was no longer done."""

    class Stopped(_Frames):
        def newest(self) -> list[TimedFrame]:
            if self._next == 19:
                raise KeyboardInterrupt
            return super().newest()

    monkeypatch.setattr(steps, "_WRITE_EVERY_S", 0.0)
    monkeypatch.setattr(finder, "find_ball", lambda *args, **_: ball(args[1].name, args[3]))
    rig = default_rig().cameras
    session = Session.begin(tmp_path, "2026", 0.1, {name: rig[name] for name in _CAMERAS})
    session.begin_run()
    session.record_balls([ball(_CAMERAS[0], 0.1 * number) for number in range(7)])
    session.end_replay("a recording")
    guide = Guide(attended=False, countdown_s=0.0)

    def wave(feed: _Frames) -> None:
        frames = cast(Feed, feed)
        wave_ball(frames, session, guide, reference="front-upper", lasts_s=1.0, again=True)

    with pytest.raises(KeyboardInterrupt):
        wave(Stopped(moments=20, reset_at=reset_at))
    kept = Session.load(tmp_path)
    assert (len(kept.balls), kept.replayed) == (7, "a recording")
    assert kept.replacing
    wave(_Frames(moments=20, reset_at=reset_at))
    seen = Session.load(tmp_path)
    assert len(seen.balls) == 40
    assert not seen.replacing


def test_an_operator_is_told_when_what_he_sees_lags(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coverage is that of the frames that were looked at, not of the ball in his hand."""
    ended = threading.Event()

    class Frames(_Frames):
        @property
        def over(self) -> bool:
            if super().over:
                ended.set()
            return super().over

    told: list[str] = []
    # The search begins when the ball has been waved.
    monkeypatch.setattr(finder, "find_ball", lambda *_, **__: ended.wait() and None)
    monkeypatch.setattr(Guide, "progress", lambda _, text: told.append(text))
    rig = default_rig().cameras
    session = Session.begin(tmp_path, "2026", 0.1, {name: rig[name] for name in _CAMERAS})
    feed = cast(Feed, Frames(moments=31, reset_at=31))
    guide = Guide(attended=False, countdown_s=0.0)
    wave_ball(feed, session, guide, reference="front-upper", lasts_s=1.0)
    lag = [text.endswith(" frames are still to be looked at") for text in told[:31]]
    assert lag == 30 * [False] + [True]
    assert told[30].endswith(": 62 frames are still to be looked at")


class _Looks:
    """A feed of one frame of each camera, 20 a second, until ``lasts_s``."""

    replays = True

    def __init__(self, lasts_s: float) -> None:
        self._moments, self._next = round(INDEPENDENT_HZ * lasts_s), 0

    @property
    def over(self) -> bool:
        return self._next == self._moments

    def newest(self) -> list[TimedFrame]:
        self._next += 1
        image = np.zeros((4, 4), np.uint16)
        return [TimedFrame(name, self._next / INDEPENDENT_HZ, image, 1e-3) for name in _CAMERAS]


_PERIOD_S, _PHASE = 2.3, 0.7


def _hung(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    lasts_s: float,
    swing_m: float,
    seen: Callable[[float], bool] = lambda _: True,
) -> list[BallDetection]:
    """The detections kept of a ball that swings; ``seen``: whether it is, at a time (s)."""
    rng = np.random.default_rng(3)

    def find(*args: Any, **_: Any) -> BallDetection | None:
        _, camera, _, time_s = args
        if not seen(time_s):
            return None
        phase = 2.0 * np.pi * time_s / _PERIOD_S + _PHASE
        center_m = np.array([swing_m * np.sin(phase), 0.0, 1.5]) + rng.normal(0.0, 5e-4, 3)
        return BallDetection(
            camera.name, time_s, center_m, np.eye(3), 900, 0.1, 1e-3, np.ones((5, 4))
        )

    monkeypatch.setattr(finder, "find_ball", find)
    rig = default_rig().cameras
    session = Session.begin(folder, "2026", 0.1, {name: rig[name] for name in _CAMERAS})
    guide = Guide(attended=False, countdown_s=0.0)
    return rest_ball(cast(Feed, _Looks(lasts_s)), session, guide, "hanging-1800")


def test_a_swinging_ball_is_averaged_over_whole_swings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over three seconds, the mean was off by up to a fifth of the amplitude."""
    kept = _hung(tmp_path, monkeypatch, lasts_s=5.0, swing_m=7e-3)
    for name in _CAMERAS:
        centers_m = np.array([ball.center_m for ball in kept if ball.camera == name])
        assert abs(centers_m[:, 0].mean()) < 5e-4


def test_a_hanging_ball_that_is_lost_now_and_then_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the edge of an image: 60 detections without a gap were asked for."""
    kept = _hung(
        tmp_path, monkeypatch, lasts_s=3.5, swing_m=1e-3,
        seen=lambda time_s: round(time_s * INDEPENDENT_HZ) % 2 == 0,
    )  # fmt: skip
    assert {ball.camera for ball in kept} == set(_CAMERAS)


@pytest.mark.parametrize(
    ("lasts_s", "swing_m", "seen"),
    [
        (2.0, 1e-3, lambda _: True),
        (6.0, 0.05, lambda _: True),
        (6.0, 8e-3, lambda time_s: np.sin(2.0 * np.pi * time_s / _PERIOD_S + _PHASE) > 0.0),
        (6.0, 1e-3, lambda time_s: time_s < 0.1 or time_s > 4.6),
    ],
    ids=["short", "swing", "one side", "early glimpse"],
)
def test_a_ball_that_hangs_too_shortly_or_swings_is_not_at_rest(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lasts_s: float,
    swing_m: float,
    seen: Callable[[float], bool],
) -> None:
    """Seen on one side of its swing, it was 5 mm off; a glimpse and 1.1 s counted as 4 s."""
    words = r"no camera sees the ball at rest for 2\.5 s: .*; a recording of it has to last 3 s"
    with pytest.raises(CalibrationError, match=words):
        _hung(tmp_path, monkeypatch, lasts_s=lasts_s, swing_m=swing_m, seen=seen)


@pytest.mark.parametrize("period_s", [1.1, 1.9, 2.7, 3.1])
def test_the_mean_of_whole_swings_is_their_middle(period_s: float) -> None:
    """The mean of all that is seen in the same time is up to a fifth of the amplitude off."""
    times_s = np.arange(0.0, LOOK_S, 1.0 / INDEPENDENT_HZ)
    rng = np.random.default_rng(7)
    off_m = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
        swing_m = 8e-3 * np.sin(2.0 * np.pi * times_s / period_s + phase)
        centers_m = np.array([0.0, 0.0, 1.5]) + np.outer(swing_m, [1.0, 0.0, 0.0])
        centers_m += rng.normal(0.0, 5e-4, centers_m.shape)
        seen = [
            BallDetection("a", time_s, center_m, np.eye(3), 900, 0.1, 1e-3, np.ones((5, 4)))
            for time_s, center_m in zip(times_s.tolist(), centers_m, strict=True)
        ]
        kept = np.array([ball.center_m[0] for ball in whole_swings(seen)])
        off_m.append(abs(kept.mean()))
    assert max(off_m) < 5e-4


def test_no_more_frames_are_looked_at_than_are_worth_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neighbouring frames share their errors: all 30 a second made a booth seem surer than it was.

    A clock that goes back must not stop the looking.
    """
    looked: list[float] = []
    monkeypatch.setattr(finder, "find_ball", lambda *args, **_: looked.append(args[3]))
    session = Session.begin(
        tmp_path, "2026-11-21T10:00:00Z", 0.1, {_CAMERAS[0]: default_rig().cameras[_CAMERAS[0]]}
    )
    image = np.zeros((4, 4), np.uint16)
    with BallFinder(session, every_frame=True, held=True) as looking:
        for start_s in (500.0, 20.0):
            times = [start_s + number / 30.0 for number in range(30)]
            looking.submit(TimedFrame(_CAMERAS[0], time_s, image, 1e-3) for time_s in times)
        looking.found(wait=True)
    assert len(looked) == 2 * INDEPENDENT_HZ


def test_frames_of_a_replay_that_wait_are_kept_on_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A minute of replayed frames took 2 GB while the search was behind."""
    recording = tmp_path / "recording"
    raw = [np.full((480, 640), 600 + number, np.uint16) for number in range(20)]
    frames = [RecordedFrame(0.1 * n, 6_000_000 * (n + 1), image) for n, image in enumerate(raw)]
    write_recording(recording, frames, tick_hz=60_000_000)
    held: list[int] = []
    seen: list[float] = []

    class Frame(TimedFrame):
        def depth_m(self) -> np.ndarray:
            held.append(self.depth.size)
            return super().depth_m()

    def find_slowly(depth_m: np.ndarray, *_: Any, **__: Any) -> None:
        time.sleep(0.01)
        seen.append(float(depth_m[0, 0]))

    monkeypatch.setattr(finder, "find_ball", find_slowly)
    session = Session.begin(
        tmp_path / "session", "2026-11-21T10:00:00Z", 0.1,
        {_CAMERAS[0]: default_rig().cameras[_CAMERAS[0]]},
    )  # fmt: skip
    with BallFinder(session, every_frame=True, held=True) as looking:
        looking.submit(
            Frame(_CAMERAS[0], seconds, TABLE[image], DEPTH_SCALE_M, file=file)
            for image, (seconds, _, file) in zip(raw, check_recording(recording), strict=True)
        )
        looking.found(wait=True)
    assert sum(size > 0 for size in held) < 10
    assert sorted(seen) == pytest.approx(sorted(TABLE[600:620] * DEPTH_SCALE_M), rel=1e-6)


class _Pictures:
    """A feed that has so many frames of one camera, and then is over."""

    replays = True
    over = False

    def __init__(self, depth: list[np.ndarray]) -> None:
        self._depth = depth

    def frames(self) -> list[TimedFrame]:
        self.over = True
        return [
            TimedFrame(_CAMERAS[1], number / 30.0, depth, DEPTH_SCALE_M)
            for number, depth in enumerate(self._depth)
        ]


def _pictures(scene: SimulatedBooth, body: Mesh | None, count: int) -> list[np.ndarray]:
    camera = VirtualCamera(scene, _CAMERAS[1], body)
    return [TABLE[frame.raw] for frame in camera.frames(count)]


def test_a_board_has_to_stand_still_and_nobody_beside_it(tmp_path: Path) -> None:
    """A helper who shifted his weight beside the board was told to leave the booth."""
    session = Session.begin(
        tmp_path, "2026-11-21T10:00:00Z", 0.1, {_CAMERAS[1]: default_rig().cameras[_CAMERAS[1]]}
    )
    guide = Guide(attended=False, countdown_s=0.0)

    def look(pictures: list[np.ndarray], place: int = 0) -> None:
        look_at_wall(cast(Feed, _Pictures(pictures)), session, guide, place)

    def helped(y_m: float, shift_m: float, count: int = 15) -> list[np.ndarray]:
        board = box((-0.9, y_m, 0.5), (0.3, y_m + 0.02, 1.7))
        helper = Mesh(body.vertices + np.array([0.65 + shift_m, 0.3, 0.0]), body.faces)
        return _pictures(SimulatedBooth(clutter=[board]), helper, count)

    body = load_mesh(Path(__file__).parents[2] / "station/simulation/bodies/ben.npz")
    empty = _pictures(SimulatedBooth(), None, 60)
    look_at_empty_booth(cast(Feed, _Pictures(empty)), session, guide)
    look(helped(0.3, 0.0) + helped(0.3, 0.03))
    assert session.wall_count == 1
    away = helped(0.36, 0.0, 10)
    for moved in (
        helped(0.3, 0.0) + helped(0.33, 0.0),
        helped(0.3, 0.0, 4) + 2 * away + away[:6],
        helped(0.3, 0.0, 10) + away + helped(0.3, 0.0, 10),
    ):
        with pytest.raises(CalibrationError, match="the board moved in front of camera front-up"):
            look(moved, 1)
    for nothing in (empty[:30], empty[:15] + _pictures(SimulatedBooth(), body, 15)):
        with pytest.raises(CalibrationError, match="no camera sees a flat board that stands still"):
            look(nothing, 1)
    assert session.wall_count == 1


def test_depths_that_changed_are_noted_with_a_board(tmp_path: Path) -> None:
    name = _CAMERAS[1]
    session = Session.begin(tmp_path, "2026", 0.1, {name: default_rig().cameras[name]})
    guide = Guide(attended=False, countdown_s=0.0)
    empty, board = (
        _pictures(SimulatedBooth(clutter=clutter), None, 30)
        for clutter in ([], [box((-0.9, 0.3, 0.5), (0.3, 0.32, 1.7))])
    )
    look_at_empty_booth(cast(Feed, _Pictures(empty)), session, guide)
    look_at_wall(cast(Feed, _Pictures(_warmer(board))), session, guide, 0)
    assert session.depth_changes == {"wall-0": {name: pytest.approx(8e-4, abs=1e-4)}}
    look_at_empty_booth(cast(Feed, _Pictures(_warmer(empty))), session, guide)
    assert session.depth_changes == {"wall-0": {name: pytest.approx(0.0, abs=1e-4)}}


class _Shown(_Looks):
    """A feed in which every camera sees the same twelve pictures."""

    def __init__(self, pictures: list[np.ndarray]) -> None:
        super().__init__(2.0)
        self._pictures = pictures

    def newest(self) -> list[TimedFrame]:
        return [
            TimedFrame(frame.camera, frame.time_s, self._pictures[self._next % 12], DEPTH_SCALE_M)
            for frame in super().newest()
        ]


def _rested(
    folder: Path, monkeypatch: pytest.MonkeyPatch, empty: list[np.ndarray], now: list[np.ndarray]
) -> Session:
    """A calibration after the ball lay on the mark, of cameras that saw the empty booth before."""
    rig = default_rig().cameras
    session = Session.begin(folder, "2026", 0.1, {name: rig[name] for name in _CAMERAS})
    session.record_empty({name: static_view(empty, DEPTH_SCALE_M) for name in _CAMERAS}, [])
    monkeypatch.setattr(finder, "find_ball", lambda *given, **_: ball(given[1].name, given[3]))
    guide = Guide(attended=False, countdown_s=0.0)
    session.record_resting(MARK, rest_ball(cast(Feed, _Shown(now)), session, guide, MARK))
    return Session.load(folder)


def test_depths_that_changed_are_noted_with_a_ball(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = _pictures(SimulatedBooth(), None, 12)
    session = _rested(tmp_path, monkeypatch, empty, _warmer(empty))
    expected = {MARK: dict.fromkeys(_CAMERAS, pytest.approx(8e-4, abs=1e-4))}
    assert session.depth_changes == expected


def test_a_camera_that_was_nudged_after_the_empty_booth_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A calibration was accepted whose cameras were 17 mm off, and every scan refused after it."""
    nudged = SimulatedBooth(moved_cameras={_CAMERAS[1]: bumped(0.008, np.radians(0.3))})
    empty, now = (_pictures(booth, None, 12) for booth in (SimulatedBooth(), nudged))
    with pytest.raises(CalibrationError, match="has moved since the empty booth was recorded: by"):
        _rested(tmp_path, monkeypatch, empty, now)


def _warmer(pictures: list[np.ndarray]) -> list[np.ndarray]:
    return [np.rint((1.0 + 8e-4) * picture).astype(np.uint16) for picture in pictures]


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_a_board_before_a_noisy_sensor_stands(tmp_path: Path, noise: float) -> None:
    """With twice the assumed noise each board was said to move, whatever the technician did."""
    session = Session.begin(
        tmp_path, "2026-11-21T10:00:00Z", 0.1, {_CAMERAS[1]: default_rig().cameras[_CAMERAS[1]]}
    )
    guide = Guide(attended=False, countdown_s=0.0)
    board = box((-0.9, 0.3, 0.5), (0.3, 0.32, 1.7))
    rng = np.random.default_rng(5)

    def noisy(booth: SimulatedBooth, count: int) -> list[np.ndarray]:
        extra = np.sqrt(noise**2 - 1.0) * RANDOM_SIGMA
        found = []
        for picture in _pictures(booth, None, count):
            depth_m = np.maximum(picture, 1) * DEPTH_SCALE_M
            off_m = extra * depth_m**2 * rng.standard_normal(picture.shape)
            found.append(
                np.where(picture > 0, np.rint((depth_m + off_m) / DEPTH_SCALE_M), 0).astype(
                    np.uint16
                )
            )
        return found

    empty = noisy(SimulatedBooth(), 60)
    look_at_empty_booth(cast(Feed, _Pictures(empty)), session, guide)
    standing = noisy(SimulatedBooth(clutter=[board]), 30)
    look_at_wall(cast(Feed, _Pictures(standing)), session, guide, 0)
    assert session.wall_count == 1


@pytest.mark.filterwarnings("error")
def test_the_empty_booth_is_seen_without_anybody_in_it(tmp_path: Path) -> None:
    session = Session.begin(
        tmp_path, "2026-11-21T10:00:00Z", 0.1, {_CAMERAS[1]: default_rig().cameras[_CAMERAS[1]]}
    )
    body = load_mesh(Path(__file__).parents[2] / "station/simulation/bodies/ben.npz")
    empty = _pictures(SimulatedBooth(), None, 30)
    flickering = np.zeros((480, 640), np.uint16)
    flickering[240, 320:340] = 17_000
    for pictures, words in (
        (empty + _pictures(SimulatedBooth(), body, 30), "something moved in front of camera"),
        (60 * [np.zeros((480, 640), np.uint16)], "camera front-upper sees nothing"),
        (60 * [flickering], "camera front-upper sees nothing"),
    ):
        with pytest.raises(CalibrationError, match=words):
            look_at_empty_booth(
                cast(Feed, _Pictures(pictures)), session, Guide(attended=False, countdown_s=0.0)
            )
