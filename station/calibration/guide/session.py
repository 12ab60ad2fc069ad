"""A calibration that is being done: what was seen so far, on disk as it comes.

A folder with ``session.json``, ``sensors.json`` (the cameras as they come from the factory),
``observations.jsonl`` (one line for each finished step, one a second while the ball is waved) and
``scene/<camera>.npz`` (the empty booth). A line is whole or, after a crash, cut off at the next
start; the operator goes on where it ended.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from station.calibration.detect.detections import (
    BallDetection,
    Observations,
    PlaneObservation,
    finite_numbers,
)
from station.calibration.detect.scene import StaticView
from station.calibration.detect.step_names import (
    AROUND,
    BALL,
    EMPTY,
    FRONT,
    HANGING,
    HEIGHTS_M,
    MARK,
    PLACES,
    RAISED,
    STAND,
    WALL,
    kind_of,
    raised_height_m,
)
from station.core.depth.intrinsics import check_intrinsics
from station.core.errors import CalibrationError, FormatError
from station.core.files import fsync_folder, private_folder, read_json, write_json
from station.core.rig import CameraCalibration, Rig

FORMAT = "booth-calibration-session"
VERSIONS = frozenset({1})
SESSION, SENSORS = "session.json", "sensors.json"
JOURNAL, SCENE = "observations.jsonl", "scene"

Seen = TypeVar("Seen", BallDetection, PlaneObservation)

_SAME_HEIGHT_M = 0.15
"""Heights of the ball that are nearer to each other are a measurement and its correction."""
_FORGET_RAISED = "forget-raised"
_NO_ENTRY = (
    ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError, FormatError,
)  # fmt: skip
"""Errors that a line makes which no station wrote."""
_BETWEEN_RUNS_S = 10.0
"""Runs of waving are set this far apart, whatever their clocks said: these may have been reset."""


@dataclass(frozen=True, slots=True)
class Lens:
    """Intrinsics that a board gave, in place of the factory's."""

    K: list[list[float]]
    distortion: list[float]


@dataclass(slots=True)
class Session:
    """Everything seen so far; made by ``begin`` or ``load``."""

    folder: Path
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
    lenses: dict[str, Lens] = field(default_factory=dict)
    adds_to: str = ""
    """Name of the stored calibration that was taken up again."""
    runs: int = 0
    _later_s: float | None = 0.0
    """Shift of this run's times; None until its first detection."""

    @classmethod
    def begin(
        cls, folder: Path, started: str, radius_m: float, cameras: Mapping[str, CameraCalibration]
    ) -> Session:
        """A new calibration in an empty folder."""
        private_folder(folder / SCENE)
        Rig(started, next(iter(cameras)), cameras, 0.0).save(folder / SENSORS)
        document = {"format": FORMAT, "version": 1, "started": started, "radius_m": radius_m}
        # Written last: a folder without it was never begun.
        write_json(folder / SESSION, document)
        return cls(folder, started, radius_m, cameras)

    @staticmethod
    def note_origin(folder: Path, adds_to: str) -> None:
        """Note in a folder which stored calibration it was copied from."""
        path = folder / SESSION
        document = read_json(path, format=FORMAT, versions=VERSIONS)
        write_json(path, {**document, "adds_to": adds_to})

    @classmethod
    def load(cls, folder: Path) -> Session:
        """Read what an interrupted calibration has seen.

        Raises:
            FormatError: naming the file, the line and what is wrong with it.
        """
        path = folder / SESSION
        document = read_json(path, format=FORMAT, versions=VERSIONS)
        sensors = Rig.load(folder / SENSORS)
        try:
            started = str(document["started"])
            radius_m = float(finite_numbers(document["radius_m"], ()))
            if radius_m <= 0.0:
                raise ValueError(f"radius {radius_m:g}")
        except (KeyError, TypeError, ValueError, ArithmeticError) as cause:
            raise FormatError(
                f"{path} cannot be used ({cause}); start again with station calibrate --new"
            ) from None
        session = cls(folder, started, radius_m, sensors.cameras)
        session.adds_to = str(document.get("adds_to", ""))
        session._replay_journal()
        return session

    def check_cameras(self, cameras: Mapping[str, CameraCalibration]) -> None:
        """Refuse to mix what two different sets of cameras have seen.

        Raises:
            CalibrationError: naming the camera that is another one, missing or new.
        """
        for name in {**self.cameras, **cameras}:
            then = self.cameras[name].serial if name in self.cameras else None
            now = cameras[name].serial if name in cameras else None
            if then != now:
                raise CalibrationError(
                    f"camera {name} is {now or 'not configured'} now and was {then or 'not there'} "
                    f"when this calibration was started ({self.started}); start again with "
                    "station calibrate --new"
                )

    def check_radius(self, radius_m: float) -> None:
        """Refuse to mix what was seen of two different balls.

        Raises:
            CalibrationError: the radius is another one.
        """
        if self.radius_m != radius_m:
            raise CalibrationError(
                f"the calibration that was started at {self.started} uses a ball with a radius of "
                f"{self.radius_m:g} m, but booth.toml says {radius_m:g} m "
                "(calibrate.ball_radius_m): set it back if the ball is the same, or start again "
                "with station calibrate --new"
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
        return Observations(self.balls, self.mark, self.front, planes, self.around)

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

    def summary(self) -> str:
        """Summary of the observations so far, for the operator."""
        parts = {
            "the empty booth": self.done(EMPTY),
            f"{len(self.balls)} sightings of the waved ball": bool(self.balls),
            "the ball on the mark": self.done(MARK),
            "the ball in front of it": self.done(FRONT),
            f"{self.around_count} places around it": bool(self.around_count),
            f"the ball hanging at {listed(self.raised_as(HANGING).values())} m": bool(
                self.raised_as(HANGING)
            ),
            f"the ball on a stand at {listed(self.raised_as(STAND).values())} m": bool(
                self.raised_as(STAND)
            ),
            f"the board at {self.wall_count} of its places": self.done(WALL),
        }
        return ", ".join(words for words, seen in parts.items() if seen) or "nothing yet"

    def background(self, camera: str) -> StaticView | None:
        """The empty booth as a camera sees it, if that was looked at."""
        path = self.folder / SCENE / f"{camera}.npz"
        return StaticView.load(path) if path.exists() else None

    def record_empty(
        self, views: Mapping[str, StaticView], planes: Sequence[PlaneObservation]
    ) -> None:
        """The empty booth and its floor."""
        for camera, view in views.items():
            view.save(private_folder(self.folder / SCENE) / f"{camera}.npz")
        self._append({"step": EMPTY, "planes": [plane.to_json() for plane in planes]})

    @property
    def around_count(self) -> int:
        """Places on the floor around the mark at which the ball was seen."""
        return sum(place.startswith(AROUND) for place in self.around)

    @property
    def raised(self) -> list[str]:
        """Steps in which the ball was seen at a measured height."""
        return [place for place in self.around if place.startswith(RAISED)]

    def raised_as(self, kind: str) -> dict[str, float]:
        """Steps in which the ball was on a stand, or hung (STAND, HANGING), and their heights."""
        heights_m = {place: raised_height_m(place) for place in self.raised}
        return {
            place: height_m
            for place, height_m in heights_m.items()
            if height_m is not None and place.startswith(kind)
        }

    @property
    def wall_count(self) -> int:
        return sum(name.startswith(WALL) for name in self.planes)

    def record_wall(self, place: str, planes: Sequence[PlaneObservation]) -> None:
        """A flat board at one place ("wall-0", "wall-1", ...)."""
        self._append({"step": place, "planes": [plane.to_json() for plane in planes]})

    def record_resting(self, step: str, balls: Sequence[BallDetection]) -> None:
        """The ball on the mark (MARK), in front of it (FRONT) or elsewhere ("around-0", ...)."""
        self._append({"step": step, "balls": [ball.to_json() for ball in balls]})

    def begin_run(self) -> None:
        """Start another run of waving, whose times are unrelated to those before."""
        self._append({"step": "run"})

    def record_balls(self, balls: Sequence[BallDetection]) -> None:
        """The waved ball, since the last call."""
        if balls:
            self._append({"step": BALL, "balls": [ball.to_json() for ball in balls]})

    def forget_balls(self) -> None:
        """Wave from the beginning: another radius, a ball that slipped."""
        self._append({"step": "forget-balls"})

    def forget_raised(self, places: Sequence[str]) -> None:
        """Forget the ball at some heights, which were measured wrongly."""
        self._append({"step": _FORGET_RAISED, "places": list(places)})

    def record_lenses(self, lenses: Mapping[str, Lens | None]) -> None:
        """Intrinsics that the board constrains better than the factory's; None: the factory's."""
        document = {
            name: None if lens is None else {"K": lens.K, "distortion": lens.distortion}
            for name, lens in lenses.items()
        }
        self._append({"step": "board", "lenses": document})

    def _append(self, entry: dict[str, Any]) -> None:
        """One line, durably, and into memory."""
        path = self.folder / JOURNAL
        is_new = not path.exists()
        line = json.dumps(entry, allow_nan=False, separators=(",", ":")) + "\n"
        with path.open("a") as stream:
            stream.write(line)
            stream.flush()
            os.fsync(stream.fileno())
        if is_new:
            fsync_folder(self.folder)
        self._take(entry)

    def _replay_journal(self) -> None:
        path = self.folder / JOURNAL
        if not path.exists():
            return
        data = path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            # The process died while it wrote this line: what it held was seen in the last second.
            os.truncate(path, len(whole))
        for number, line in enumerate(whole.splitlines(), start=1):
            try:
                self._take(json.loads(line))
            except _NO_ENTRY as cause:
                raise FormatError(
                    f"{path}: line {number} cannot be read ({cause}); start again with "
                    "station calibrate --new"
                ) from None

    def _take(self, entry: Mapping[str, Any]) -> None:
        step = str(entry["step"])
        if step == "run":
            self.runs += 1
            self._later_s = None
        elif step == "forget-balls":
            self.balls.clear()
        elif step == _FORGET_RAISED:
            if not isinstance(entry["places"], list):
                raise ValueError("places are a list")
            for place in entry["places"]:
                self.around.pop(str(place), None)
        elif step == BALL:
            seen = self._balls(entry)
            later_s = self._moved_by(min(ball.time_s for ball in seen))
            self.balls += [replace(ball, time_s=ball.time_s + later_s) for ball in seen]
        elif step in (MARK, FRONT):
            setattr(self, step, self._balls(entry))
        elif kind_of(step) in PLACES:
            for other in self._replaced_by(step):
                del self.around[other]
            self.around[step] = self._balls(entry)
        elif step == "board":
            for name, lens in entry["lenses"].items():
                self._check_camera(str(name))
                self.lenses.pop(str(name), None)
                if lens is not None:
                    self.lenses[str(name)] = _lens(lens, self.cameras[str(name)])
        elif step != EMPTY and not step.startswith(WALL):
            raise ValueError(f"there is no step {step}")
        else:
            planes = [PlaneObservation.from_json(plane) for plane in entry["planes"]]
            self.planes[step] = self._known(planes)

    def _replaced_by(self, step: str) -> list[str]:
        """Places that the ball at a height replaces: the same height, measured wrongly; or both
        at which it hung before, maybe from another hook."""
        height_m = raised_height_m(step)
        if height_m is None:
            return []
        own = self.raised_as(kind_of(step))
        if step.startswith(HANGING) and len(own) == len(HEIGHTS_M[HANGING]):
            return list(own)
        return [other for other, its_m in own.items() if abs(its_m - height_m) < _SAME_HEIGHT_M]

    def _balls(self, entry: Mapping[str, Any]) -> list[BallDetection]:
        return self._known([BallDetection.from_json(ball) for ball in entry["balls"]])

    def _known(self, seen: list[Seen]) -> list[Seen]:
        """The same, if all are of cameras of this calibration.

        Raises:
            ValueError: one is not.
        """
        for one in seen:
            self._check_camera(one.camera)
        return seen

    def _check_camera(self, name: str) -> None:
        if name not in self.cameras:
            raise ValueError(f"there is no camera {name}")

    def _moved_by(self, first_s: float) -> float:
        """Shift of a run's times that puts it after the runs before."""
        if self._later_s is None:
            before = [ball.time_s for ball in self.balls]
            self._later_s = max(before) + _BETWEEN_RUNS_S - first_s if before else 0.0
        return self._later_s


def _lens(document: Mapping[str, Any], camera: CameraCalibration) -> Lens:
    """Intrinsics of the journal.

    Raises:
        ValueError: the camera cannot have such a lens.
    """
    K = finite_numbers(document["K"], (3, 3))
    distortion = finite_numbers(document["distortion"], (5,))
    check_intrinsics(K, distortion, camera.width, camera.height)
    return Lens(K.tolist(), distortion.tolist())


def listed(heights_m: Iterable[float]) -> str:
    """Heights (m) in words."""
    return " and ".join(f"{height_m:g}" for height_m in heights_m)
