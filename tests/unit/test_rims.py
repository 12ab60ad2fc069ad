"""Rims of thin things before a wall."""

from __future__ import annotations

import numpy as np
import pytest

from station.core.geometry import invert, transform
from station.core.lens import project
from station.simulation.scene import default_rig
from workers.cloud.observed import CameraView, PointCloud
from workers.scape.evidence.rims import rims_of

FINGER_M, WALL_M = 1.6, 3.0
ROWS, COLUMNS = slice(200, 240), slice(318, 323)


def _seen(depth_m: np.ndarray) -> CameraView:
    camera = next(iter(default_rig().cameras.values()))
    nothing = np.zeros(depth_m.shape, bool)
    return CameraView(camera.name, camera, depth_m, nothing, nothing)


def _finger() -> np.ndarray:
    """Five pixels wide, as a finger is: every reading lies at its edge."""
    camera = next(iter(default_rig().cameras.values()))
    depth = np.full((camera.height, camera.width), WALL_M, np.float32)
    depth[ROWS, COLUMNS] = FINGER_M
    return depth


def _rims(depth_m: np.ndarray) -> tuple[PointCloud, np.ndarray]:
    """Rims around where the finger is thought to be, 4 px short of its tip, and their pixels."""
    view = _seen(depth_m)
    K, pose = view.calibration.K, view.calibration.world_from_camera
    pixels = np.array([(u, v) for u in (319, 322) for v in (200, 235)], float)
    local = np.column_stack([(pixels - K[:2, 2]) / np.diag(K)[:2], np.ones(4)]) * FINGER_M
    rims = rims_of([view], ("another", view.name), [transform(pose, local)])
    return rims, project(view.calibration, transform(invert(pose), rims.points))


def test_a_finger_ends_at_its_outline() -> None:
    rims, pixels = _rims(_finger())
    assert (rims.camera == 1).all()
    # The last pixel's outer border, at the tip and at either side.
    assert pixels[:, 1].max() == pytest.approx(239.5, abs=0.1)
    assert pixels[:, 0].min() == pytest.approx(317.5, abs=0.1)
    assert pixels[:, 0].max() == pytest.approx(322.5, abs=0.1)


def test_a_rim_turns_away_from_its_camera_and_outwards() -> None:
    rims, pixels = _rims(_finger())
    pose = _seen(_finger()).calibration.world_from_camera
    rays = rims.points - pose[:3, 3]
    assert np.abs(np.einsum("ni,ni->n", rims.normals, rays)).max() < 1e-9
    assert np.allclose(np.linalg.norm(rims.normals, axis=1), 1.0)
    tip = (pixels[:, 1] > 239.4) & (np.abs(pixels[:, 0] - 320.0) < 0.5)
    left = (pixels[:, 0] < 317.6) & (np.abs(pixels[:, 1] - 220.0) < 10.0)
    assert tip.any()
    assert left.any()
    assert (rims.normals[tip] @ pose[:3, 1] > 0.99).all()
    assert (rims.normals[left] @ pose[:3, 0] < -0.99).all()


@pytest.mark.parametrize("lost_px", [1, 2])
def test_a_hand_is_as_wide_as_the_wall_leaves_it(lost_px: int) -> None:
    """A camera that loses the outermost pixels of silhouettes, beside the one that flickers."""
    depth = _finger()
    depth[190:241, 309:332] = 0.0
    depth[190 : 240 - lost_px, 310 + lost_px : 331 - lost_px] = FINGER_M
    _, pixels = _rims(depth)
    assert pixels[:, 1].max() == pytest.approx(239.5, abs=0.3)
    assert pixels[:, 0].min() == pytest.approx(309.5, abs=0.3)
    assert pixels[:, 0].max() == pytest.approx(330.5, abs=0.3)


def test_what_hides_a_finger_is_not_its_end() -> None:
    depth = _finger()
    depth[225:300, 250:400] = 1.2
    _, pixels = _rims(depth)
    assert len(pixels)
    assert pixels[:, 1].max() < 225.0


def test_what_gives_no_reading_is_not_an_end() -> None:
    """A ring, a dark nail: nothing lies behind them."""
    depth = _finger()
    depth[ROWS, 300:340] = FINGER_M
    depth[215:225, 315:325] = 0.0
    _, pixels = _rims(depth)
    assert not ((np.abs(pixels - (320.0, 220.0))) < (10.0, 10.0)).all(axis=1).any()


def test_nobody_has_no_rims() -> None:
    assert not len(rims_of([], (), []))
    assert not len(_rims(np.full_like(_finger(), WALL_M))[0])
