"""A calibration guided from the page: `station calibrate` in a process of its own, which writes its
messages as JSON lines and reads the operator's answers as lines."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from station.calibration.detect.step_names import FRONT, MARK
from station.calibration.guide.operator import Guide
from station.calibration.guide.procedure import Procedure
from station.calibration.guide.raised_ball import see_all_heights
from station.calibration.guide.store import CalibrationStore
from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.errors import BoothError, CalibrationError

_PROGRESS_S = 0.2


@dataclass(slots=True)
class PageGuide(Guide):
    """A guide that uses the page as its terminal."""

    _last_s: float = 0.0

    def _say(self, kind: str, **content: Any) -> None:
        print(json.dumps({"kind": kind, **content}, ensure_ascii=False), flush=True)

    def _answer(self) -> str:
        line = sys.stdin.readline()
        if not line:
            raise KeyboardInterrupt
        return line.strip()

    def step(self, title: str, instruction: str = "", *, lays: bool = False) -> None:
        self._say("step", title=title, text=instruction, waits=self.attended)
        if not self.attended:
            return
        self._answer()
        self.count_down(lays=lays)

    def _tick(self, left: int) -> None:
        self._say("countdown", left_s=left)

    def title(self, text: str) -> None:
        self._say("step", title=text, text="", waits=False)

    def progress(self, text: str, *, now: bool = False) -> None:
        moment = time.monotonic()
        if now or moment - self._last_s > _PROGRESS_S:
            self._last_s = moment
            self._say("progress", text=text)

    def say(self, text: str) -> None:
        self._say("line", text=text)

    def done(self, text: str) -> None:
        self._say("done", text=text)

    def answers_yes(self, question: str, *, usual: bool = True) -> bool:
        del usual  # The page has two buttons.
        if not self.attended:
            return False
        self._say("question", text=question)
        return self._answer() == "yes"

    def height_m(self, question: str) -> float | None:
        if not self.attended:
            return None
        self._say("height", text=question)
        answer = self._answer()
        return None if answer == "no" else float(answer)

    def end_line(self) -> None:
        """Do nothing: the page has no line that is overwritten."""


def run(config_path: Path, step: str, new: bool) -> None:
    """Run one step, or all remaining steps.

    Raises:
        BoothError: as `station calibrate` does; or the operator stopped it.
    """
    config = load_config(config_path)
    recordings = config.console.recordings
    store = CalibrationStore.of(config)
    guide = PageGuide(recordings is None, config.calibrate.countdown_s)
    procedure = Procedure(config, store, recordings, guide)
    alone = step not in ("all", "solve")
    waved_anew = procedure.times_waved_anew()
    try:
        with store.locked():
            if new:
                store.abandon()
            if alone:
                procedure.tell_of_replay()
            _do(procedure, step)
    except KeyboardInterrupt:
        raise CalibrationError(f"stopped; {procedure.kept(waved_anew)}") from None
    if alone:
        guide.say(procedure.following("the solution puts it into use"))


def unfinished(config: BoothConfig) -> tuple[str, list[str]]:
    """Start of the calibration that is being done, and its steps that are done; empty if none
    is. It may be going on.

    Raises:
        FormatError: what it saw cannot be read.
    """
    store = CalibrationStore.of(config)
    procedure = Procedure(config, store, config.console.recordings, PageGuide(False, 0.0))
    session = procedure.unfinished_session(mend=False)
    return ("", []) if session is None else (session.started, procedure.finished(session))


def _do(procedure: Procedure, step: str) -> None:
    match step:
        case "all":
            procedure.run()
        case "floor":
            procedure.empty()
        case "ball":
            procedure.ball()
        case "mark" | "front":
            procedure.rest(MARK if step == "mark" else FRONT)
        case "around":
            procedure.around(asked=False)
        case "stand":
            see_all_heights(procedure, again=True)
        case "depth":
            procedure.walls(asked=False)
        case "solve":
            procedure.solve()


def main() -> int:
    """`python -m station.console.live.guided CONFIG STEP [new]`; the console starts it."""
    path, step, *rest = sys.argv[1:]
    try:
        run(Path(path), step, "new" in rest)
    except BoothError as error:
        print(json.dumps({"kind": "error", "text": str(error)}), flush=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
