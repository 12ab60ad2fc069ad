"""The steps of a calibration in their order, up to the solution in use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from station.calibration.detect.detections import BallDetection
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
    RAISED_M,
    STAND,
    WALL,
    numbered_step,
    raised_height_m,
    raised_step,
)
from station.calibration.guide.feed import Feed, live_feed, replayed_feed
from station.calibration.guide.heights import (
    HOOK,
    measured_height,
    out_of_sight,
    recorded_heights,
    wrong_height,
)
from station.calibration.guide.operator import Guide
from station.calibration.guide.seen import listed
from station.calibration.guide.session import SESSION, Session
from station.calibration.guide.steps import (
    EMPTY_FIRST,
    coverage_so_far,
    look_at_empty_booth,
    look_at_wall,
    rest_ball,
    wave_ball,
)
from station.calibration.guide.store import CalibrationStore
from station.core.config import BoothConfig
from station.core.errors import CalibrationError
from station.messaging.messages import Request
from station.messaging.transport import ask_again

_STEPS = (EMPTY, BALL, MARK, FRONT, WALL, *PLACES)
_SENSORS_S = 20.0
_MAX_BOARDS, _MAX_PLACES = 20, 20
_SURE_OF_RADIUS = 60
"""Sightings from which on a ball of another radius is told."""
_BOARDS = 3
"""Places of the board that a calibration asks for; a fourth buys next to nothing."""
_AROUND = ("to the left of the mark", "to the right of the mark", "behind the mark")
"""Places of the ball: three that are not on one line show the floor's slope both ways."""


@dataclass(frozen=True, slots=True)
class Procedure:
    """A booth's calibration: each step by itself, or all that are not done yet."""

    config: BoothConfig
    store: CalibrationStore
    recordings: Path | None
    """DIR/<step>/<camera> in place of the live cameras."""
    guide: Guide

    def unfinished_session(self) -> Session | None:
        """The calibration that is being done, if one is."""
        folder = self.store.unfinished
        return Session.load(folder) if (folder / SESSION).exists() else None

    def session(self) -> Session:
        """The calibration that is being done.

        Raises:
            CalibrationError: there is none.
        """
        session = self.unfinished_session()
        if session is None:
            last = self.store.newest()
            raise CalibrationError(
                "no calibration has been started; station calibrate goes through all steps"
                if last is None
                else f"the last calibration, {last}, is finished; station calibrate begins "
                "another, and a single step (ball, around, stand, depth) adds to it"
            )
        return session

    def _session_to_add_to(self) -> Session | None:
        """The calibration that is being done, or else the one in use: a further step adds to it."""
        session = self.unfinished_session()
        if session is None and (used := self.store.resumable()):
            return Session.load(self.store.folder / used)
        return session

    def run(self) -> None:
        """All steps that are not done yet."""
        self._check_recordings()
        session = self.unfinished_session()
        if session is not None and session.adds_to:
            raise CalibrationError(
                f"steps were added to calibration {session.adds_to}: station calibrate solve puts "
                "them into use, station calibrate --new begins another"
            )
        if session is not None:
            self.guide.say(
                f"continuing the calibration that was started at {session.started}; if a camera "
                "was moved since, begin anew: station calibrate --new"
            )
            self.guide.say(
                f"  already recorded: {session.summary()}; to repeat a step, run its own command"
            )
        if session is None or not session.done(EMPTY):
            self.empty()
        if session is None or not self._waved(session):
            self.ball()
        if session is None or not session.done(MARK):
            self.rest(MARK)
        recorded_front = self.recordings is not None and (self.recordings / FRONT).is_dir()
        if recorded_front and (session is None or not session.done(FRONT)):
            self.rest(FRONT)
        if session is None or session.around_count < len(_AROUND):
            self.around(asked=True)
        self.raised()
        if session is None or session.wall_count < _BOARDS:
            self.walls(asked=True)
        self.solve()

    def _waved(self, session: Session) -> bool:
        """Whether the ball was waved enough, or as long as is asked for: then a camera may lack
        something that more of it would not show."""
        coverage = coverage_so_far(session, self.config.reference)
        replayed = self.recordings is not None
        if coverage.enough or replayed or session.waved_s < self.config.calibrate.waving_s:
            return coverage.enough
        self.guide.say(
            f"the ball was waved for {session.waved_s} s; more of it would help (station "
            f"calibrate ball): {coverage.advice()}"
        )
        return True

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
                    f"{step} holds no recording of camera {', '.join(missing)}: record that step "
                    "again, or take its folder away"
                )

    def empty(self) -> None:
        """The empty booth and its floor."""
        self._check_station()
        self.guide.step("Empty booth", "Leave the booth empty; nobody in sight of the cameras.")
        with self._feed(EMPTY) as (feed, session):
            look_at_empty_booth(feed, session, self.guide)

    def ball(self, *, again: bool = False) -> None:
        """The ball, waved; ``again``: instead of what was seen of it before."""
        self._check_station()
        wanted = self.config.calibrate
        self.guide.step(
            "Ball",
            f"Wave the ball ({2e2 * wanted.ball_radius_m:g} cm wide) slowly through the whole "
            f"booth for {wanted.waving_s:g} s: low and high, left and right, around the mark.",
        )
        with self._feed(BALL) as (feed, session):
            self._remark_on_ghosts(session)
            # A recording begins anew: what it shows twice was seen once.
            if session.balls and (again or self.recordings is not None):
                session.forget_balls()
            reference, lasts_s = self.config.reference, wanted.waving_s
            wave_ball(feed, session, self.guide, reference=reference, lasts_s=lasts_s)
        if len(session.balls) > _SURE_OF_RADIUS:
            from station.calibration.solve.refusals import check_radius

            check_radius(session.balls, session.radius_m)

    def rest(self, step: str) -> None:
        """The ball on the mark, or in front of it."""
        where = "on the mark" if step == MARK else "on the floor in front of the mark, 0.5 m away"
        self._lay(step, f"Ball {where}", "Lay it down and step back.")

    def around(self, asked: bool) -> None:
        """The ball on the floor beside and behind the mark; more places where they are wanted."""
        session = self._session_to_add_to()
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

    def raised(self, *, again: bool = False, kind: str | None = None) -> None:
        """The ball at two measured heights that the operator gives; at all that are recorded.

        ``again``: instead of those at which it was seen before; ``kind``: STAND or HANGING, or None
        to ask.
        """
        if self.recordings is not None:
            self._raised_in(self.recordings, again)
            return
        session = self._session_to_add_to()
        seen = {
            kind: list(session.raised_as(kind).values()) if session and not again else []
            for kind in RAISED
        }
        complete = any(len(own) >= len(HEIGHTS_M[kind]) for kind, own in seen.items())
        if complete or not self.guide.attended:
            return
        self._check_station()
        self.guide.title("Ball at two heights")
        begun = next((kind for kind, own in seen.items() if len(own) == 1), None)
        kind = begun or kind
        if kind is None:
            kind = HANGING if self.guide.answers_yes(HOOK, usual=False) else STAND
        others_m = seen[kind] if begun else []
        best_m = list(HEIGHTS_M[kind])
        if begun:
            best_m = [max(best_m, key=lambda height_m: abs(height_m - others_m[0]))]
        while best_m:
            height_m = measured_height(self.guide, kind, best_m[0], others_m)
            if height_m is None:
                return
            self.guide.count_down()
            if words := self._see_raised(height_m, kind, again=again and not others_m):
                self.guide.say(words)
                continue
            others_m.append(height_m)
            best_m.pop(0)

    def _raised_in(self, recordings: Path, again: bool) -> None:
        recorded = recorded_heights(recordings)
        if again and not recorded:
            raise CalibrationError(
                f"{recordings} holds no recording of the ball on a stand or hanging (a folder such "
                f"as {STAND}-1700 or {HANGING}-1800)"
            )
        for kind, height_m in recorded:
            self.raise_ball(height_m, kind, again=again)
            again = False

    def raise_ball(self, height_m: float, kind: str, *, again: bool = False) -> None:
        """The ball on a stand or hanging (STAND, HANGING), its underside at a measured height above
        the floor.

        ``again``: instead of all heights before.

        Raises:
            CalibrationError: it is not seen there.
        """
        if not RAISED_M[0] <= height_m <= RAISED_M[1]:
            raise CalibrationError(out_of_sight(height_m))
        self._check_station()
        if kind == HANGING:
            where = f"hanging above the mark, its underside {height_m:g} m above the floor"
            instruction = "Wait until it hangs still, and step back."
        else:
            where = f"on a stand on the mark, its underside {height_m:g} m above the floor"
            instruction = "Put it up and step back."
        self.guide.step(f"Ball {where}", instruction, lays=True)
        if words := self._see_raised(height_m, kind, again=again):
            raise CalibrationError(words)
        if kind == HANGING and self.recordings is None:
            self._ask_for_the_other()

    def _see_raised(self, height_m: float, kind: str, *, again: bool) -> str | None:
        """Keep the ball at a height; words on one that is wrong, which is not kept."""
        step = raised_step(kind, height_m)
        session, balls = self._see_at_rest(step)
        if words := wrong_height(session, step, balls, self.config.reference):
            return words
        before = {place: raised_height_m(place) or 0.0 for place in session.raised}
        session.record_resting(step, balls)
        if again and (others := [place for place in session.raised if place != step]):
            session.forget_raised(others)
        if gone_m := sorted(before[place] for place in before.keys() - set(session.raised)):
            self.guide.say(f"this replaces the ball that was seen at {listed(gone_m)} m")
        return None

    def _ask_for_the_other(self) -> None:
        """Name the height that is missing, if the ball hung at one only."""
        session = self._session_to_add_to()
        own_m = list(session.raised_as(HANGING).values()) if session else []
        if len(own_m) == 1:
            upper_m, lower_m = HEIGHTS_M[HANGING]
            other_m = lower_m if own_m[0] > 0.5 * (upper_m + lower_m) else upper_m
            self.guide.say(
                f"now about {other_m:g} m above the floor, from the same hook, and still: two "
                "heights show what is vertical"
            )

    def walls(self, asked: bool) -> None:
        """The flat board at some places: as many as are asked for, as the operator likes, or as are
        recorded."""
        # Live, a further board is added to those that were seen; recordings have their own places.
        session = self._session_to_add_to()
        if session is None or not session.done(EMPTY):
            raise CalibrationError(EMPTY_FIRST)
        self._check_station()
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
            with self._feed(numbered_step(WALL, place)) as (feed, session):
                look_at_wall(feed, session, self.guide, place)

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
        from station.calibration.solve.solution import solve

        session = self.session()
        session.check_radius(self.config.calibrate.ball_radius_m)
        self.guide.title("Solution")
        solution = solve(
            session.observations(),
            session.lensed_cameras(),
            radius_m=session.radius_m,
            reference=self.config.reference,
            front_cameras=self.config.front_cameras,
            created=_now(),
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
        self._check_station()
        self.guide.step(title, instruction, lays=True)
        session, balls = self._see_at_rest(step)
        session.record_resting(step, balls)

    def _see_at_rest(self, step: str) -> tuple[Session, list[BallDetection]]:
        with self._feed(step) as (feed, session):
            self._remark_on_ghosts(session)
            return session, rest_ball(feed, session, self.guide, step)

    def _check_station(self) -> None:
        """Refuse before anybody has put something up, rather than after a countdown."""
        if self.guide.attended:
            runtime = self.config.runtime
            ask_again(runtime.folder, "control", Request("status"), runtime.command_timeout_s)

    def _remark_on_ghosts(self, session: Session) -> None:
        if not session.done(EMPTY):
            self.guide.say(
                "the empty booth has not been recorded: round objects in it may be taken for the "
                "ball (run station calibrate floor)"
            )

    @contextmanager
    def _feed(self, step: str) -> Iterator[tuple[Feed, Session]]:
        """Frames for a step and the calibration that is being done; begun if there is none."""
        if self.recordings is None:
            source = live_feed(self.config)
        elif (self.recordings / step).is_dir():
            source = replayed_feed(self.config, self.recordings / step)
        else:
            inside = sorted(self.recordings.iterdir())
            known = ", ".join(path.name for path in inside) or "nothing"
            deeper = [path for path in inside if (path / step).is_dir()]
            hint = f" ({deeper[0]} does)" if deeper else ""
            raise CalibrationError(
                f"{self.recordings} holds no recording of the step {step}; it holds {known}{hint}"
            )
        with source as feed:
            cameras = feed.cameras(_SENSORS_S)
            session = self.unfinished_session() if step == EMPTY else self._session_to_add_to()
            if session is None:
                session = Session.begin(
                    self.store.unfinished, _now(), self.config.calibrate.ball_radius_m, cameras
                )
                if self.store.in_use.exists():
                    self.guide.say("a new calibration; until it is solved, the other is in use")
            else:
                session.check_cameras(cameras)
                session.check_radius(self.config.calibrate.ball_radius_m)
            if session.folder != self.store.unfinished:
                session = self.store.reopen(session.folder.name)
                self.guide.say(
                    f"added to what calibration {session.adds_to} was solved from; if a camera was "
                    "moved since, begin anew: station calibrate --new"
                )
            yield feed, session


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
