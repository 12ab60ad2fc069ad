"""An attempt at a calibration: its frames, its operator, and where what is seen goes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from station.calibration.detect.detections import BallDetection
from station.calibration.detect.step_names import EMPTY
from station.calibration.guide.feed import Feed, live_feed, replayed_feed
from station.calibration.guide.operator import Guide
from station.calibration.guide.recordings import step_folder
from station.calibration.guide.session import SESSION, Session
from station.calibration.guide.steps import rest_ball
from station.calibration.guide.store import CalibrationStore
from station.core.config import BoothConfig
from station.core.errors import CalibrationError
from station.core.files import utc_now
from station.core.rig import CameraCalibration
from station.messaging.messages import Request
from station.messaging.transport import ask_again
from station.sensors.identity import calibrated_serials

_SENSORS_S = 20.0
_ANOTHER = "run station calibrate, which does all steps anew"


@dataclass(frozen=True, slots=True)
class Attempt:
    """A booth that is being calibrated, live or from recordings."""

    config: BoothConfig
    store: CalibrationStore
    recordings: Path | None
    """DIR/<step>/<camera> in place of the live cameras."""
    guide: Guide

    def unfinished_session(self, *, mend: bool = True) -> Session | None:
        """The calibration that is being done, if one is; ``mend``: as in `Session.load`."""
        folder = self.store.unfinished
        return Session.load(folder, mend=mend) if (folder / SESSION).exists() else None

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
                "another, and a single step (ball, mark, around, stand, depth) adds to it"
            )
        return session

    def session_to_add_to(self) -> Session | None:
        """The calibration that is being done, or else the one in use: a further step adds to it."""
        session = self.unfinished_session()
        if session is None and (used := self.store.resumable()):
            return Session.load(self.store.folder / used)
        return session

    def following(self, solving: str) -> str:
        """Words on what comes after a step by itself; ``solving``: where that is the solution."""
        session = self.unfinished_session()
        # The empty booth begins another calibration where none is being done.
        following = (
            solving
            if session is not None and session.balls and session.mark
            else "station calibrate goes through the steps that are missing"
        )
        return f"kept, and not in use yet: {following}"

    def times_waved_anew(self) -> int:
        """Number of times that the ball was begun to be waved anew, for `kept`."""
        return Session.times_waved_anew(self.store.unfinished)

    def kept(self, waved_anew: int) -> str:
        """Words on what is left of a step that was stopped.

        Args:
            waved_anew: number of times that the ball had been before it.
        """
        session = self.unfinished_session()
        anew = self.times_waved_anew() != waved_anew
        if session is not None and session.replacing and anew:
            return "nothing replaces what was seen of the ball before, which is kept"
        seen = session is not None and session.anything
        return "what was seen is kept" if seen else "nothing was recorded"

    def see_at_rest(self, step: str) -> tuple[Session, list[BallDetection]]:
        """The ball where it was put in a step, and the calibration that it is seen in."""
        with self.feed(step) as (feed, session):
            self.remark_on_ghosts(session)
            return session, rest_ball(feed, session, self.guide, step)

    def tell_of_replay(self) -> None:
        """Say so where what a step asks for was done when it was recorded."""
        if self.recordings is not None:
            self.guide.say(
                "recordings are replayed; there is nothing to do, and the instructions are those "
                "of a live booth"
            )

    def check_station(self) -> None:
        """Refuse before anybody has put something up, rather than after a countdown."""
        if self.guide.attended:
            runtime = self.config.runtime
            ask_again(runtime.folder, "control", Request("status"), runtime.command_timeout_s)

    def remark_on_ghosts(self, session: Session) -> None:
        """Say so where nothing tells the ball from what always stands in the booth."""
        if not session.done(EMPTY):
            self.guide.say(
                "the empty booth has not been recorded: round objects in it may be taken for the "
                "ball (run station calibrate floor)"
            )

    def remark_on_warmth(self, session: Session) -> None:
        """Say so where the solution will be refused for what the steps so far saw of the depths,
        minutes before it is."""
        from station.calibration.solve.warming import check_warm

        try:
            check_warm(session.depth_changes)
        except CalibrationError as error:
            self.guide.say(str(error))

    @contextmanager
    def feed(self, step: str) -> Iterator[tuple[Feed, Session]]:
        """Frames for a step and the calibration that is being done; begun if there is none."""
        with self._source(step) as feed:
            session = self._joined(step, feed.cameras(_SENSORS_S))
            self.remark_on_warmth(session)
            yield feed, session

    def _source(self, step: str) -> AbstractContextManager[Feed]:
        if self.recordings is None:
            return live_feed(self.config)
        return replayed_feed(self.config, step_folder(self.recordings, step))

    def _joined(self, step: str, cameras: Mapping[str, CameraCalibration]) -> Session:
        """The calibration that a step of these cameras goes into."""
        session = self.unfinished_session() if step == EMPTY else self.session_to_add_to()
        if session is None:
            session = Session.begin(
                self.store.unfinished, utc_now(), self.config.calibrate.ball_radius_m, cameras
            )
            if self.store.in_use.exists():
                self.guide.say("a new calibration; until it is solved, the other is in use")
        elif session.folder == self.store.unfinished:
            session.check_cameras(calibrated_serials(cameras))
            session.check_radius(self.config.calibrate.ball_radius_m)
        else:
            # Nothing was begun that could be started again.
            session.check_cameras(calibrated_serials(cameras), _ANOTHER)
            session.check_radius(self.config.calibrate.ball_radius_m, _ANOTHER)
            session = self.store.reopen(session.folder.name)
            self.guide.say(
                f"added to what calibration {session.adds_to} was solved from; if a camera was "
                "moved since, begin anew: station calibrate --new"
            )
        return session
