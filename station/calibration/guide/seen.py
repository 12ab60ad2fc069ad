"""Observations of a calibration so far, step by step, and what they amount to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from station.calibration.detect.detections import BallDetection, Observations, PlaneObservation
from station.calibration.detect.step_names import (
    AROUND,
    EMPTY,
    FRONT,
    HANGING,
    HEIGHTS_M,
    MARK,
    RAISED,
    STAND,
    WALL,
    kind_of,
    raised_height_m,
)
from station.core.errors import CalibrationError
from station.core.files import local_time
from station.core.rig import CameraCalibration
from station.sensors.identity import calibrated_serials, differences

_ANEW = "start again with station calibrate --new"
_SAME_HEIGHT_M = 0.15
"""Heights of the ball that are nearer to each other are a measurement and its correction."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics that a board gave, in place of the factory's."""

    K: list[list[float]]
    distortion: list[float]


@dataclass(slots=True)
class Seen:
    """Everything seen so far."""

    started: str
    """UTC, ISO 8601."""
    radius_m: float
    cameras: Mapping[str, CameraCalibration]
    """As they come from the factory: lenses known, places not."""
    mark: list[BallDetection] = field(default_factory=list)
    front: list[BallDetection] = field(default_factory=list)
    balls: list[BallDetection] = field(default_factory=list)
    planes: dict[str, list[PlaneObservation]] = field(default_factory=dict)
    """Step -> the surfaces seen in it."""
    around: dict[str, list[BallDetection]] = field(default_factory=dict)
    """Place -> the ball resting there: on the floor, on a stand, or hanging."""
    depth_changes: dict[str, dict[str, float]] = field(default_factory=dict)
    """Step -> camera -> relative change of its depths since the empty booth was recorded."""
    lenses: dict[str, Lens] = field(default_factory=dict)
    adds_to: str = ""
    """Name of the stored calibration that was taken up again."""

    def check_cameras(self, serials: Mapping[str, str], anew: str = _ANEW) -> None:
        """Refuse to mix what two different sets of cameras have seen.

        Args:
            serials: camera -> serial number, of all that the booth has now.
            anew: words on how another calibration is begun.

        Raises:
            CalibrationError: naming the cameras that are others, missing or new.
        """
        if others := differences(calibrated_serials(self.cameras), serials):
            raise CalibrationError(
                f"the calibration that was started at {local_time(self.started)} is of other "
                f"cameras: {'; '.join(others)}; put the sensors and booth.toml back as they were, "
                f"or {anew}"
            )

    def check_radius(self, radius_m: float, anew: str = _ANEW) -> None:
        """Refuse to mix what was seen of two different balls; ``anew`` as in `check_cameras`.

        Raises:
            CalibrationError: the radius is another one.
        """
        if self.radius_m != radius_m:
            raise CalibrationError(
                f"the calibration that was started at {local_time(self.started)} uses a ball with "
                f"a radius of {self.radius_m:g} m, but booth.toml says {radius_m:g} m "
                f"(calibrate.ball_radius_m): set it back if the ball is the same, or {anew}"
            )

    def lensed_cameras(self) -> dict[str, CameraCalibration]:
        """The cameras, with the lenses that a board gave where it gave any."""
        return {
            name: camera
            if (lens := self.lenses.get(name)) is None
            else replace(camera, K=np.array(lens.K), distortion=np.array(lens.distortion))
            for name, camera in self.cameras.items()
        }

    def observations(self) -> Observations:
        """The observations that the calibration is solved from."""
        planes = [plane for seen in self.planes.values() for plane in seen]
        return Observations(
            self.balls, self.mark, self.front, planes, self.around, self.depth_changes
        )

    def done(self, step: str) -> bool:
        """True once a step is finished (waving never is: more of it always helps)."""
        if step in (MARK, FRONT):
            return bool(getattr(self, step))
        if step == WALL:
            return any(name.startswith(WALL) for name in self.planes)
        return step in self.planes

    @property
    def waved_s(self) -> int:
        """Seconds in which the waved ball was seen."""
        return len({int(ball.time_s) for ball in self.balls})

    @property
    def anything(self) -> bool:
        """Whether there is something to keep."""
        return any((self.balls, self.mark, self.front, self.planes, self.around, self.lenses))

    def summary(self) -> str:
        """Summary of the observations so far, for the operator."""
        places = self.around_count
        parts = {
            "the empty booth": self.done(EMPTY),
            f"{len(self.balls)} sightings of the waved ball": bool(self.balls),
            "the ball on the mark": self.done(MARK),
            "the ball in front of it": self.done(FRONT),
            "1 place around it" if places == 1 else f"{places} places around it": bool(places),
            f"the ball hanging at {listed(self.raised_as(HANGING).values())} m": bool(
                self.raised_as(HANGING)
            ),
            f"the ball on a stand at {listed(self.raised_as(STAND).values())} m": bool(
                self.raised_as(STAND)
            ),
            f"the board at {self.wall_count} of its places": self.done(WALL),
        }
        return "; ".join(words for words, seen in parts.items() if seen) or "nothing yet"

    @property
    def around_count(self) -> int:
        """Places on the floor around the mark at which the ball was seen."""
        return sum(kind_of(place) == AROUND for place in self.around)

    @property
    def raised(self) -> list[str]:
        """Steps in which the ball was seen at a measured height."""
        return [place for place in self.around if kind_of(place) in RAISED]

    def raised_as(self, kind: str) -> dict[str, float]:
        """Steps in which the ball was on a stand, or hung (STAND, HANGING), and their heights."""
        heights_m = {place: raised_height_m(place) for place in self.raised}
        return {
            place: height_m
            for place, height_m in heights_m.items()
            if height_m is not None and kind_of(place) == kind
        }

    @property
    def raised_enough(self) -> bool:
        """Whether the ball was seen at both heights on a stand, or hanging."""
        return any(len(self.raised_as(kind)) >= len(HEIGHTS_M[kind]) for kind in RAISED)

    @property
    def wall_count(self) -> int:
        return sum(name.startswith(WALL) for name in self.planes)

    def replaced_by(self, step: str) -> list[str]:
        """Places that the ball at a height replaces: the same height, measured wrongly; or both
        at which it hung before, maybe from another hook."""
        height_m = raised_height_m(step)
        if height_m is None:
            return []
        own = self.raised_as(kind_of(step))
        if step.startswith(HANGING) and len(own) == len(HEIGHTS_M[HANGING]):
            return list(own)
        return [other for other, its_m in own.items() if abs(its_m - height_m) < _SAME_HEIGHT_M]


def listed(heights_m: Iterable[float]) -> str:
    """Heights (m) in words."""
    return " and ".join(f"{height_m:g}" for height_m in heights_m)
