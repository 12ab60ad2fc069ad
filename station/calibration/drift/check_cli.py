"""`station check`: compares every camera with its calibration, before a shift."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np

from station.calibration.detect.warmth import (
    GIRTH_M_PER_CHANGE,
    TELLING,
    common_change,
    depth_change,
)
from station.calibration.drift.estimate import estimate_move
from station.calibration.drift.kept import use_correction
from station.calibration.drift.last_check import keep_check
from station.calibration.drift.motion import CameraMove, depths_words, move_words
from station.calibration.drift.reference import DriftReference
from station.calibration.guide.feed import Feed, TimedFrame, gather_frames, live_feed, replayed_feed
from station.calibration.guide.operator import Guide
from station.calibration.guide.store import CalibrationStore
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

    Exit code 0: every camera stands where it did; 3: one has moved, or no longer sees what it saw;
    4: the booth looks too different to tell, put it in order and check again.

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
    moves, depths = _moves(config, recordings, quiet=as_json)
    changed = [move for move in moves if move.changed]
    moved = any(move.moved or move.lost for move in moves)
    if as_json:
        click.echo(json.dumps([_document(move, depths.get(move.camera)) for move in moves]))
    else:
        _tell(moves, changed, depths, moved=moved)
    if recordings is None:
        try:
            keep_check(config.console.folder, moves)
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


def _moves(
    config: BoothConfig, recordings: Path | None, quiet: bool
) -> tuple[list[CameraMove], dict[str, float]]:
    """Estimates of how far each camera stands from where it was calibrated, and relative changes of
    its depths by camera, where they show.

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
    moves, depths = list[CameraMove](), dict[str, float]()
    for name, frames in taken.items():
        pixels, scale_m = [frame.pixels() for frame in frames], frames[0].scale_m
        camera = rig.camera(name, str(config.calibration))
        moves.append(estimate_move(DriftReference.prepare(camera, scene[name]), pixels, scale_m))
        if (change := depth_change(pixels, scale_m, scene[name])) is not None:
            depths[name] = change
    return moves, depths


def _tell(
    moves: list[CameraMove],
    changed: list[CameraMove],
    depths: Mapping[str, float],
    *,
    moved: bool,
) -> None:
    for move in moves:
        click.echo(move.words())
    for line in _unseen_lines(moves):
        click.echo(f"  {line}")
    words = depths_words(moves) or _depths_line(depths)
    if words:
        click.echo(words)
    if changed:
        most = min(changed, key=lambda move: move.share)
        percent = 100.0 * (1.0 - most.share)
        click.echo(
            f"the booth does not look as it did when it was calibrated ({percent:.0f} % of what "
            f"camera {most.camera} sees differs): remove people and objects that were "
            "not there and put back what is missing, so that small moves can be detected"
        )
    elif not moved:
        order = "" if words else "the booth is in order: "
        click.echo(f"{order}no camera has moved, as far as their views can show")


def _depths_line(depths: Mapping[str, float]) -> str:
    """Line on depths that all cameras see changed; "" where they are as at the calibration."""
    change = common_change(depths)
    if abs(change) <= TELLING:
        return ""
    return (
        f"all cameras see the booth {100.0 * abs(change):.2f} % "
        f"{'farther away' if change > 0.0 else 'nearer'} than when they were calibrated: girths "
        f"come out about {1e3 * GIRTH_M_PER_CHANGE * abs(change):.0f} mm too "
        f"{'small' if change > 0.0 else 'large'}; let the sensors warm up for 20 minutes, and "
        "check again; if nothing changes, run station calibrate"
    )


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


def _document(move: CameraMove, change: float | None) -> dict[str, object]:
    return {
        "camera": move.camera,
        "moved": move.moved,
        "lost": move.lost,
        "changed": move.changed,
        "rotation_rad": move.xi[:3].tolist(),
        "translation_m": move.xi[3:].tolist(),
        "sigma": np.sqrt(np.diag(move.stated)).tolist(),
        "background_share": move.share,
        "depth_change": change,
        "unseen": move.unseen_words(),
    }
