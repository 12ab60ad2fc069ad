"""Contours of limbs, which tell where the skin is that no camera sees."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from station.simulation.scene import Mesh, VirtualScene, booth_walls, default_rig
from workers.cloud.observed import CameraView, PointCloud
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.contours import (
    _edges_on_lines,
    contour_places,
    contour_rows,
    side_offsets_px,
    warm_up,
)
from workers.scape.surface.displacement import fit_surface

CAMERAS = [default_rig().cameras[name] for name in ("front-lower", "back-lower")]
POSES = [camera.world_from_camera for camera in CAMERAS]
RIGHT_SIDES = [1, 3]


@pytest.fixture(scope="module")
def body(model: BodyModel) -> np.ndarray:
    return model.mean - (0.0, 0.0, model.mean[:, 2].min())


@pytest.fixture(scope="module")
def wider(model: BodyModel, body: np.ndarray) -> np.ndarray:
    """The left thigh stands out by 6 mm on its outer side, where no camera sees it."""
    side = np.array([np.cos(np.radians(15.0)), np.sin(np.radians(15.0)), 0.0])
    normals = vertex_normals(body, model.faces)
    thigh = model.vertex_weights[:, model.part_names.index("thigh_left")]
    share = thigh * np.clip((normals @ side - 0.85) / 0.15, 0.0, 1.0)
    return np.asarray(body + 0.006 * share[:, None] * side)


def _views(
    model: BodyModel, body: np.ndarray, *, walls: bool = True, wider_px: int = 0
) -> list[CameraView]:
    """Views without noise, up to 71 degrees of incidence, of a sensor whose silhouettes are too
    wide by some pixels."""
    scene = VirtualScene([*(booth_walls() if walls else ()), Mesh(body, model.faces)])
    views = []
    for camera in CAMERAS:
        seen = scene.view(camera, camera.world_from_camera)
        person = (seen.depth_m > 0.0) & (seen.depth_m < 2.0)
        steep = person & (seen.incidence_rad > np.radians(71.0))
        depth = np.where(seen.lit & seen.reflects & ~steep, seen.depth_m, 0.0).astype(np.float32)
        if wider_px:
            grown = np.ones((2 * wider_px + 1, 2 * wider_px + 1), np.uint8)
            near = cv2.erode(np.where(person, seen.depth_m, 9.0).astype(np.float32), grown)
            rim = cv2.dilate(person.astype(np.uint8), grown).astype(bool) & ~person
            depth = np.where(rim & (near < 2.0), near, depth).astype(np.float32)
        nothing = np.zeros(depth.shape, bool)
        views.append(CameraView(camera.name, camera, depth, nothing, nothing))
    return views


def _cloud(model: BodyModel, body: np.ndarray) -> PointCloud:
    """The vertices that face one of the cameras by up to 71 degrees."""
    normals = vertex_normals(body, model.faces)
    facing = np.zeros(len(body), bool)
    for pose in POSES:
        ray = body - pose[:3, 3]
        cosine = -np.einsum("ni,ni->n", normals, ray) / np.linalg.norm(ray, axis=1)
        facing |= cosine > np.cos(np.radians(71.0))
    count = int(facing.sum())
    return PointCloud(
        body[facing],
        normals[facing],
        np.full(count, 1e-3),
        np.zeros(count, np.int16),
        ("front-lower",),
    )


def test_right_edges_agree_with_the_true_surface(model: BodyModel, body: np.ndarray) -> None:
    """The projector's shadow hides those on the left."""
    places = contour_places(model, _views(model, body), POSES, body)
    offsets = side_offsets_px(places, len(POSES))
    assert np.isfinite(offsets[RIGHT_SIDES]).all()
    assert (np.abs(offsets[RIGHT_SIDES]) < 1.0).all()
    for side in RIGHT_SIDES:
        away = places.beyond_px[places.side == side] - offsets[side]
        assert np.median(np.abs(away)) < 0.5
    rows = contour_rows(model, places, offsets, np.zeros_like(body))
    assert np.median(np.abs(rows.residual_m)) < 0.0015


@pytest.mark.parametrize("wider_px", [0, 2], ids=["sharp", "silhouettes too wide"])
def test_skin_that_no_camera_sees_follows_its_contour(
    model: BodyModel, body: np.ndarray, wider: np.ndarray, wider_px: int
) -> None:
    """An edge that is drawn too far out is so everywhere: no limb becomes wider by it."""
    cloud = _cloud(model, wider)
    moved = np.linalg.norm(wider - body, axis=1)
    bulge = moved > 0.004
    normals = vertex_normals(wider, model.faces)

    def error_m(views: list[CameraView]) -> np.ndarray:
        fitted = fit_surface(model, body, cloud, views, POSES[: len(views)])
        return np.asarray(np.einsum("ni,ni->n", fitted.vertices - wider, normals))

    views = _views(model, wider, wider_px=wider_px)
    without, found = error_m([]), error_m(views)
    assert without[bulge].mean() < -0.003
    # The prior is narrow for a body that is else the model's.
    assert abs(found[bulge].mean()) < abs(without[bulge].mean()) - 0.0008
    shins = model.vertex_weights[:, model.part_names.index("shin_left")] > 0.9
    assert np.abs(found[shins]).mean() < np.abs(without[shins]).mean() + 0.0005


def test_without_anything_behind_there_are_no_contours(model: BodyModel, body: np.ndarray) -> None:
    places = contour_places(model, _views(model, body, walls=False), POSES, body)
    assert np.isnan(side_offsets_px(places, len(POSES))).all()


def test_edges_that_scatter_are_not_used(model: BodyModel, body: np.ndarray) -> None:
    places = contour_places(model, _views(model, body), POSES, body)
    rng = np.random.default_rng(3)
    scattered = replace(places, beyond_px=rng.uniform(-6.0, 6.0, len(places.side)))
    assert np.isnan(side_offsets_px(scattered, len(POSES))).all()
    rows = contour_rows(model, places, np.full(2 * len(POSES), np.nan), np.zeros_like(body))
    assert not len(rows.weight)


def test_a_hole_in_the_background_is_no_edge() -> None:
    """The limb ends at pixel 49, the wall begins at 50 and has no reading at 52. From a place that
    lies 2.5 px too far out, the hole was the nearer edge."""
    row = np.where(np.arange(100) < 50, 1.7, 3.4).astype(np.float32)
    row[52] = 0.0
    depth = np.repeat(row[None], 20, axis=0)
    place = np.array([[52.0, 10.0], [np.nan, 10.0], [52.0, 300.0]])
    across, depth_m = np.array([[1.0, 0.0]] * 3), np.full(3, 1.7)
    edges = _edges_on_lines(depth, place, across, depth_m)
    assert np.allclose(edges[0], -2.5, atol=0.5)
    assert np.isnan(edges[1:]).all()
    # Nothing of a limb that something nearer hides, nor one that ends in a wide shadow.
    assert np.isnan(_edges_on_lines(depth, place, across, depth_m + 0.5)).all()
    depth[:, 45:52] = 0.0
    assert np.isnan(_edges_on_lines(depth, place, across, depth_m)).all()


def test_the_first_scan_does_not_compile(model: BodyModel, body: np.ndarray) -> None:
    """Depths that were a column of an array are another type to the compiler."""
    warm_up()
    contour_places(model, _views(model, body), POSES, body)
    assert len(_edges_on_lines.signatures) == 1
