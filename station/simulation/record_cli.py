"""`station record-virtual`: a whole virtual booth as recordings that libfreenect replays."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path

import click

from station.calibration.detect.step_names import EMPTY
from station.core.commands import Number, writable_folder
from station.core.config import SHORTEST_WAVING_S
from station.core.errors import InputError
from station.core.service import die_with_parent
from station.sensors.recording import RecordedFrame, write_recording
from station.simulation.procedure import STRIDE, VirtualProcedure
from station.simulation.scene import fixed_posts, load_mesh
from station.simulation.sensor import (
    TICK_HZ,
    SimulatedBooth,
    VirtualCamera,
    recorded_frames,
)

PROCEDURE, TRUTH = "procedure", "true-calibration.json"
HEADING = "# A virtual booth: four replayed Kinects."
"""First line of its booth.toml."""
_UNIT_BIAS_M = 0.010
"""Each unit's systematic depth error if a calibration is recorded."""
_PROCESSES = 2


_COUNT, _SEED = click.IntRange(1), click.IntRange(0)


@click.command()
@click.option(
    "--body",
    type=click.Path(path_type=Path),
    help=".npz, .ply or .obj in metres; without it, the booth is empty",
)
@click.option(
    "--out", "out_folder", type=click.Path(path_type=Path), required=True, help="folder to write"
)
@click.option(
    "--seed",
    type=_SEED,
    default=0,
    show_default=True,
    help="of the noise and the clocks",
)
@click.option(
    "--frames",
    type=_COUNT,
    default=30,
    show_default=True,
    help="different frames per camera",
)
@click.option(
    "--passes",
    type=_COUNT,
    default=40,
    show_default=True,
    help="number of times they are repeated",
)
@click.option(
    "--driver",
    type=click.Choice(["freenect", "recorded"]),
    default="freenect",
    show_default=True,
    help="driver named in the booth.toml that is written beside them",
)
@click.option(
    "--calibration",
    "waving_s",
    type=Number(SHORTEST_WAVING_S, 600.0, unit="seconds"),
    help="also record a calibration, the ball waved for so many seconds; sensors then have depth "
    "errors of their own, and no calibration.json is written",
)
@click.option("--hanging", is_flag=True, help="in it, the ball hangs, instead of a stand")
def record_virtual(
    body: Path | None,
    out_folder: Path,
    seed: int,
    frames: int,
    passes: int,
    driver: str,
    waving_s: float | None,
    hanging: bool,
) -> None:
    """Render a person in a virtual booth as one recording a camera, with booth.toml.

    A folder that has a booth already is refused.

    \b
    Examples:
      station record-virtual --body station/simulation/bodies/ann.npz --out demo/booth
      station run --config demo/booth/booth.toml
      station record-virtual --out demo/empty
      station record-virtual --body person.ply --out demo/booth --calibration 60
      station calibrate --config demo/booth/booth.toml --recordings demo/booth/procedure
    """
    if hanging and waving_s is None:
        raise InputError("--hanging is of a calibration: give --calibration SECONDS too")
    if body is not None:
        load_mesh(body)
    bias_m = 0.0 if waving_s is None else _UNIT_BIAS_M
    booth = SimulatedBooth(seed=seed, bias_m=bias_m, clutter=fixed_posts())
    _refuse_a_booth(out_folder, booth)
    writable_folder(out_folder, "--out")
    jobs: dict[str, Callable[[], int]] = {
        f"camera {name}": partial(
            _record_person, booth, name, body, out_folder / name, frames, passes
        )
        for name in booth.rig.cameras
    }
    if waving_s is not None:
        procedure = VirtualProcedure(booth, waving_s=waving_s, hanging=hanging)
        for step in procedure.steps:
            for name in booth.rig.cameras:
                folder = out_folder / PROCEDURE / step / name
                jobs[f"{step}, camera {name}"] = partial(
                    _record_step, procedure, name, step, folder
                )
    _render(jobs, out_folder)
    lines = [HEADING, ""]
    for name in booth.rig.cameras:
        lines += ["[[cameras]]", f'name = "{name}"', f'driver = "{driver}"']
        lines += [f'recording = "{name}"', ""]
    booth.rig.save(out_folder / (TRUTH if waving_s is not None else "calibration.json"))
    if waving_s is not None:
        lines += ["[calibrate]", f"waving_s = {waving_s:g}", ""]
    (out_folder / "booth.toml").write_text("\n".join(lines))
    click.echo(out_folder / "booth.toml")
    if waving_s is not None:
        click.echo(
            f"calibrate it: station calibrate --config {out_folder / 'booth.toml'} "
            f"--recordings {out_folder / PROCEDURE}"
        )


def _refuse_a_booth(folder: Path, booth: SimulatedBooth) -> None:
    """Refuse a folder in which something would be overwritten.

    Raises:
        InputError: it has a configuration, a calibration or recordings.
    """
    for name in ("booth.toml", "calibration.json", TRUTH, PROCEDURE, *booth.rig.cameras):
        if os.path.lexists(folder / name):
            raise InputError(f"{folder / name} exists already; name a new folder with --out")


def _render(jobs: Mapping[str, Callable[[], int]], folder: Path) -> None:
    """Do all jobs, in processes of their own."""
    # Spawned: a forked child would share the ray caster's threads.
    context = multiprocessing.get_context("spawn")
    ending = partial(die_with_parent, os.getpid())
    pool = ProcessPoolExecutor(_PROCESSES, mp_context=context, initializer=ending)
    done = 0
    try:
        click.echo(f"rendering {len(jobs)} recordings, {_PROCESSES} at a time")
        # Renderers inherit this: a terminal's Ctrl-C goes to them too, and is this process's to
        # tell of.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        running = {pool.submit(job): what for what, job in jobs.items()}
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        for done, job in enumerate(as_completed(running), 1):
            click.echo(f"{done:3} of {len(jobs)}: {running[job]}, {job.result()} frames")
    except BaseException as cause:
        # Who ends the command does not wait for what is being rendered.
        for renderer in multiprocessing.active_children():
            renderer.kill()
        if isinstance(cause, KeyboardInterrupt):
            click.echo(
                f"stopped; {folder} is incomplete ({done} of {len(jobs)} recordings): delete it "
                "before you record there again",
                err=True,
            )
        raise
    finally:
        # Waited for: the pool's semaphores are released, which outlive the process otherwise.
        pool.shutdown(cancel_futures=True)


def _record_person(
    booth: SimulatedBooth, name: str, body: Path | None, folder: Path, frames: int, passes: int
) -> int:
    camera = VirtualCamera(booth, name, load_mesh(body) if body else None)
    return write_recording(folder, recorded_frames(camera, frames), tick_hz=TICK_HZ, passes=passes)


def _record_step(procedure: VirtualProcedure, name: str, step: str, folder: Path) -> int:
    # In the empty booth the floor is hardly seen: each frame counts.
    stride = 1.0 if step == EMPTY else STRIDE
    return write_recording(folder, _frames_of(procedure, name, step, stride), tick_hz=TICK_HZ)


def _frames_of(
    procedure: VirtualProcedure, name: str, step: str, stride: float
) -> Iterator[RecordedFrame]:
    for frame in procedure.frames(name, step, stride=stride):
        yield RecordedFrame(frame.time_s, frame.ticks, frame.raw)
