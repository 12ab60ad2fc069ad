"""The steps of a calibration in their order, up to the solution in use."""

from __future__ import annotations

from dataclasses import dataclass

from station.calibration.detect.step_names import (
    AROUND,
    BALL,
    EMPTY,
    FRONT,
    MARK,
    PLACES,
    WALL,
    numbered_step,
)
from station.calibration.guide.attempt import Attempt
from station.calibration.guide.raised_ball import see_all_heights
from station.calibration.guide.recordings import fingerprint, step_folder
from station.calibration.guide.session import Session
from station.calibration.guide.steps import (
    EMPTY_FIRST,
    coverage_so_far,
    look_at_empty_booth,
    look_at_wall,
    wave_ball,
)
from station.core.errors import CalibrationError
from station.core.files import local_time, utc_now
from station.sensors.identity import configured_serials

_STEPS = (EMPTY, BALL, MARK, FRONT, WALL, *PLACES)
_MAX_BOARDS, _MAX_PLACES = 20, 20
_SURE_OF_RADIUS = 60
"""Sightings from which on a ball of another radius is told."""
_BOARDS = 3
"""Places of the board that a calibration asks for; a fourth buys next to nothing."""
_AROUND = ("to the left of the mark", "to the right of the mark", "behind the mark")
"""Places of the ball: three that are not on one line show the floor's slope both ways."""


@dataclass(frozen=True, slots=True)
class Procedure(Attempt):
    """A booth's calibration: each step by itself, or all that are not done yet."""

    def run(self) -> None:
        """All steps that are not done yet."""
        self._check_recordings()
        self.tell_of_replay()
        session = self.unfinished_session()
        if session is not None and session.adds_to:
            raise CalibrationError(
                f"steps were added to calibration {session.adds_to}: station calibrate solve puts "
                "them into use, station calibrate --new begins another"
            )
        if session is not None:
            session.check_cameras(configured_serials(self.config.cameras))
            self.guide.say(
                f"continuing the calibration that was started at {local_time(session.started)}; if "
                "a camera was moved since, begin anew: station calibrate --new"
            )
            self.guide.say(f"already recorded: {session.summary()}")
            self.guide.say("to repeat a step, run its own command")
        done = self.finished(session)
        if "floor" not in done:
            self.empty()
        if "ball" not in done:
            self.ball()
        elif session is not None:
            self._say_what_would_help(session)
        if "mark" not in done:
            self.rest(MARK)
        recorded_front = self.recordings is not None and (self.recordings / FRONT).is_dir()
        if recorded_front and (session is None or not session.done(FRONT)):
            self.rest(FRONT)
        if "around" not in done:
            self.around(asked=True)
        see_all_heights(self)
        if "depth" not in done:
            self.walls(asked=True)
        self.solve()

    def finished(self, session: Session | None) -> list[str]:
        """Commands of the steps that are done, in a calibration that is being done."""
        if session is None:
            return []
        done = {
            "floor": session.done(EMPTY),
            "ball": self._waved(session),
            "mark": session.done(MARK),
            "around": session.around_count >= len(_AROUND),
            "stand": session.raised_enough,
            "depth": session.wall_count >= _BOARDS,
        }
        return [step for step, is_done in done.items() if is_done]

    def _waved(self, session: Session) -> bool:
        """Whether the ball was waved enough, or as long as is asked for or recorded: then a camera
        may lack something that more of it would not show."""
        if coverage_so_far(session, self.config.reference).enough:
            return True
        if self.recordings is None:
            return session.waved_s >= self.config.calibrate.waving_s
        folder = self.recordings / BALL
        return folder.is_dir() and session.replayed == fingerprint(folder)

    def _say_what_would_help(self, session: Session) -> None:
        coverage = coverage_so_far(session, self.config.reference)
        if not coverage.enough:
            self.guide.say(
                f"the ball was waved for {session.waved_s} s; more of it would help (station "
                f"calibrate ball): {coverage.advice()}"
            )

    def _check_recordings(self) -> None:
        """Recorded steps are of all cameras: one that is missing is not found out minutes later."""
        if self.recordings is None or not self.recordings.is_dir():
            return
        for step in sorted(path for path in self.recordings.iterdir() if path.is_dir()):
            if not step.name.startswith(_STEPS):
                continue
            missing = [
                camera.name for camera in self.config.cameras if not (step / camera.name).is_dir()
            ]
            if missing:
                raise CalibrationError(
                    f"{step} holds no recording of camera {missing[0]}: record that step again, or "
                    "take its folder away"
                    if len(missing) == 1
                    else f"{step} holds no recording of cameras {', '.join(missing)}: record that "
                    "step again, or take its folder away"
                )

    def empty(self) -> None:
        """The empty booth and its floor."""
        self.check_station()
        self.guide.step("Empty booth", "Leave the booth empty; nobody in sight of the cameras.")
        with self.feed(EMPTY) as (feed, session):
            look_at_empty_booth(feed, session, self.guide)

    def ball(self, *, again: bool = False) -> None:
        """The ball, waved; ``again``: instead of what was seen of it before."""
        self.check_station()
        wanted = self.config.calibrate
        self.guide.step(
            "Ball",
            f"Wave the ball ({2e2 * wanted.ball_radius_m:g} cm wide) slowly through the whole "
            f"booth for {wanted.waving_s:g} s: low and high, left and right, around the mark.",
        )
        with self.feed(BALL) as (feed, session):
            self.remark_on_ghosts(session)
            wave_ball(
                feed,
                session,
                self.guide,
                reference=self.config.reference,
                lasts_s=wanted.waving_s,
                # A recording begins anew: what it shows twice was seen once.
                again=bool(session.balls) and (again or self.recordings is not None),
            )
            if self.recordings is not None:
                session.end_replay(fingerprint(step_folder(self.recordings, BALL)))
        if len(session.balls) > _SURE_OF_RADIUS:
            from station.calibration.solve.refusals import check_radius

            check_radius(session.balls, session.radius_m)

    def rest(self, step: str) -> None:
        """The ball on the mark, or in front of it."""
        where = "on the mark" if step == MARK else "on the floor in front of the mark, 0.5 m away"
        self._lay(step, f"Ball {where}", "Lay it down and step back.")

    def around(self, asked: bool) -> None:
        """The ball on the floor beside and behind the mark; more places where they are wanted."""
        session = self.session_to_add_to()
        before = session.around_count if session and self.recordings is None else 0
        for place in range(before, before + _MAX_PLACES):
            step = numbered_step(AROUND, place)
            if self.recordings is not None:
                if (asked or place > before) and not (self.recordings / step).is_dir():
                    return
            elif place >= len(_AROUND) and (
                asked or (place > before and not self.guide.answers_yes("Lay it at another place?"))
            ):
                return
            where = _AROUND[place] if place < len(_AROUND) else "anywhere else around the mark"
            instruction = "0.6 m away, where a lower camera sees it." if place == before else ""
            self._lay(step, f"Ball on the floor {where}", instruction)

    def walls(self, asked: bool) -> None:
        """The flat board at some places: as many as are asked for, as the operator likes, or as are
        recorded."""
        # Live, a further board is added to those that were seen; recordings have their own places.
        session = self.session_to_add_to()
        if session is None or not session.done(EMPTY):
            raise CalibrationError(self._empty_first())
        self.check_station()
        live = self.recordings is None
        before = session.wall_count if live else 0
        for place in range(before, _BOARDS if live and asked else before + _MAX_BOARDS):
            if self.recordings is not None:
                recorded = (self.recordings / numbered_step(WALL, place)).is_dir()
                if (asked or place > before) and not recorded:
                    return
                if place == before:
                    self.guide.title("Flat board")
            elif not self._board_stands(place, first=place == before, asked=asked):
                return
            with self.feed(numbered_step(WALL, place)) as (feed, session):
                look_at_wall(feed, session, self.guide, place)

    def _empty_first(self) -> str:
        """Words on a board without the empty booth, which would begin another calibration where
        none is being done."""
        if self.unfinished_session() is not None:
            return EMPTY_FIRST
        return (
            "there is no empty booth that a board could be added to; station calibrate goes "
            "through all steps"
        )

    def _board_stands(self, place: int, *, first: bool, asked: bool) -> bool:
        """Wait until the operator has put up the board; false if it is not wanted there."""
        if first and not asked:
            self.guide.step(
                "Flat board", "Stand a flat board (1 m or wider) upright across the booth."
            )
            return True
        if first and self.guide.attended:
            self.guide.title("Flat board")
        if first:
            question = (
                "Stand a flat board (1 m or wider) upright across the booth, for more accurate "
                "depths. Is it there?"
            )
        elif place < _BOARDS:
            question = f"Place {place + 1} of {_BOARDS}, nearer or farther. Is it there?"
        else:
            question = "Another place, nearer or farther. Is it there?"
        if not self.guide.answers_yes(question):
            return False
        self.guide.count_down()
        return True

    def solve(self) -> None:
        """The solution from what was seen, put into use."""
        from station.calibration.solve.refusals import Limits
        from station.calibration.solve.solving import solve

        session = self.session()
        session.check_cameras(configured_serials(self.config.cameras))
        session.check_radius(self.config.calibrate.ball_radius_m)
        self.guide.title("Solution")
        solution = solve(
            session.observations(),
            session.lensed_cameras(),
            radius_m=session.radius_m,
            reference=self.config.reference,
            front_cameras=self.config.front_cameras,
            created=utc_now(),
            progress=self.guide.progress,
            limits=Limits(
                self.config.calibrate.height_limit_m, self.config.calibrate.girth_limit_m
            ),
        )
        for line in solution.summary():
            self.guide.say(line)
        entry = self.store.finish(solution.rig, solution.report)
        self.store.use(entry.name)
        self.guide.done(f"calibration {entry.name} is in use ({entry.folder})")

    def _lay(self, step: str, title: str, instruction: str) -> None:
        self.check_station()
        self.guide.step(title, instruction, lays=True)
        session, balls = self.see_at_rest(step)
        session.record_resting(step, balls)
