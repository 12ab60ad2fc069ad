"""Clocks: framesets from stamps alone, and true times, in thousands of random booths."""

from __future__ import annotations

import random

from table import Row

from station.booth.frameset import FramesetMatcher
from station.core.kinect_v1 import TICK_BITS, TICK_HZ
from station.sensors.clock import DeviceClock

_CAMERAS = "abcd"
_TOLERANCE_S = 0.025
_FRAMES, _LEARNING = 150, 90
"""Frames of each camera, and those before which its clock's model is still being learned."""
_SPAN = 1 << TICK_BITS
_WRONG_S = 0.012


def property_rows(count: int, seed: int) -> list[Row]:
    """Random phases, rates, losses, repeats, delays, wraps and resets, in so many booths."""
    orders = sum(not _same_in_any_order(random.Random(f"{seed}.o.{case}")) for case in range(count))
    times = sum(not _true_times(random.Random(f"{seed}.t.{case}")) for case in range(count))
    return [
        Row(
            "frames lost, doubled, delayed in any order",
            "framesets depend on stamps alone",
            f"{count} booths, {orders} wrong",
            orders == 0,
        ),
        Row(
            "device clocks +-500 ppm, wrapping, reset",
            f"times within {1e3 * _WRONG_S:g} ms, resets counted",
            f"{count} clocks, {times} wrong",
            times == 0,
        ),
    ]


def _same_in_any_order(rng: random.Random) -> bool:
    """Whether the same stamps give the same framesets however late each camera's frames come."""
    lost = rng.uniform(0.01, 0.2)
    stamps = {
        camera: [
            phase_s + index / 30 * rate
            for index in range(_FRAMES)
            if rng.random() > lost
        ]
        for camera in _CAMERAS
        for phase_s, rate in [(rng.uniform(0, 1 / 30), 1.0 + rng.uniform(-5e-4, 5e-4))]
    }  # fmt: skip
    found = []
    for _ in range(2):
        arrivals = []
        for camera, times in stamps.items():
            delay_s, came_s = rng.uniform(0.0, 0.45), 0.0
            for time_s in times:
                came_s = max(came_s, time_s + delay_s + rng.uniform(0.0, 0.05))
                arrivals += [(came_s, camera, time_s)] * (1 + (rng.random() < 0.05))
        matcher: FramesetMatcher[float] = FramesetMatcher(_CAMERAS, _TOLERANCE_S)
        found.append(
            [
                one.frames
                for _, camera, time_s in sorted(arrivals)
                for one in matcher.push(camera, time_s, time_s)
            ]
        )
    both = min(map(len, found))
    used = [(camera, time_s) for one in found[0] for camera, time_s in one.items()]
    return both > 0 and found[0][:both] == found[1][:both] and len(set(used)) == len(used)


def _true_times(rng: random.Random) -> bool:
    """Whether a device's stamps come out right on the host's clock, once it has been watched."""
    clock = DeviceClock(TICK_HZ, TICK_BITS)
    rate = 1.0 + rng.uniform(-5e-4, 5e-4)
    origin = rng.choice([rng.randrange(_SPAN), _SPAN - 1, 0])
    reset_at = rng.randrange(_FRAMES) if rng.random() < 0.3 else -1
    since, worst_s = 0, 0.0
    for index in range(_FRAMES):
        if index == reset_at:
            # To within a second of where it was would be no reset that anybody could see.
            origin = (origin + rng.randrange(_SPAN // 4, _SPAN // 2)) % _SPAN
            since = index
        true_s = 100.0 + index / 30
        ticks = (origin + round(index / 30 * TICK_HZ * rate)) % _SPAN
        delay_s = rng.expovariate(1.0 / 0.003) if rng.random() < 0.9 else rng.uniform(0.0, 0.08)
        time_s = clock.host_time_s(ticks, true_s + delay_s)
        if index - since > _LEARNING // 3:
            worst_s = max(worst_s, abs(time_s - true_s))
    return worst_s < _WRONG_S and clock.resets == (1 if reset_at > 0 else 0)
