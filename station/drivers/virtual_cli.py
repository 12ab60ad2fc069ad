"""`station record-virtual`: a whole virtual booth as recordings that libfreenect replays."""

from __future__ import annotations

from pathlib import Path

import click

from station.drivers.virtual import TICK_HZ, SimulatedBooth, VirtualCamera, recorded_frames
from station.drivers.virtual_scene import load_mesh
from station.recording import write_recording


@click.command()
@click.option(
    "--body", type=click.Path(path_type=Path), required=True, help=".npz, .ply or .obj in metres"
)
@click.option(
    "--out", "out_folder", type=click.Path(path_type=Path), required=True, help="folder to write"
)
@click.option("--seed", default=0, show_default=True, help="of the noise and the clocks")
@click.option("--frames", default=30, show_default=True, help="different frames per camera")
@click.option("--passes", default=40, show_default=True, help="how often they are repeated")
@click.option(
    "--driver",
    type=click.Choice(["freenect", "recorded"]),
    default="freenect",
    show_default=True,
    help="how the booth.toml written beside them reads them",
)
def record_virtual(
    body: Path, out_folder: Path, seed: int, frames: int, passes: int, driver: str
) -> None:
    """Render a person in a virtual booth as one recording a camera, with booth.toml.

    \b
    Examples:
      station record-virtual --body station/data/bodies/ann.npz --out demo/booth
      station run --config demo/booth/booth.toml
    """
    booth = SimulatedBooth(seed=seed)
    mesh = load_mesh(body)
    lines = ["# A virtual booth: four replayed Kinects.", ""]
    for name in booth.rig.cameras:
        click.echo(f"recording camera {name}")
        camera = VirtualCamera(booth, name, mesh)
        write_recording(
            out_folder / name, recorded_frames(camera, frames), tick_hz=TICK_HZ, passes=passes
        )
        lines += ["[[cameras]]", f'name = "{name}"', f'driver = "{driver}"']
        lines += [f'recording = "{name}"', ""]
    booth.rig.save(out_folder / "calibration.json")
    (out_folder / "booth.toml").write_text("\n".join(lines))
    click.echo(out_folder / "booth.toml")
