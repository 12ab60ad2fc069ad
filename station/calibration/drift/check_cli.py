"""`station check`: compares every camera with its calibration, before a shift."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np

from station.calibration.drift.kept import use_correction
from station.calibration.drift.last_check import keep_check
from station.calibration.guide.feed import Feed, TimedFrame, gather_frames, live_feed, replayed_feed
from station.calibration.guide.operator import Guide
from station.calibration.guide.store import CalibrationStore
from station.calibration.moves.depths import ChangedDepths, SeenDepths
from station.calibration.moves.look import Look, compared
from station.calibration.moves.motion import CameraMove, depths_words, everything_words, move_words
from station.calibration.moves.reference import DriftReference
from station.core.commands import at_most_one, config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import CalibrationError
from station.core.files import utc_now
from station.core.rig import Rig
from station.sensors.identity import calibrated_serials, configured_serials, mismatch

_FRAMES = 30
_SENSORS_S = 20.0
_EXIT_MOVED = 3
_EXIT_CHANGED = 4


@click.command()
@config_option
@click.option(
    "--recordings",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="replay DIR/<camera> instead of the live cameras",
)
@click.option("--json", "as_json", is_flag=True, help="for programs")
@click.option(
    "--correct", is_flag=True, help="correct the calibration by the scans of the last people"
)
def check(config_path: Path | None, recordings: Path | None, as_json: bool, correct: bool) -> None:
    """Compare the empty booth with what was stored when it was calibrated.

    Exit code 0: every camera stands where it did; 3: one has moved, or no longer sees what it saw,
    or all see everything so much nearer or farther away that no scan is taken; 4: the booth looks
    too different to tell, put it in order and check again.

    With --correct: where the scans of the last people say that a camera has drifted, store and use
    a corrected calibration, provided that it also fits people whom it was not computed from.

    \b
    Examples:
      station check
      station check --json
      station check --correct
    """
    at_most_one(correct=correct, recordings=recordings)
    at_most_one(correct=correct, json=as_json)
    config = load_config(find_config(config_path))
    if correct:
        _correct(config)
        return
    looks, depths, moves = _compared(config, recordings, quiet=as_json)
    changed = [move for move in moves if move.changed]
    moved = any(move.moved or move.lost for move in moves)
    moved |= depths is not None and depths.too_large
    words = depths_words(moves) or ""
    if not words and depths is not None:
        # Without the check scans are not corrected either.
        checked = config.drift.refuse_scans
        words = depths.words() if checked else everything_words(depths.at_walls)
    if as_json:
        click.echo(json.dumps([_document(move, looks[move.camera].depths) for move in moves]))
    else:
        _tell(moves, changed, words, moved=moved)
    if recordings is None:
        try:
            keep_check(config.console.folder, moves, words)
        except OSError as error:
            # What was found is told all the same, by the exit code too.
            reason = error.strerror or str(error)
            click.echo(f"the console is not told: {config.console.folder}: {reason}", err=True)
    if moved:
        sys.exit(_EXIT_MOVED)
    if changed:
        sys.exit(_EXIT_CHANGED)


def _correct(config: BoothConfig) -> None:
    """Put a calibration into use that the scans of the last people have corrected."""
    drift, entry = use_correction(config, utc_now())
    click.echo(
        f"camera {drift.camera} is now taken to stand where the scans of the last people saw "
        f"it: {move_words(drift.xi)} from where it was calibrated"
    )
    click.echo(
        f"calibration {entry.name} is in use; station calibrate --list shows the others, and "
        "station calibrate --use DATE returns to one of them"
    )


def _compared(
    config: BoothConfig, recordings: Path | None, quiet: bool
) -> tuple[dict[str, Look], ChangedDepths | None, list[CameraMove]]:
    """Looks of all cameras, the change of their depths, if there is one, and estimates of how far
    each stands from where it was calibrated.

    Raises:
        CalibrationError: cameras or sensors are not those of the calibration, or its picture of
            the empty booth lacks one.
    """
    store = CalibrationStore.of(config)
    rig = store.rig_in_use()
    _refuse_others(rig, configured_serials(config.cameras))
    scene = store.scene()
    names = [camera.name for camera in config.cameras]
    missing = [name for name in names if name not in scene]
    if missing:
        raise CalibrationError(
            f"the calibration in use ({config.calibration}) has no picture of the empty booth by "
            f"{_cameras(missing)}; calibrate with station calibrate"
        )
    source = replayed_feed(config, recordings) if recordings else live_feed(config)
    with source as feed:
        taken = _look(feed, rig, names, quiet)
    looks = dict[str, Look]()
    for name, frames in taken.items():
        reference = DriftReference.prepare(rig.camera(name, str(config.calibration)), scene[name])
        pixels = [frame.pixels() for frame in frames]
        looks[name] = Look.of(reference, scene[name], pixels, frames[0].scale_m)
    return looks, *compared(looks, names)


def _tell(
    moves: list[CameraMove],
    changed: list[CameraMove],
    depths: str,
    *,
    moved: bool,
) -> None:
    for move in moves:
        click.echo(move.words())
    for line in _unseen_lines(moves):
        click.echo(f"  {line}")
    if depths:
        click.echo(depths)
    if changed:
        most = min(changed, key=lambda move: move.share)
        percent = 100.0 * (1.0 - most.share)
        click.echo(
            f"the booth does not look as it did when it was calibrated ({percent:.0f} % of what "
            f"camera {most.camera} sees differs): remove people and objects that were "
            "not there and put back what is missing, so that small moves can be detected"
        )
    elif not moved:
        order = "" if depths else "the booth is in order: "
        click.echo(f"{order}no camera has moved, as far as their views can show")


def _unseen_lines(moves: Sequence[CameraMove]) -> list[str]:
    """Lines on the directions that views cannot show, one for all cameras that share them."""
    cameras: dict[str, list[str]] = {}
    for move in moves:
        if not move.lost and (words := _either(move.unseen_words())):
            cameras.setdefault(words, []).append(move.camera)
    lines = [
        f"{_cameras(names)}: a small {words} cannot be detected" for words, names in cameras.items()
    ]
    if lines:
        lines.append("a fixed post or corner in a camera's view would make it possible")
    return lines


def _either(words: Sequence[str]) -> str:
    return " or ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _cameras(names: Sequence[str]) -> str:
    return f"camera{'s' if len(names) > 1 else ''} {', '.join(names)}"


def _refuse_others(rig: Rig, serials: Mapping[str, str]) -> None:
    """Refuse a booth that is not the calibrated one, as scans do: it would tell nothing of it."""
    if words := mismatch(calibrated_serials(rig.cameras), serials):
        raise CalibrationError(words)


def _look(feed: Feed, rig: Rig, names: list[str], quiet: bool) -> dict[str, list[TimedFrame]]:
    _refuse_others(rig, calibrated_serials(feed.cameras(_SENSORS_S)))
    guide = Guide(attended=False, countdown_s=0.0)
    taken = gather_frames(feed, names, _FRAMES, (lambda _: None) if quiet else guide.progress)
    guide.end_line()
    return taken


def _document(move: CameraMove, depths: SeenDepths | None) -> dict[str, object]:
    return {
        "camera": move.camera,
        "moved": move.moved,
        "lost": move.lost,
        "changed": move.changed,
        "rotation_rad": move.xi[:3].tolist(),
        "translation_m": move.xi[3:].tolist(),
        "sigma": np.sqrt(np.diag(move.stated)).tolist(),
        "background_share": move.share,
        "depth_change": None if depths is None else depths.at_walls,
        "unseen": move.unseen_words(),
    }
