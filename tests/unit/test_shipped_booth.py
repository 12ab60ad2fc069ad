"""The virtual booth that is shipped: what is kept of it, and recordings made without open3d."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np

from station.core.kinect_v1 import depth_m_of_raw
from station.core.rig import Rig
from station.sensors.recording import check_recording, read_raw
from station.simulation.shipped import (
    CALIBRATION,
    DEPTH_STEP_M,
    VIEWS,
    load_views,
    render,
    save_views,
)

_WITHOUT_OPEN3D = """
import sys
from pathlib import Path
sys.modules["open3d"] = None
from station.simulation.shipped import record
record(Path(sys.argv[1]))
"""


def test_the_views_are_those_that_are_rendered_today(tmp_path: Path) -> None:
    rig, rendered = render()
    save_views(tmp_path / "views.npz", rendered)
    again = load_views(tmp_path / "views.npz")
    assert Rig.load(CALIBRATION).cameras.keys() == rig.cameras.keys()
    kept = load_views(VIEWS)
    assert kept.keys() == rendered.keys()
    for name, view in rendered.items():
        seen = view.lit & view.reflects
        # Ray casting may differ in its last digit from one processor to another.
        assert np.mean(kept[name].lit != seen) < 1e-4
        both = seen & kept[name].lit
        off_m = np.abs(kept[name].depth_m - view.depth_m)[both]
        assert np.quantile(off_m, 0.999) <= DEPTH_STEP_M
        np.testing.assert_array_equal(again[name].lit, seen)
        off_m = np.abs(again[name].depth_m - view.depth_m)[seen]
        assert off_m.max() < 0.51 * DEPTH_STEP_M
        same = Rig.load(CALIBRATION).cameras[name].world_from_camera
        np.testing.assert_allclose(same, rig.cameras[name].world_from_camera, atol=1e-12)


def test_recordings_are_made_without_open3d(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", _WITHOUT_OPEN3D, tmp_path], check=True)
    for name, view in load_views(VIEWS).items():
        frames = check_recording(tmp_path / name)
        times_s = np.array([seconds for seconds, _, _ in frames])
        np.testing.assert_allclose(np.diff(times_s), 1.0 / 30.0, atol=1e-3)
        mean_m = np.mean([depth_m_of_raw(read_raw(path)) for *_, path in frames[:12]], axis=0)
        middle = np.s_[200:280, 280:360]
        assert abs(np.median((mean_m - view.depth_m)[middle])) < 0.005
    assert (tmp_path / CALIBRATION.name).read_bytes() == CALIBRATION.read_bytes()
