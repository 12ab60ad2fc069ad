"""A calibration that is being done: what is seen is put on disk as it comes, and read again.

A folder with ``session.json``, ``sensors.json`` (the cameras as they come from the factory),
``observations.jsonl`` (one line for each finished step, one a second while the ball is waved, and
one for all of it where it replaces what was seen before) and ``scene/<camera>.npz`` (the empty
booth). A line is whole or, after a crash, cut off at the next start; the operator goes on where it
ended.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from station.calibration.detect.detections import (
    BallDetection,
    PlaneObservation,
    finite_numbers,
)
from station.calibration.detect.scene import StaticView
from station.calibration.detect.step_names import (
    BALL,
    EMPTY,
    FRONT,
    MARK,
    PLACES,
    WALL,
    kind_of,
)
from station.calibration.guide.seen import Lens, Seen
from station.core.depth.intrinsics import check_intrinsics
from station.core.errors import FormatError
from station.core.files import fsync_folder, private_folder, read_json, utc_now, write_json
from station.core.rig import CameraCalibration, Rig

FORMAT = "booth-calibration-session"
VERSIONS = frozenset({1})
SESSION, SENSORS = "session.json", "sensors.json"
JOURNAL, SCENE = "observations.jsonl", "scene"

Observed = TypeVar("Observed", BallDetection, PlaneObservation)

_FORGET_RAISED, _REPLAYED, _BALL_AGAIN = "forget-raised", "ball-replayed", "ball-again"
_RUN, _RUN_AGAIN = "run", "run-again"
_DEPTHS = "depth_changes"
"""Field of an entry: camera -> relative change of its depths since the empty booth."""
_FORGET_BALLS = "forget-balls"
"""Entry of earlier versions, which forgot the waved ball before it was seen anew."""
_NO_ENTRY = (
    ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError, FormatError,
)  # fmt: skip
"""Errors that a line makes which no station wrote."""
_BETWEEN_RUNS_S = 10.0
"""Runs of waving are set this far apart, whatever their clocks said: these may have been reset."""


@dataclass(slots=True, kw_only=True)
class Session(Seen):
    """Everything seen so far, on disk; made by ``begin`` or ``load``."""

    folder: Path
    runs: int = 0
    replayed: str = ""
    """Fingerprint of the recording of the waved ball that was looked at to its end."""
    replacing: bool = False
    """The ball is being waved anew, or this was stopped: nothing is replaced yet."""
    _later_s: float | None = 0.0
    """Shift of this run's times; None until its first detection."""
    _noted: dict[str, dict[str, float]] = field(default_factory=dict)
    """Notes by `note_depths` on a step that is not recorded yet."""

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
        return cls(started, radius_m, cameras, folder=folder)

    @staticmethod
    def note_origin(folder: Path, adds_to: str) -> None:
        """Note in a folder which stored calibration it was copied from, just now."""
        path = folder / SESSION
        document = read_json(path, format=FORMAT, versions=VERSIONS)
        write_json(path, {**document, "adds_to": adds_to, "started": utc_now()})

    @staticmethod
    def begun(folder: Path) -> str:
        """Moment at which a calibration was begun, without reading what it has seen."""
        return str(read_json(folder / SESSION, format=FORMAT, versions=VERSIONS).get("started"))

    @staticmethod
    def times_waved_anew(folder: Path) -> int:
        """Number of times that the ball was begun to be waved anew, without reading what was seen.

        Raises:
            OSError: the folder cannot be read.
        """
        path = folder / JOURNAL
        return path.read_bytes().count(_line({"step": _RUN_AGAIN})) if path.exists() else 0

    @classmethod
    def load(cls, folder: Path, *, mend: bool = True) -> Session:
        """Read what an interrupted calibration has seen.

        Args:
            mend: cut off a line that was not written whole; not where it may be being written.

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
        session = cls(started, radius_m, sensors.cameras, folder=folder)
        session.adds_to = str(document.get("adds_to", ""))
        session._replay_journal(mend=mend)
        return session

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
        seen = {"step": EMPTY, "planes": [plane.to_json() for plane in planes]}
        self._append({**seen, **self._noted_depths(EMPTY)})

    def note_depths(self, step: str, changes: Mapping[str, float]) -> None:
        """Note relative changes of the cameras' depths since the empty booth was recorded, to be
        recorded with the step."""
        self._noted = {step: dict(changes)}

    def record_wall(self, place: str, planes: Sequence[PlaneObservation]) -> None:
        """A flat board at one place ("wall-0", "wall-1", ...)."""
        seen = {"step": place, "planes": [plane.to_json() for plane in planes]}
        self._append({**seen, **self._noted_depths(place)})

    def record_resting(self, step: str, balls: Sequence[BallDetection]) -> None:
        """The ball on the mark (MARK), in front of it (FRONT) or elsewhere ("around-0", ...)."""
        seen = {"step": step, "balls": [ball.to_json() for ball in balls]}
        self._append({**seen, **self._noted_depths(step)})

    def _noted_depths(self, step: str) -> dict[str, Any]:
        """The step's part of its line on the depths; nothing where they were not seen."""
        changes = self._noted.pop(step, {})
        return {_DEPTHS: changes} if changes else {}

    def begin_run(self, *, again: bool = False) -> None:
        """Start another run of waving, whose times are unrelated to those before; ``again``: it is
        to replace them."""
        self._append({"step": _RUN_AGAIN if again else _RUN})

    def record_balls(self, balls: Sequence[BallDetection]) -> None:
        """The waved ball, since the last call."""
        if balls:
            self._append({"step": BALL, "balls": [ball.to_json() for ball in balls]})

    def replace_balls(self, runs: Sequence[Sequence[BallDetection]]) -> None:
        """The ball waved anew, in place of all that was seen of it: one line, so that there is
        always one or the other, and whole."""
        seen = [{"balls": [ball.to_json() for ball in run]} for run in runs]
        self._append({"step": _BALL_AGAIN, "runs": seen})

    def end_replay(self, recording: str) -> None:
        """A recording (its fingerprint) of the waved ball was looked at to its end: it shows
        nothing more."""
        self._append({"step": _REPLAYED, "recording": recording})

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
        line = _line(entry)
        with path.open("ab") as stream:
            stream.write(line)
            stream.flush()
            os.fsync(stream.fileno())
        if is_new:
            fsync_folder(self.folder)
        self._take(entry)

    def _replay_journal(self, *, mend: bool) -> None:
        path = self.folder / JOURNAL
        if not path.exists():
            return
        data = path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if mend and len(whole) < len(data):
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
        self.replacing = step == _RUN_AGAIN
        if step == _RUN:
            self.runs += 1
            self._later_s = None
            self.replayed = ""
        elif step == _RUN_AGAIN:
            self.runs += 1
        elif step == _REPLAYED:
            self.replayed = str(entry["recording"])
        elif step == _FORGET_BALLS:
            self.balls.clear()
            self.replayed = ""
        elif step == _FORGET_RAISED:
            if not isinstance(entry["places"], list):
                raise ValueError("places are a list")
            for place in entry["places"]:
                self.around.pop(str(place), None)
                self.depth_changes.pop(str(place), None)
        elif step == BALL:
            self._take_run(self._balls(entry))
        elif step == _BALL_AGAIN:
            # Earlier versions wrote the first second of a single run.
            runs = [self._balls(run) for run in entry.get("runs", [entry])]
            self.balls.clear()
            self.replayed = ""
            for run in runs:
                self._later_s = None
                self._take_run(run)
        elif step in (MARK, FRONT):
            setattr(self, step, self._balls(entry))
        elif kind_of(step) in PLACES:
            for other in self.replaced_by(step):
                del self.around[other]
                self.depth_changes.pop(other, None)
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
        if "balls" in entry or "planes" in entry:
            self._take_depths(step, entry.get(_DEPTHS, {}))

    def _take_depths(self, step: str, noted: Mapping[str, Any]) -> None:
        """Take the changes of the depths seen in a step, in place of what it had seen before."""
        changes = {str(name): float(finite_numbers(change, ())) for name, change in noted.items()}
        for name in changes:
            self._check_camera(name)
        if step == EMPTY:
            # Earlier steps were compared with the empty booth before.
            self.depth_changes = {
                earlier: {
                    name: own - changes[name] for name, own in seen.items() if name in changes
                }
                for earlier, seen in self.depth_changes.items()
            }
            return
        # A step that is repeated counts as the latest.
        self.depth_changes.pop(step, None)
        if changes:
            self.depth_changes[step] = changes

    def _take_run(self, seen: Sequence[BallDetection]) -> None:
        later_s = self._moved_by(min(ball.time_s for ball in seen))
        self.balls += [replace(ball, time_s=ball.time_s + later_s) for ball in seen]

    def _balls(self, entry: Mapping[str, Any]) -> list[BallDetection]:
        return self._known([BallDetection.from_json(ball) for ball in entry["balls"]])

    def _known(self, seen: list[Observed]) -> list[Observed]:
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


def _line(entry: Mapping[str, Any]) -> bytes:
    """An entry as a line of the journal."""
    return (json.dumps(entry, allow_nan=False, separators=(",", ":")) + "\n").encode()


def _lens(document: Mapping[str, Any], camera: CameraCalibration) -> Lens:
    """Intrinsics of the journal.

    Raises:
        ValueError: the camera cannot have such a lens.
    """
    K = finite_numbers(document["K"], (3, 3))
    distortion = finite_numbers(document["distortion"], (5,))
    check_intrinsics(K, distortion, camera.width, camera.height)
    return Lens(K.tolist(), distortion.tolist())
