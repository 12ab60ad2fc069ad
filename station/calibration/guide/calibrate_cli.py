"""`station calibrate`: from an empty booth and a waved ball to a dated calibration in use."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from station.calibration.detect.step_names import HANGING, RAISED_M, STAND
from station.calibration.guide.operator import Guide
from station.core.commands import Number, at_most_one, config_option
from station.core.config_file import find_config, load_config
from station.core.errors import CalibrationError
from station.core.files import local_time

# The rest is imported after the first words: compiled code takes most of a second to load, and
# several on a busy station.
if TYPE_CHECKING:
    from station.calibration.guide.procedure import Procedure


_SIDE = Number(0.001, 1.0, unit="metres")


def _options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that all steps share; the command gets the procedure."""

    @config_option
    @click.option(
        "--recordings",
        type=click.Path(path_type=Path, exists=True, file_okay=False),
        help="replay DIR/<step>/<camera> instead of the live cameras",
    )
    @click.option(
        "--yes", is_flag=True, help="do not wait for the operator: no questions, no countdown"
    )
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
        use, listing = kwargs.get("use_name"), kwargs.get("list_them")
        at_most_one(use=use, list=listing, new=kwargs.get("new"))
        at_most_one(use=use, list=listing, recordings=recordings)
        return _called(command, args, kwargs, config_path, recordings, yes)

    return wrapped


def _called(
    command: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    config_path: Path | None,
    recordings: Path | None,
    yes: bool,
) -> Any:
    if not kwargs.get("list_them"):
        click.echo("starting ...")
    from station.calibration.guide.procedure import Procedure
    from station.calibration.guide.store import CalibrationStore

    config = load_config(find_config(config_path))
    store = CalibrationStore.of(config)
    attended = not yes and recordings is None
    guide = Guide(attended, config.calibrate.countdown_s)
    procedure = Procedure(config, store, recordings, guide)
    if kwargs.get("list_them"):
        return command(procedure, *args, **kwargs)
    waved_anew = procedure.times_waved_anew()
    try:
        with store.locked():
            return command(procedure, *args, **kwargs)
    except (KeyboardInterrupt, click.Abort):
        kept = procedure.kept(waved_anew)
        click.echo(f"  stopped; {kept}; station calibrate goes on from here")
        raise
    finally:
        guide.end_line()


def _step(command: Callable[..., None]) -> Callable[..., Any]:
    """A step by itself: what it saw is kept until `solve`."""

    @_options
    @functools.wraps(command)
    def wrapped(procedure: Procedure, **kwargs: Any) -> None:
        procedure.tell_of_replay()
        command(procedure, **kwargs)
        following = procedure.following("station calibrate solve puts it into use")
        click.echo(f"  {following}")

    return wrapped


@click.group(invoke_without_command=True)
@click.option("--use", "use_name", metavar="DATE", help="put a stored calibration into use")
@click.option("--list", "list_them", is_flag=True, help="show the stored calibrations")
@click.option("--new", is_flag=True, help="start over; the unfinished calibration is abandoned")
@_options
def calibrate(procedure: Procedure, use_name: str | None, list_them: bool, new: bool) -> None:
    """Find where the cameras are: empty booth, ball waved, laid down and raised, board, solution.

    Without a step all of them are done, guided, from where the last attempt ended. A step by itself
    adds to the calibration that is being done, or else to the one in use (floor begins another);
    solve then puts the result into use. Every result is a dated folder; the previous ones are kept.

    \b
    Examples:
      station calibrate                       guided, all steps
      station calibrate ball                  wave the ball a little longer
      station calibrate around                lay the ball at more places, then ...
      station calibrate solve                 ... solve again from all that was seen
      station calibrate --list
      station calibrate --use 20261121T100000Z
    """
    from station.calibration.guide.recordings import check_folder

    if list_them:
        _list(procedure)
    elif use_name:
        entry = procedure.store.use(use_name, procedure.config.cameras)
        click.echo(f"calibration {entry.name} is in use: {procedure.store.in_use}")
    else:
        if procedure.recordings is not None:
            check_folder(procedure.recordings)
        if new and (folder := procedure.store.abandon()):
            click.echo(f"what was seen so far is kept in {folder}")
        procedure.run()


def _list(procedure: Procedure) -> None:
    from station.calibration.solve.refusals import SIGMAS_95

    entries, session = list(procedure.store.entries()), procedure.unfinished_session()
    abandoned, elsewhere = procedure.store.abandoned(), procedure.store.from_elsewhere()
    if elsewhere:
        click.echo(f"* {procedure.store.in_use}  in use; it is none of {procedure.store.folder}")
    elif not entries and not abandoned and session is None:
        click.echo("no calibration yet; station calibrate makes one")
    for entry in entries:
        mark = "*" if entry.in_use else " "
        found, accuracy = entry.rig.predicted, ""
        if found is not None:
            accuracy = (
                f"; heights to {1e3 * SIGMAS_95 * found.height_sigma_m:.1f} mm, girths to "
                f"{1e3 * SIGMAS_95 * found.girth_sigma_m:.1f} mm"
            )
        click.echo(
            f"{mark} {entry.name}  {len(entry.rig.cameras)} cameras, "
            f"{1e3 * entry.rig.residual_rms_m:.2f} mm rms{accuracy}"
        )
    for name, started in abandoned:
        click.echo(f"  {name}  started {local_time(started)}")
    if session is not None:
        origin = f", added to {session.adds_to}" if session.adds_to else ""
        click.echo(
            f"  unfinished, started {local_time(session.started)}{origin}: {session.summary()}"
        )


@calibrate.command("floor")
@_step
def floor(procedure: Procedure) -> None:
    """Look at the empty booth: its floor, and what always stands there.

    Without an unfinished calibration it begins another, in which all steps are done again: what is
    seen of the ball and the board is seen before this background.

    \b
    Examples:
      station calibrate floor
    """
    procedure.empty()


@calibrate.command("ball")
@click.option(
    "--again", is_flag=True, help="discard what was seen of the ball before, once it is seen anew"
)
@_step
def ball(procedure: Procedure, again: bool) -> None:
    """Wave the ball; what is seen is added to what was seen before.

    \b
    Examples:
      station calibrate ball
      station calibrate ball --again
    """
    procedure.ball(again=again)


@calibrate.command("mark")
@click.option("--front", is_flag=True, help="in front of the mark: says where the person faces")
@_step
def mark(procedure: Procedure, front: bool) -> None:
    """Look at the ball lying on the mark: the origin of all measurements.

    \b
    Examples:
      station calibrate mark
      station calibrate mark --front
    """
    from station.calibration.detect.step_names import FRONT, MARK

    procedure.rest(FRONT if front else MARK)


@calibrate.command("around")
@_step
def around(procedure: Procedure) -> None:
    """Look at the ball lying on the floor beside and behind the mark: the floor's slope.

    Further places are added to those that were seen.

    \b
    Examples:
      station calibrate around
    """
    procedure.around(asked=False)


@calibrate.command("stand")
@click.option(
    "--height",
    "height_m",
    type=Number(*RAISED_M, unit="metres"),
    help="of the ball's underside above the floor, metres, measured to 1 mm; without it, you are "
    "asked, and what is seen replaces all heights before",
)
@click.option(
    "--hanging", is_flag=True, help="the ball hangs on a string, from the same hook at each height"
)
@_step
def stand(procedure: Procedure, height_m: float | None, hanging: bool) -> None:
    """Look at the ball at a measured height above the mark: the scale of all heights.

    One as high as a head makes heights accurate; a lower one shows whether it was measured
    rightly. The ball stands on a stand, or it hangs on a string: from one and the same hook at two
    heights, it also shows what is vertical.

    \b
    Examples:
      station calibrate stand
      station calibrate stand --height 0.9
      station calibrate stand --height 1.7
      station calibrate stand --height 1.8 --hanging
      station calibrate stand --height 0.7 --hanging
    """
    from station.calibration.guide.raised_ball import see_all_heights, see_height

    if height_m is not None:
        see_height(procedure, height_m, HANGING if hanging else STAND)
    elif procedure.guide.attended or procedure.recordings is not None:
        see_all_heights(procedure, again=True, kind=HANGING if hanging else None)
    else:
        raise click.UsageError("nobody is asked with --yes: give --height METRES")


@calibrate.command("depth")
@_step
def depth(procedure: Procedure) -> None:
    """Look at a flat board at three distances or more: each sensor's own depth error.

    \b
    Examples:
      station calibrate depth
    """
    procedure.walls(asked=False)


@calibrate.command("solve")
@_options
def solve_again(procedure: Procedure) -> None:
    """Solve from what was seen, and put the result into use.

    \b
    Examples:
      station calibrate solve
    """
    procedure.solve()


@calibrate.command("board")
@click.option(
    "--images",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    required=True,
    help="infrared images: DIR/<camera>/<moment>.png",
)
@click.option("--squares", default="7x5", show_default=True, help="across x down")
@click.option(
    "--square", "square_m", type=_SIDE, default=0.06, show_default=True, help="side, metres"
)
@click.option(
    "--marker", "marker_m", type=_SIDE, default=0.045, show_default=True, help="side, metres"
)
@click.option("--dictionary", default="DICT_4X4_100", show_default=True)
@_options
def board(
    procedure: Procedure,
    images: Path,
    squares: str,
    square_m: float,
    marker_m: float,
    dictionary: str,
) -> None:
    """Judge the lenses, and the calibration in use, by images of a ChArUco board.

    The factory's intrinsics are kept unless the images give better ones in millimetres. Images of
    one name were taken at one moment.

    \b
    Examples:
      station calibrate board --images board --squares 7x5 --square 0.06 --marker 0.045
    """
    from station.calibration.detect.board import Board
    from station.calibration.guide.lens_board import judge_lenses

    judge_lenses(procedure, images, Board(*_two_numbers(squares), square_m, marker_m, dictionary))


def _two_numbers(text: str) -> tuple[int, int]:
    try:
        columns, rows = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise CalibrationError(f"--squares {text}: give it as across x down, 7x5") from None
    return columns, rows
