"""`station calibrate`: from an empty booth and a waved ball to a dated calibration in use."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np

from station.calibration.board import Board, BoardView, check_ties, find_board, judge_lens
from station.calibration.feed import Feed, live_feed, replayed_feed
from station.calibration.guide import Guide
from station.calibration.rig import Rig
from station.calibration.session import (
    AROUND,
    BALL,
    EMPTY,
    FRONT,
    MARK,
    WALL,
    Lens,
    Session,
)
from station.calibration.session import SESSION as SESSION_FILE
from station.calibration.steps import (
    covered,
    look_at_empty_booth,
    look_at_wall,
    rest_ball,
    wave_ball,
)
from station.calibration.store import CalibrationStore
from station.config import BoothConfig, find_config, load_config
from station.errors import CalibrationError

_SENSORS_S = 20.0
_MOST_BOARDS, _MOST_PLACES = 20, 20
_AROUND = ("to the left of the mark", "to the right of the mark", "behind the mark")
"""Where the ball is laid: three places away from one line show the floor's slope both ways."""
_IMAGES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif")


@dataclass(frozen=True, slots=True)
class _Booth:
    """What every step needs."""

    config: BoothConfig
    store: CalibrationStore
    recordings: Path | None
    guide: Guide

    @contextmanager
    def feed(self, step: str) -> Iterator[tuple[Feed, Session]]:
        """Frames for a step and the calibration that is being done; begun if there is none."""
        if self.recordings is None:
            source = live_feed(self.config)
        else:
            source = replayed_feed(self.config, self.recordings / step)
        with source as feed:
            cameras = feed.cameras(_SENSORS_S)
            if (self.store.unfinished / SESSION_FILE).exists():
                session = Session.load(self.store.unfinished)
                session.check_cameras(cameras)
                self._check_radius(session)
            else:
                session = Session.begin(
                    self.store.unfinished, _now(), self.config.calibrate.ball_radius_m, cameras
                )
            yield feed, session

    def session(self) -> Session:
        """The calibration that is being done.

        Raises:
            CalibrationError: there is none.
        """
        if not (self.store.unfinished / SESSION_FILE).exists():
            raise CalibrationError(
                "no calibration has been begun; station calibrate goes through all steps"
            )
        return Session.load(self.store.unfinished)

    def walls(self) -> int:
        """How many places of the board the calibration that is being done has."""
        begun = (self.store.unfinished / SESSION_FILE).exists()
        return self.session().wall_count if begun else 0

    def places(self) -> int:
        """At how many places around the mark the ball has been laid."""
        begun = (self.store.unfinished / SESSION_FILE).exists()
        return len(self.session().around) if begun else 0

    def _check_radius(self, session: Session) -> None:
        radius_m = self.config.calibrate.ball_radius_m
        if session.radius_m != radius_m:
            raise CalibrationError(
                f"the calibration that was begun {session.started} is with a ball of "
                f"{session.radius_m:g} m and booth.toml says {radius_m:g} m "
                "(calibrate.ball_radius_m); correct it, or begin anew with station calibrate --new"
            )


def _options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that all steps share; the command gets a booth."""

    @click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
    @click.option(
        "--recordings",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        help="replay DIR/<step>/<camera> instead of the live cameras",
    )
    @click.option("--yes", is_flag=True, help="wait for nobody: no questions, no countdown")
    @functools.wraps(command)
    def wrapped(
        *args: Any, config_path: Path | None, recordings: Path | None, yes: bool, **kwargs: Any
    ) -> Any:
        context = click.get_current_context()
        if context.invoked_subcommand is not None:
            if any([config_path, recordings, yes, *kwargs.values()]):
                step = context.invoked_subcommand
                raise click.UsageError(f"put options after the step: station calibrate {step} ...")
            return None
        config = load_config(find_config(config_path))
        store = CalibrationStore(config.calibrate.folder, config.calibration)
        attended = not yes and recordings is None
        guide = Guide(attended, config.calibrate.countdown_s)
        booth = _Booth(config, store, recordings, guide)
        if kwargs.get("list_them"):
            return command(booth, *args, **kwargs)
        with store.locked():
            return command(booth, *args, **kwargs)

    return wrapped


@click.group(invoke_without_command=True)
@click.option("--use", "use_name", metavar="DATE", help="put a stored calibration into use")
@click.option("--list", "list_them", is_flag=True, help="show the stored calibrations")
@click.option("--new", is_flag=True, help="begin anew; what was seen so far is set aside")
@_options
def calibrate(booth: _Booth, use_name: str | None, list_them: bool, new: bool) -> None:
    """Find where the cameras are: empty booth, waved ball, mark and floor, then the solution.

    Without a step all of them are done, guided, from where the last attempt ended. Every result is
    a dated folder; the previous ones are kept.

    \b
    Examples:
      station calibrate                       guided, all steps
      station calibrate ball                  wave the ball a little longer
      station calibrate solve                 solve again from what was seen
      station calibrate --list
      station calibrate --use 20261121T100000Z
    """
    if list_them:
        _list(booth.store)
    elif use_name:
        entry = booth.store.use(use_name)
        click.echo(f"calibration {entry.name} is in use: {booth.store.in_use}")
    else:
        if new and (aside := booth.store.set_aside()):
            click.echo(f"what was seen so far is kept in {aside}")
        _guided(booth)


def _list(store: CalibrationStore) -> None:
    for entry in store.entries():
        mark = "*" if entry.in_use else " "
        click.echo(
            f"{mark} {entry.name}  {len(entry.rig.cameras)} cameras, "
            f"{1e3 * entry.rig.residual_rms_m:.2f} mm rms"
        )
    if (store.unfinished / SESSION_FILE).exists():
        click.echo(f"  unfinished, begun {Session.load(store.unfinished).started}")


def _guided(booth: _Booth) -> None:
    """All steps that are not done yet."""
    unfinished = (booth.store.unfinished / SESSION_FILE).exists()
    session = booth.session() if unfinished else None
    if session is not None:
        click.echo(f"going on with the calibration that was begun {session.started}")
    if session is None or not session.done(EMPTY):
        _empty(booth)
    if session is None or not covered(session, booth.config.reference).enough:
        _ball(booth)
    if session is None or not session.done(MARK):
        _rest(booth, MARK)
    if booth.recordings is not None and (booth.recordings / FRONT).is_dir():
        _rest(booth, FRONT)
    if session is None or len(session.around) < len(_AROUND):
        _around(booth, asked=True)
    if session is None or not session.done(WALL):
        _walls(booth, asked=True)
    _solve(booth)


def _empty(booth: _Booth) -> None:
    booth.guide.step("Empty booth", "Leave the booth empty; nobody in sight of the cameras.")
    with booth.feed(EMPTY) as (feed, session):
        look_at_empty_booth(feed, session, booth.guide)


def _ball(booth: _Booth) -> None:
    seconds = booth.config.calibrate.waving_s
    booth.guide.step(
        "Ball",
        f"Wave the ball ({2e2 * booth.config.calibrate.ball_radius_m:g} cm wide) slowly through "
        f"the whole booth for {seconds:g} s: low and high, left and right, around the mark.",
    )
    with booth.feed(BALL) as (feed, session):
        wave_ball(feed, session, booth.guide, reference=booth.config.reference, lasts_s=seconds)


def _rest(booth: _Booth, step: str) -> None:
    where = "on the mark" if step == MARK else "on the floor in front of the mark, 0.5 m away"
    _lay(booth, step, where)


def _lay(booth: _Booth, step: str, where: str, exactly: str = "") -> None:
    booth.guide.step(f"Ball {where}", f"Lay the ball {where}{exactly}; then step back.")
    with booth.feed(step) as (feed, session):
        rest_ball(feed, session, booth.guide, step)


def _around(booth: _Booth, asked: bool) -> None:
    """The ball on the floor beside and behind the mark; more places where they are wanted."""
    before = booth.places() if booth.recordings is None else 0
    for place in range(before, before + _MOST_PLACES):
        step = f"{AROUND}-{place}"
        if booth.recordings is not None:
            if not (booth.recordings / step).is_dir():
                return
        elif place >= len(_AROUND) and (
            asked or (place > before and not booth.guide.another("Lay it at one more place?"))
        ):
            return
        where = _AROUND[place] if place < len(_AROUND) else "anywhere else around the mark"
        exactly = ", 0.6 m away, where a lower camera sees it"
        _lay(booth, step, f"on the floor {where}", exactly)


def _walls(booth: _Booth, asked: bool) -> None:
    """The flat board at as many places as the operator (or the recordings) likes."""
    # Live, a further board is added to those that were seen; recordings have places of their own.
    before = booth.walls() if booth.recordings is None else 0
    for place in range(before, before + _MOST_BOARDS):
        if booth.recordings is not None:
            if not (booth.recordings / f"{WALL}-{place}").is_dir():
                return
        elif (asked or place > before) and not booth.guide.another(
            "A flat board at several distances makes the depths better. Show it (once more)?"
        ):
            return
        booth.guide.step(
            f"Flat board, place {place + 1}",
            "Stand a flat board (1 m or wider) upright across the booth; then another place.",
        )
        with booth.feed(f"{WALL}-{place}") as (feed, session):
            look_at_wall(feed, session, booth.guide, place)


def _solve(booth: _Booth) -> None:
    from station.calibration.solve import solve

    session = booth.session()
    config = booth.config
    booth.guide.title("Solution")
    solution = solve(
        session.observations(),
        session.lensed_cameras(),
        radius_m=session.radius_m,
        reference=config.reference,
        front_cameras=config.front_cameras,
        created=_now(),
        progress=booth.guide.progress,
    )
    for line in solution.summary():
        booth.guide.say(line)
    entry = booth.store.finish(solution.rig, solution.report)
    booth.store.use(entry.name)
    booth.guide.done(f"calibration {entry.name} is in use ({entry.folder})")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


@calibrate.command("floor")
@_options
def floor(booth: _Booth) -> None:
    """Look at the empty booth: its floor, and what always stands there.

    \b
    Examples:
      station calibrate floor
    """
    _empty(booth)


@calibrate.command("ball")
@click.option("--again", is_flag=True, help="forget what was seen of the ball before")
@_options
def ball(booth: _Booth, again: bool) -> None:
    """Wave the ball; what is seen is added to what was seen before.

    \b
    Examples:
      station calibrate ball
      station calibrate ball --again
    """
    if again:
        booth.session().forget_balls()
    _ball(booth)


@calibrate.command("mark")
@click.option("--front", is_flag=True, help="in front of the mark: says where the person faces")
@_options
def mark(booth: _Booth, front: bool) -> None:
    """Look at the ball lying on the mark: the origin of all measurements.

    \b
    Examples:
      station calibrate mark
      station calibrate mark --front
    """
    _rest(booth, FRONT if front else MARK)


@calibrate.command("around")
@_options
def around(booth: _Booth) -> None:
    """Look at the ball lying on the floor beside and behind the mark: the floor's slope.

    Further places are added to those that were seen.

    \b
    Examples:
      station calibrate around
    """
    _around(booth, asked=False)


@calibrate.command("depth")
@_options
def depth(booth: _Booth) -> None:
    """Look at a flat board at several distances: each sensor's own depth error.

    \b
    Examples:
      station calibrate depth
    """
    _walls(booth, asked=False)


@calibrate.command("solve")
@_options
def solve_again(booth: _Booth) -> None:
    """Solve from what was seen, and put the result into use.

    \b
    Examples:
      station calibrate solve
    """
    _solve(booth)


@calibrate.command("board")
@click.option(
    "--images",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    required=True,
    help="infrared images: DIR/<camera>/<moment>.png",
)
@click.option("--squares", default="7x5", show_default=True, help="across x down")
@click.option("--square", "square_m", default=0.06, show_default=True, help="side, metres")
@click.option("--marker", "marker_m", default=0.045, show_default=True, help="side, metres")
@click.option("--dictionary", default="DICT_4X4_100", show_default=True)
@_options
def board(
    booth: _Booth, images: Path, squares: str, square_m: float, marker_m: float, dictionary: str
) -> None:
    """Judge the lenses, and the calibration in use, by images of a ChArUco board.

    The factory's intrinsics are kept unless the images give better ones in millimetres. Images of
    one name were taken at one moment.

    \b
    Examples:
      station calibrate board --images board --squares 7x5 --square 0.06 --marker 0.045
    """
    printed = Board(*_two_numbers(squares), square_m, marker_m, dictionary)
    session = booth.session()
    views: dict[str, list[BoardView]] = {}
    for name in session.cameras:
        views[name] = _board_views(images / name, printed, session, name)
        booth.guide.say(f"camera {name}: the board is seen in {len(views[name])} images")
    if not any(views.values()):
        raise CalibrationError(
            f"{images} has no image of the board: DIR/<camera>/<moment>.png, cameras "
            f"{', '.join(session.cameras)}"
        )
    if booth.store.in_use.exists():
        ties = check_ties(Rig.load(booth.store.in_use), views, printed)
        for (one, other), off_m in ties.pairs.items():
            booth.guide.say(
                f"{one} and {other} see the board's corners {1e3 * off_m:.1f} mm apart "
                "through the calibration in use"
            )
    found: dict[str, Lens | None] = {}
    for name, seen in views.items():
        report = judge_lens(session.cameras[name], seen, printed)
        booth.guide.say(report.words())
        lens = report.lens
        found[name] = None if lens is None else Lens(lens.K.tolist(), lens.distortion.tolist())
    session.keep_lenses(found)


def _two_numbers(text: str) -> tuple[int, int]:
    try:
        columns, rows = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise CalibrationError(f"--squares {text}: give it as across x down, 7x5") from None
    return columns, rows


def _board_views(folder: Path, printed: Board, session: Session, name: str) -> list[BoardView]:
    camera = session.cameras[name]
    views = []
    for path in sorted(folder.glob("*")) if folder.is_dir() else []:
        if path.suffix.lower() not in _IMAGES:
            continue
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CalibrationError(f"{path} cannot be read as an image; remove it")
        if image.shape != (camera.height, camera.width):
            raise CalibrationError(
                f"{path} is {image.shape[1]} x {image.shape[0]}; camera {name} has "
                f"{camera.width} x {camera.height}"
            )
        view = find_board(np.asarray(image, np.uint8), printed, path.stem)
        if view is not None:
            views.append(view)
    return views
