from hypothesis import given, settings
from hypothesis import strategies as st

from station.booth.frameset import FramesetMatcher

_CAMERAS = ("a", "b", "c", "d")


@settings(max_examples=60, deadline=None)
@given(
    phases=st.lists(st.floats(0.0, 1 / 30), min_size=4, max_size=4),
    lost=st.sets(st.tuples(st.integers(0, 3), st.integers(0, 59)), max_size=30),
)
def test_sets_are_tight_ordered_and_use_each_frame_once(
    phases: list[float], lost: set[tuple[int, int]]
) -> None:
    matcher: FramesetMatcher[tuple[int, int]] = FramesetMatcher(_CAMERAS, 0.025)
    frames = sorted(
        (phases[camera] + index / 30, camera, index)
        for camera in range(4)
        for index in range(60)
        if (camera, index) not in lost
    )
    sets = [
        found
        for time_s, camera, index in frames
        for found in matcher.push(_CAMERAS[camera], time_s, (camera, index))
    ]
    used = [frame for found in sets for frame in found.frames.values()]
    assert len(used) == len(set(used))
    assert all(found.spread_s <= 0.025 for found in sets)
    assert [found.time_s for found in sets] == sorted(found.time_s for found in sets)
    if not lost:
        assert len(sets) >= 58


def test_every_phase_state_gives_sets() -> None:
    """A tolerance of 10 ms would give sets in one phase state of nine."""
    matcher: FramesetMatcher[int] = FramesetMatcher(_CAMERAS, 0.025)
    found = 0
    for index in range(30):
        for camera, phase in zip(_CAMERAS, (0.0, 0.0083, 0.0167, 0.025), strict=True):
            found += len(matcher.push(camera, index / 30 + phase, index))
    assert found >= 29


def test_a_silent_camera_costs_no_memory() -> None:
    matcher: FramesetMatcher[int] = FramesetMatcher(_CAMERAS, 0.025)
    for index in range(10_000):
        assert matcher.push("a", index / 30, index) == []
    assert matcher.dropped["a"] > 9_000


def test_a_clock_that_jumps_back_starts_anew() -> None:
    """A replayed recording once blocked the queue with frames of the future."""
    matcher: FramesetMatcher[int] = FramesetMatcher(("a", "b"), 0.025)
    matcher.push("a", 100.0, 0)
    assert matcher.push("a", 1.0, 1) == []
    assert len(matcher.push("b", 1.01, 2)) == 1


@settings(max_examples=150, deadline=None)
@given(
    phases=st.lists(st.floats(0.0, 1 / 30), min_size=4, max_size=4),
    delays=st.lists(st.floats(0.0, 0.5), min_size=4, max_size=4),
    drifts=st.lists(st.floats(-500e-6, 500e-6), min_size=4, max_size=4),
    doubled=st.sets(st.tuples(st.integers(0, 3), st.integers(0, 89)), max_size=20),
    lost=st.sets(st.tuples(st.integers(0, 3), st.integers(0, 89)), max_size=18),
)
def test_late_doubled_and_lost_frames_cost_no_more_than_themselves(
    phases: list[float],
    delays: list[float],
    drifts: list[float],
    doubled: set[tuple[int, int]],
    lost: set[tuple[int, int]],
) -> None:
    """A camera whose frames came 300 ms late found the others' frames thrown away."""
    arrivals = []
    for camera in range(4):
        for index in range(90):
            time_s = phases[camera] + index / 30 * (1.0 + drifts[camera])
            if (camera, index) in lost:
                continue
            arrivals.append((time_s + delays[camera], camera, index, time_s))
            if (camera, index) in doubled:
                arrivals.append((time_s + delays[camera], camera, index, time_s))
    matcher: FramesetMatcher[tuple[int, int]] = FramesetMatcher(_CAMERAS, 0.025)
    sets = [
        found
        for _, camera, index, time_s in sorted(arrivals)
        for found in matcher.push(_CAMERAS[camera], time_s, (camera, index))
    ]
    used = [frame for found in sets for frame in found.frames.values()]
    assert len(used) == len(set(used))
    assert all(found.spread_s <= 0.025 for found in sets)
    assert [found.time_s for found in sets] == sorted(found.time_s for found in sets)
    assert len(sets) >= 88 - 2 * len(lost)


@settings(max_examples=150, deadline=None)
@given(
    phases=st.lists(st.floats(0.0, 1 / 30), min_size=4, max_size=4),
    drifts=st.lists(st.floats(-500e-6, 500e-6), min_size=4, max_size=4),
    lost=st.sets(st.tuples(st.integers(0, 3), st.integers(0, 59)), max_size=40),
    delays=st.lists(st.lists(st.floats(0.0, 0.5), min_size=4, max_size=4), min_size=2, max_size=2),
)
def test_the_sets_follow_from_the_stamps_alone(
    phases: list[float],
    drifts: list[float],
    lost: set[tuple[int, int]],
    delays: list[list[float]],
) -> None:
    """A set was closed before the frame that fitted it better had come, or after, by chance."""
    found: list[list[dict[str, int]]] = []
    for delay in delays:
        matcher: FramesetMatcher[int] = FramesetMatcher(_CAMERAS, 0.025)
        times = {
            (camera, index): phases[camera] + index / 30 * (1.0 + drifts[camera])
            for camera in range(4)
            for index in range(60)
            if (camera, index) not in lost
        }
        arrivals = sorted((time_s + delay[key[0]], key, time_s) for key, time_s in times.items())
        found.append(
            [
                one.frames
                for _, (camera, index), time_s in arrivals
                for one in matcher.push(_CAMERAS[camera], time_s, index)
            ]
        )
    both = min(map(len, found))
    assert found[0][:both] == found[1][:both]
