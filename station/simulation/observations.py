"""A calibration of the virtual booth without an operator: every step's frames, detected at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.ball import find_ball
from station.calibration.detect.detections import BallDetection, Observations, PlaneObservation
from station.calibration.detect.planes import observe_floor, observe_wall
from station.calibration.detect.scene import static_view
from station.calibration.detect.step_names import (
    BALL,
    EMPTY,
    FRONT,
    HANGING,
    MARK,
    PLACES,
    WALL,
    kind_of,
)
from station.calibration.detect.swing import LOOK_S, whole_swings
from station.core.kinect_v1 import DEPTH_SCALE_M, depth_of_raw
from station.core.rig import CameraCalibration
from station.sensors.clock import DeviceClock
from station.simulation.procedure import STRIDE, VirtualProcedure
from station.simulation.sensor import TICK_HZ

_Depth = NDArray[np.uint16]

_TRANSPORT_S = (0.004, 0.0015)
"""Least delay from exposure to host, and the mean of what comes on top."""
_LOOK_S = 1.0
"""At the ball at rest, and at the board."""


def simulate(procedure: VirtualProcedure, camera: CameraCalibration) -> Observations:
    """The observations of one camera: waved and resting ball, floor, boards."""
    name = camera.name
    index = list(procedure.booth.rig.cameras).index(name)
    rng = np.random.default_rng((procedure.booth.seed, index, 4))
    clock = DeviceClock(TICK_HZ, 32)

    def timed(step: str, limit_s: float | None, every: float) -> Iterator[tuple[float, _Depth]]:
        for frame in procedure.frames(name, step, stride=every, limit_s=limit_s):
            delay_s = _TRANSPORT_S[0] + rng.exponential(_TRANSPORT_S[1])
            time_s = clock.host_time_s(frame.ticks, frame.time_s + delay_s)
            yield time_s, depth_of_raw(frame.raw)

    def still(step: str, limit_s: float | None) -> _Depth:
        return np.stack([depth for _, depth in timed(step, limit_s, 1)])

    empty = still(EMPTY, None)
    background = static_view(empty, DEPTH_SCALE_M).depth_m()

    def balls(step: str, limit_s: float | None) -> list[BallDetection]:
        found = (
            find_ball(
                depth * np.float32(DEPTH_SCALE_M),
                camera,
                procedure.radius_m,
                time_s,
                background,
                held=step == BALL,
            )
            for time_s, depth in timed(step, limit_s, STRIDE)
        )
        return [detection for detection in found if detection is not None]

    planes: list[PlaneObservation | None] = [observe_floor(empty, DEPTH_SCALE_M, camera)]
    waved, mark, front = balls(BALL, None), balls(MARK, _LOOK_S), balls(FRONT, _LOOK_S)
    for step in procedure.steps:
        if kind_of(step) == WALL:
            planes.append(
                observe_wall(still(step, _LOOK_S), DEPTH_SCALE_M, camera, step, background)
            )
    around = {
        step: whole_swings(balls(step, LOOK_S))
        if step.startswith(HANGING)
        else balls(step, _LOOK_S)
        for step in procedure.steps
        if step.startswith(PLACES)
    }
    return Observations(
        waved, mark, front, [plane for plane in planes if plane is not None], around
    )
