"""Stated errors of planes: a floor is not as flat as its number of pixels suggests."""

import numpy as np

from station.calibration.adjust.problem import Surface
from station.calibration.detect.planes import observe_floor, observe_wall
from station.core.geometry import invert
from station.core.lens import pixel_rays
from station.simulation.scene import (
    Mesh,
    VirtualScene,
    booth_walls,
    box,
    default_rig,
    uneven,
)

CAMERA = default_rig().cameras["front-lower"]
SCALE_M = 5e-5
FLOOR_M, BOARD_M = 5e-4, 2e-4


def _stack(meshes: list[Mesh]) -> np.ndarray:
    """A frame without noise, so many times that noise counts for nothing."""
    depth = VirtualScene(meshes).view(CAMERA, CAMERA.world_from_camera).depth_m
    frame = np.where(depth < 3.2, depth / SCALE_M, 0.0).astype(np.uint16)
    return np.repeat(frame[None], 60, axis=0)


def _deviation(surface: Surface, normal: tuple[float, float, float], distance_m: float) -> float:
    """Squared deviation of the plane's three numbers from normal . X = distance, world frame."""
    camera_from_world = invert(CAMERA.world_from_camera)
    along = camera_from_world[:3, :3] @ normal
    true = along / (distance_m + along @ camera_from_world[:3, 3])
    away = surface.plane - true
    ray = np.column_stack([pixel_rays(CAMERA, surface.pixels), np.ones(len(surface.pixels))])
    return float(away @ (ray.T @ (ray * surface.weight[:, None])) @ away)


def test_a_floors_bumps_are_in_its_covariance() -> None:
    found = []
    for seed in range(8):
        floor = uneven(booth_walls()[0], 2, FLOOR_M, np.random.default_rng(seed))
        seen = observe_floor(_stack([floor]), SCALE_M, CAMERA)
        assert seen is not None
        found.append(_deviation(Surface.of(CAMERA, seen, "floor"), (0.0, 0.0, -1.0), 0.0) / 3.0)
    # With every cell for itself it is 14; 24 degrees of freedom stay between 0.3 and 2.2.
    assert 0.3 < np.mean(found) < 2.2


def test_a_boards_bumps_are_in_its_covariance() -> None:
    found = []
    far = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    for seed in range(8):
        board = box((-0.6, -0.01, 0.0), (0.6, 0.01, 2.1))
        board = uneven(board, 1, BOARD_M, np.random.default_rng(seed))
        seen = observe_wall(_stack([board]), SCALE_M, CAMERA, "wall", far)
        assert seen is not None
        found.append(_deviation(Surface.of(CAMERA, seen, "wall"), (0.0, 1.0, 0.0), -0.01) / 3.0)
    assert 0.3 < np.mean(found) < 2.2


def test_a_flat_floor_is_where_it_is() -> None:
    seen = observe_floor(_stack([booth_walls()[0]]), SCALE_M, CAMERA)
    assert seen is not None
    assert _deviation(Surface.of(CAMERA, seen, "floor"), (0.0, 0.0, -1.0), 0.0) < 0.1
