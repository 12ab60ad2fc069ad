"""The virtual booth that every package carries: recordings of a person, made without ray casting.

What four perfect sensors would see was rendered once (`render`); the errors of a Kinect are drawn
anew wherever recordings are made of it, so that the views take little space and no open3d.

Usage: python -m station.simulation.shipped FOLDER
       python -m station.simulation.shipped --render    renders the views that the package carries
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from station.core.kinect_v1 import FRAME_RATE_HZ, TICK_BITS, TICK_HZ
from station.core.rig import Rig
from station.sensors.recording import RecordedFrame, write_recording
from station.simulation.noise import NoiselessView, TrueView, UnitError

_DATA = Path(__file__).parent / "data"
VIEWS, CALIBRATION = _DATA / "views.npz", _DATA / "calibration.json"
BODY = Path(__file__).parent / "bodies" / "ann.npz"
"""The person in the views; the model was not learned from her."""
DEPTH_STEP_M, INCIDENCE_STEP_RAD = 1e-4, float(np.radians(0.5))
"""Steps of the views as they are kept: a tenth of the sensor's own noise at its nearest."""
_FRAMES, _PASSES = 12, 150
"""Frames that differ, as a scan needs ten; repeated, they last for a minute."""


def record(folder: Path) -> None:
    """Write one recording a camera, and the calibration that belongs to them."""
    for index, (name, view) in enumerate(load_views(VIEWS).items()):
        write_recording(folder / name, _frames(view, index), tick_hz=TICK_HZ, passes=_PASSES)
    Rig.load(CALIBRATION).save(folder / CALIBRATION.name)


def _frames(view: TrueView, index: int) -> Iterator[RecordedFrame]:
    """Noisy frames of one unit, whose clock is out of step with the others'."""
    noiseless = NoiselessView.of(view, UnitError())
    rng = np.random.default_rng(index)
    phase_s, first_tick = rng.uniform(0.0, 1.0 / FRAME_RATE_HZ), int(rng.integers(2**TICK_BITS))
    for number in range(_FRAMES):
        time_s = phase_s + number / FRAME_RATE_HZ
        ticks = (first_tick + round(time_s * TICK_HZ)) % 2**TICK_BITS
        yield RecordedFrame(time_s, ticks, noiseless.read(rng))


def save_views(path: Path, views: Mapping[str, TrueView]) -> None:
    """Keep the views of some cameras; what gives no reading is not kept."""
    images = {}
    for name, view in views.items():
        depth_m = np.where(view.lit & view.reflects, view.depth_m, 0.0)
        steps = np.rint(depth_m / DEPTH_STEP_M).astype(np.uint16)
        # Differences along the rows, modulo 2^16: a quarter of the space.
        images[f"{name}/depth"] = np.diff(steps, axis=1, prepend=np.uint16(0))
        angle = np.where(depth_m > 0.0, view.incidence_rad, 0.0)
        images[f"{name}/incidence"] = np.rint(angle / INCIDENCE_STEP_RAD).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, allow_pickle=False, **images)


def load_views(path: Path) -> dict[str, TrueView]:
    """Camera -> its view, to a tenth of a millimetre and half a degree."""
    views = {}
    with np.load(path, allow_pickle=False) as images:
        for name in dict.fromkeys(key.partition("/")[0] for key in images.files):
            steps = np.cumsum(images[f"{name}/depth"], axis=1, dtype=np.uint16)
            depth_m = (steps * DEPTH_STEP_M).astype(np.float32)
            angle_rad = (images[f"{name}/incidence"] * INCIDENCE_STEP_RAD).astype(np.float32)
            seen = depth_m > 0.0
            views[name] = TrueView(depth_m, angle_rad, seen, np.ones_like(seen))
    return views


def render() -> tuple[Rig, dict[str, TrueView]]:
    """Calibration and true views of the virtual booth with its person; needs open3d."""
    from station.simulation.scene import VirtualScene, fixed_posts, load_mesh
    from station.simulation.sensor import SimulatedBooth

    booth = SimulatedBooth(clutter=fixed_posts())
    scene = VirtualScene([*booth.fixtures, load_mesh(BODY)])
    cameras = booth.rig.cameras.values()
    return booth.rig, {c.name: scene.view(c, c.world_from_camera) for c in cameras}


def main() -> None:
    if sys.argv[1] == "--render":
        rig, views = render()
        rig.save(CALIBRATION)
        save_views(VIEWS, views)
    else:
        record(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
