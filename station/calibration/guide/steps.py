"""The steps of a calibration: what is looked at in each, and when it is enough."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from station.calibration.detect.coverage import Coverage
from station.calibration.detect.detections import BallDetection, PlaneObservation
from station.calibration.detect.planes import observe_floor, observe_wall
from station.calibration.detect.scene import StaticView, mean_view, static_view
from station.calibration.detect.step_names import EMPTY, HANGING, WALL, numbered_step
from station.calibration.detect.stillness import check_board_stands, check_stillness
from station.calibration.detect.swing import GAP_S, LOOK_S, since_last_gap, whole_swings
from station.calibration.detect.warmth import depth_change
from station.calibration.guide.feed import Feed, TimedFrame, gather_frames
from station.calibration.guide.finder import BallFinder
from station.calibration.guide.operator import Guide
from station.calibration.guide.seen import Seen
from station.calibration.guide.session import Session
from station.calibration.moves.look import certainly_moved
from station.calibration.moves.motion import move_words
from station.core.errors import CalibrationError

EMPTY_FIRST = "the empty booth has to be recorded first: station calibrate floor"
_EMPTY_FRAMES = 60
_WALL_FRAMES = 30
_RESTING_S = 60.0
_RESTING_DETECTIONS = 12
_HANGING_DETECTIONS = 24
"""Fewest detections of a hanging ball: a camera that loses it in some frames still sees where it
hangs."""
_SHORTEST_S = 2.5
"""Least time for which a recording shows the hanging ball: most of a swing."""
_RESTING_M = 0.006
"""A ball that lies still is seen in one place within the noise of a single view."""
_OTHERS_S = 3.0
"""After the first camera others have so long to see it at rest, too."""
_LEAST_WAVED = 0.25
"""Share of the whole time for which the ball is waved once more."""
_LEAST_SHARE = 0.5
"""Sightings of a ball waved anew, as a share of those before, that may replace them."""
_WRITE_EVERY_S = 1.0
_LOOK_EVERY_S = 0.2
_MANY_WAIT = 60
"""Frames, of all cameras, after which what is said of the coverage lags by more than a second."""
_DEPTH_FRAMES = 12
"""Last frames of a step of the ball at rest, in which the depths of the booth are compared with
those of the empty one."""


def look_at_empty_booth(feed: Feed, session: Session, guide: Guide) -> None:
    """Keep what the cameras see of the booth without anybody in it, and its floor.

    Raises:
        CalibrationError: something moved.
    """
    taken = _frames(feed, session, guide, _EMPTY_FRAMES)
    for name, (stack, scale_m) in taken.items():
        check_stillness(name, stack, scale_m)
    cameras = session.lensed_cameras()
    floors = [
        floor
        for name, (stack, scale_m) in taken.items()
        if (floor := observe_floor(stack, scale_m, cameras[name])) is not None
    ]
    views = {name: static_view(stack, scale_m) for name, (stack, scale_m) in taken.items()}
    session.note_depths(EMPTY, _depth_changes(_empty_booth(session), taken))
    session.record_empty(views, floors)
    seen = ", ".join(floor.camera for floor in floors)
    guide.done(
        f"empty booth kept; the floor is seen by {seen}"
        if floors
        else "empty booth kept; no camera sees the floor well, so its position will be found from "
        "the ball"
    )


def look_at_wall(feed: Feed, session: Session, guide: Guide, place: int) -> None:
    """Keep a flat board (or wall) at one place, as every camera that faces it sees it.

    Whoever put it there may stand beside it, and nobody stands as still as a board.

    Raises:
        CalibrationError: no camera sees a flat surface that was not there before, or it moved.
    """
    taken = _frames(feed, session, guide, _WALL_FRAMES)
    cameras, name = session.lensed_cameras(), numbered_step(WALL, place)
    empty = _empty_booth(session)
    walls: list[PlaneObservation] = []
    for camera, (stack, scale_m) in taken.items():
        if camera not in empty:
            raise CalibrationError(EMPTY_FIRST)
        wall = observe_wall(stack, scale_m, cameras[camera], name, empty[camera].depth_m())
        if wall is not None:
            check_board_stands(wall, stack, scale_m)
            walls.append(wall)
    if not walls:
        raise CalibrationError(
            "no camera sees a flat board that stands still: put it upright, facing the cameras, "
            "1 m or more wide, and stand beside it, not before it"
        )
    session.note_depths(name, _depth_changes(empty, taken))
    session.record_wall(name, walls)
    guide.done(f"place {place + 1}: seen by {', '.join(wall.camera for wall in walls)}")


def _frames(
    feed: Feed, session: Session, guide: Guide, frames: int
) -> dict[str, tuple[NDArray[np.uint16], float]]:
    """Each camera's frames (n, h, w), and their scale."""
    taken = gather_frames(feed, session.cameras, frames, guide.progress)
    return {
        name: (np.stack([frame.pixels() for frame in seen]), seen[0].scale_m)
        for name, seen in taken.items()
    }


def rest_ball(feed: Feed, session: Session, guide: Guide, step: str) -> list[BallDetection]:
    """Wait until the ball lies still where it was put: its detections there.

    Raises:
        CalibrationError: it was not seen at rest.
    """
    hangs = step.startswith(HANGING)
    recent: dict[str, list[BallDetection]] = {name: [] for name in session.cameras}
    last = {name: deque[TimedFrame](maxlen=_DEPTH_FRAMES) for name in session.cameras}
    still: dict[str, list[BallDetection]] = {}
    now_s = time.monotonic()
    give_up_s, settled_s = now_s + _RESTING_S, np.inf
    with BallFinder(session, every_frame=feed.replays, held=False) as finder:
        while now_s < min(give_up_s, settled_s) and not feed.over:
            newest = feed.newest()
            for frame in newest:
                last[frame.camera].append(frame)
            finder.submit(newest)
            for ball in finder.found():
                recent[ball.camera].append(ball)
            still = _at_rest(recent, LOOK_S if hangs else None)
            guide.progress(_rest_line(still))
            now_s = time.monotonic()
            if still:
                settled_s = min(settled_s, now_s + _OTHERS_S)
        for ball in finder.found(wait=True):
            recent[ball.camera].append(ball)
    least_s = _SHORTEST_S if feed.replays else LOOK_S
    still = _at_rest(recent, least_s if hangs else None)
    if not still:
        seen_s = f" for {least_s:g} s" if hangs else ""
        raise CalibrationError(
            f"no camera sees the ball at rest{seen_s}: put it where a camera sees it (one on the "
            "floor is seen by lower cameras), take your hands away, wait until it hangs still if "
            f"it hangs, and check that its radius is {session.radius_m:g} m "
            "(calibrate.ball_radius_m)"
            + ("; a recording of it has to last 3 s or longer" if feed.replays else "")
        )
    looked = {
        name: ([frame.pixels() for frame in frames], frames[0].scale_m)
        for name, frames in last.items()
        if frames
    }
    empty = _empty_booth(session)
    for move in certainly_moved(session.lensed_cameras(), empty, looked):
        raise CalibrationError(
            f"camera {move.camera} has moved since the empty booth was recorded: "
            f"{move_words(move.known())}; fasten it; start again with station calibrate --new"
        )
    session.note_depths(step, _depth_changes(empty, looked))
    guide.done(f"the ball at rest is seen by {', '.join(still)}")
    return [ball for kept in still.values() for ball in kept]


def _rest_line(still: Iterable[str]) -> str:
    names = ", ".join(still)
    return f"the ball: {names}" if names else "the ball: not seen at rest yet"


def _at_rest(
    recent: dict[str, list[BallDetection]], hangs_s: float | None
) -> dict[str, list[BallDetection]]:
    """The detections to keep of each camera that sees the ball at rest; ``hangs_s``: it hangs, and
    has to be seen for so long."""
    kept = {name: _last(seen, hangs_s) for name, seen in recent.items()}
    return {name: seen for name, seen in kept.items() if seen and _is_still(seen)}


def _last(seen: list[BallDetection], hangs_s: float | None) -> list[BallDetection]:
    """The last detections of one camera: enough of them, or none."""
    if hangs_s is None:
        return seen[-_RESTING_DETECTIONS:] if len(seen) >= _RESTING_DETECTIONS else []
    last = since_last_gap([ball for ball in seen if ball.time_s >= seen[-1].time_s - LOOK_S])
    if len(last) < _HANGING_DETECTIONS or last[-1].time_s - last[0].time_s < hangs_s - GAP_S:
        return []
    # What still swings a little is averaged over whole swings.
    return whole_swings(last)


def _is_still(seen: list[BallDetection]) -> bool:
    centers = np.array([ball.center_m for ball in seen])
    away = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return bool(np.median(away) < _RESTING_M)


def coverage_so_far(seen: Seen, reference: str) -> Coverage:
    """Coverage of the booth by the waved ball so far."""
    coverage = Coverage(seen.lensed_cameras(), reference, seen.radius_m)
    for ball in seen.balls:
        coverage.add(ball)
    return coverage


def wave_ball(
    feed: Feed,
    session: Session,
    guide: Guide,
    *,
    reference: str,
    lasts_s: float,
    again: bool = False,
) -> None:
    """Keep the ball on its way through the booth, until the time is over and it is enough.

    What was seen is on disk within a second, whatever ends the step, and seconds in which the ball
    was seen before count. ``again``: it replaces all that was seen before, once it is complete.
    """
    if again:
        coverage = Coverage(session.lensed_cameras(), reference, session.radius_m)
    else:
        coverage = coverage_so_far(session, reference)
        lasts_s = max(lasts_s - session.waved_s, _LEAST_WAVED * lasts_s)
    session.begin_run(again=again)
    resets: dict[str, int] = {}
    waved = _Waved(session, coverage, again)
    began_s = written_s = time.monotonic()
    with BallFinder(session, every_frame=feed.replays, held=True) as finder:
        try:
            while not feed.over:
                for frame in feed.newest():
                    if resets.setdefault(frame.camera, frame.clock_resets) != frame.clock_resets:
                        # What follows cannot be put in time with what went before, of which some
                        # is still being looked at.
                        waved.keep(finder.found(wait=True))
                        waved.begin_run()
                        resets[frame.camera] = frame.clock_resets
                    finder.submit([frame])
                waved.keep(finder.found())
                now_s = time.monotonic()
                if now_s - written_s > _WRITE_EVERY_S:
                    waved.write()
                    written_s = now_s
                left_s = lasts_s - (now_s - began_s)
                guide.progress(_wave_line(coverage, left_s, finder.waiting))
                if not feed.replays and left_s < (0.0 if coverage.enough else -lasts_s):
                    break
            while finder.waiting:
                waved.keep(finder.found())
                waved.write()
                if finder.waiting:
                    guide.progress(f"looking for the ball in {finder.waiting} more frames")
                time.sleep(_LOOK_EVERY_S)
        finally:
            waved.write()
    _tell_waved(coverage, guide, replaced=waved.replace_earlier() or not again)


@dataclass(slots=True)
class _Waved:
    """Detections of the ball on its way: all of them count, and some are not on disk yet."""

    session: Session
    coverage: Coverage
    again: bool
    """They replace earlier ones, which a step that is stopped must not cost: none is written
    before all are there."""
    runs: list[list[BallDetection]] = field(default_factory=lambda: [[]])
    """Detections that are not on disk yet; the last run goes on."""

    def keep(self, balls: list[BallDetection]) -> None:
        for ball in balls:
            self.coverage.add(ball)
        self.runs[-1].extend(balls)

    def write(self) -> None:
        if self.again:
            return
        # Emptied first: whatever interrupts the writing, nothing is written twice.
        seen = list(self.runs[-1])
        self.runs[-1].clear()
        self.session.record_balls(seen)

    def begin_run(self) -> None:
        if self.again:
            self.runs.append([])
        else:
            self.write()
            self.session.begin_run()

    def replace_earlier(self) -> bool:
        """Put what was seen anew in place of what was seen before; false where it is too little."""
        runs = [run for run in self.runs if run]
        if not self.again or sum(map(len, runs)) < _LEAST_SHARE * len(self.session.balls):
            return False
        self.session.replace_balls(runs)
        return True


def _tell_waved(coverage: Coverage, guide: Guide, *, replaced: bool) -> None:
    counts = ", ".join(f"{name} {count}" for name, count in coverage.counts().items())
    guide.done(f"the ball was seen well: {counts}")
    for name, (near, moments) in coverage.links().items():
        guide.say(f"{name} and {near} saw the ball at the same time {moments} times")
    if not replaced:
        guide.say("nothing replaces what was seen of the ball before, which is kept")
    if not coverage.enough:
        guide.say(f"more positions would help: {coverage.advice()}")


def _wave_line(coverage: Coverage, left_s: float, waiting: int) -> str:
    time_left = f"{left_s:.0f} s" if left_s > 0 else "a little longer"
    # They may show what the advice would ask for.
    behind = f"{waiting} frames are still to be looked at" if waiting > _MANY_WAIT else ""
    return f"{100 * coverage.share:3.0f} % covered, {time_left}: {behind or coverage.advice()}"


def _empty_booth(session: Session) -> dict[str, StaticView]:
    """The empty booth as each camera saw it, where that was looked at."""
    views = {name: session.background(name) for name in session.cameras}
    return {name: view for name, view in views.items() if view is not None}


def _depth_changes(
    empty: Mapping[str, StaticView],
    looked: Mapping[str, tuple[Iterable[NDArray[np.uint16]], float]],
) -> dict[str, float]:
    """Relative changes of the cameras' depths since the empty booth was recorded, where they show.

    Args:
        looked: each camera's frames (h, w), and their scale.
    """
    changes = {
        name: depth_change(*mean_view(seen, scale_m), empty[name])
        for name, (frames, scale_m) in looked.items()
        if name in empty and (seen := [*frames])
    }
    return {name: change for name, change in changes.items() if change is not None}
