"""The live cloud uses the calibration in use, whenever that is made."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from station.booth.live import LiveCloud, frameset_points, is_empty
from station.core.config import Volume
from station.core.depth.correction import DepthCorrection
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import CameraCalibration, Rig
from station.simulation.scene import Mesh, load_mesh
from station.simulation.sensor import SimulatedBooth, VirtualCamera

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"
K = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])


def _rig(created: str, raised_m: float) -> Rig:
    pose = np.eye(4)
    pose[2, 3] = raised_m
    correction = DepthCorrection((0.0, 1.0))
    camera = CameraCalibration("a", "A1", "kinect-v1", 640, 480, K, np.zeros(5), correction, pose)
    return Rig(created, "a", {"a": camera}, 0.001)


def _frameset() -> Any:
    header = SimpleNamespace(depth_scale_m=1e-3)
    frame = SimpleNamespace(header=header, depth=np.full((480, 640), 2000, np.uint16))
    return cast(Any, SimpleNamespace(frames={"a": frame}))


def test_a_new_calibration_is_taken_up(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    live = LiveCloud(path, 1.0)
    assert live.points(_frameset(), 0.0) is None
    _rig("2026-11-21T10:00:00Z", 0.0).save(path)
    first = live.points(_frameset(), 10.0)
    assert first is not None
    assert np.allclose(first[:, 2], 2.0)
    _rig("2026-11-22T10:00:00Z", 0.5).save(path)
    second = live.points(_frameset(), 20.0)
    assert second is not None
    assert np.allclose(second[:, 2], 2.5)


def test_a_calibration_that_cannot_be_read_leaves_the_last_one(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    _rig("2026-11-21T10:00:00Z", 0.0).save(path)
    live = LiveCloud(path, 1.0)
    assert live.points(_frameset(), 0.0) is not None
    path.write_text("{")
    assert live.points(_frameset(), 10.0) is not None


def _counts_as_empty(body: Mesh | None, cameras: int = 4) -> bool:
    """Whether the booth with this body counts as empty, as its first so many cameras see it."""
    booth = SimulatedBooth(seed=8)
    header = SimpleNamespace(depth_scale_m=DEPTH_SCALE_M)
    frames = {}
    for name in list(booth.rig.cameras)[:cameras]:
        (frame,) = VirtualCamera(booth, name, body).frames(1)
        frames[name] = SimpleNamespace(header=header, depth=TABLE[frame.raw])
    found = cast(Any, SimpleNamespace(frames=frames))
    return is_empty(Volume(), frameset_points(booth.rig, found))


def test_a_booth_with_nobody_in_it_is_empty() -> None:
    assert _counts_as_empty(None)


@pytest.mark.parametrize("cameras", [1, 4])
def test_a_child_in_the_booth_is_somebody(cameras: int) -> None:
    adult = load_mesh(BODIES / "ann.npz")
    child = Mesh(adult.vertices * (0.5, 0.5, 0.6), adult.faces, adult.dark)
    assert not _counts_as_empty(child, cameras)
