"""The height of the head, from its end in the images."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from station.core.geometry import invert, rigid, so3_exp, transform
from station.core.lens import project, rays
from station.core.rig import PredictedError
from station.simulation.scene import (
    Mesh,
    VirtualScene,
    booth_walls,
    default_rig,
    rod,
    sphere,
)
from workers.cloud.observed import CameraView, PointCloud
from workers.scape.evidence.cameras import CameraCorrections
from workers.scape.evidence.crown import _outline, crown_rows, crown_sigma_m
from workers.scape.evidence.rows import Rows
from workers.scape.model.body_model import BodyModel
from workers.scape.model.deformation import vertex_normals
from workers.scape.surface.displacement import fit_surface

UPPER = default_rig().cameras["front-upper"]
POSE = UPPER.world_from_camera
ROLLED = POSE @ rigid(so3_exp([0.0, 0.0, 0.5 * np.pi]), np.zeros(3))
TURNED = POSE @ rigid(so3_exp([0.0, 0.0, np.pi]), np.zeros(3))
HIGHER = np.array([0.0, 0.0, 0.006])


@pytest.fixture(scope="module")
def body(model: BodyModel) -> np.ndarray:
    return model.mean - (0.0, 0.0, model.mean[:, 2].min())


def _view(
    model: BodyModel,
    body: np.ndarray,
    pose: np.ndarray = POSE,
    *,
    walls: bool = True,
    bald: bool = True,
    beside: Sequence[Mesh] = (),
) -> CameraView:
    """View of a body by a sensor without noise, up to 71 degrees of incidence."""
    dark = np.zeros(len(model.faces), bool)
    if not bald:
        dark = body[model.faces][:, :, 2].mean(axis=1) > body[:, 2].max() - 0.045
    around = booth_walls() if walls else ()
    scene = VirtualScene([*around, *beside, Mesh(body, model.faces, dark)])
    seen = scene.view(UPPER, pose)
    steep = (seen.incidence_rad > np.radians(71.0)) & (seen.depth_m < 2.0)
    depth = np.where(seen.lit & seen.reflects & ~steep, seen.depth_m, 0.0).astype(np.float32)
    nothing = np.zeros(depth.shape, bool)
    return CameraView(
        "front-upper", replace(UPPER, world_from_camera=pose), depth, nothing, nothing
    )


def _reach(model: BodyModel, view: CameraView, body: np.ndarray) -> Rows:
    return crown_rows(model, [view], [view.calibration.world_from_camera], body)


@pytest.mark.parametrize("pose", [POSE, TURNED], ids=["upright", "upside down"])
def test_a_head_ends_where_the_booth_begins(
    model: BodyModel, body: np.ndarray, pose: np.ndarray
) -> None:
    view = _view(model, body, pose)
    for shift in (-HIGHER, 0.0 * HIGHER, HIGHER):
        found = _reach(model, view, body - shift)
        # Of the pixel, 3 mm wide, half is known.
        assert np.mean(found.residual_m) == pytest.approx(shift[2], abs=0.0015)
        assert (found.direction[:, 2] > 0.95).all()
        assert (body[found.place, 2] > body[:, 2].max() - 0.02).all()


def test_a_camera_says_it_once_however_many_columns_it_has(
    model: BodyModel, body: np.ndarray
) -> None:
    view = _view(model, body)
    once = _reach(model, view, body)
    twice = crown_rows(model, [view, view], [POSE, POSE], body)
    assert len(once.place) > 6
    assert once.weight.sum() == pytest.approx(1.0 / 0.0015**2)
    assert twice.weight.sum() == pytest.approx(2.0 * once.weight.sum())


def test_where_no_booth_is_seen_a_head_is_no_lower_than_its_last_reading(
    model: BodyModel, body: np.ndarray
) -> None:
    view = _view(model, body, walls=False)
    assert 0.001 < np.mean(_reach(model, view, body - HIGHER).residual_m) < 0.0075
    assert not len(_reach(model, view, body + HIGHER).place)
    assert not len(_reach(model, _view(model, body, walls=False, bald=False), body).place)


def test_hair_that_gives_no_reading_is_no_crown(model: BodyModel, body: np.ndarray) -> None:
    assert not len(_reach(model, _view(model, body, bald=False), body).place)


def test_a_camera_on_its_side_has_the_projectors_shadow_over_the_head(
    model: BodyModel, body: np.ndarray
) -> None:
    assert not len(_reach(model, _view(model, body, ROLLED), body).place)


def test_patches_that_are_lost_behind_a_head_do_not_raise_it(
    model: BodyModel, body: np.ndarray
) -> None:
    whole = _view(model, body)
    top = np.argmax(body[:, 2])
    u, v = (int(x) for x in np.rint(project(UPPER, transform(invert(POSE), body[top]))))
    disturbed = whole.depth_m.copy()
    patch = disturbed[v - 6 : v + 2, u - 1 : u + 2]
    patch[patch > 2.0] = 0.0
    found = _reach(model, replace(whole, depth_m=disturbed), body)
    expected = np.mean(_reach(model, whole, body).residual_m)
    assert np.mean(found.residual_m) == pytest.approx(expected, abs=0.0005)


def test_a_stick_above_the_head_is_not_its_end(model: BodyModel, body: np.ndarray) -> None:
    x, y, z = body[np.argmax(body[:, 2])]
    stick = rod((x - 0.3, y, z + 0.03), (x + 0.3, y, z + 0.03), 0.004)
    found = _reach(model, _view(model, body, beside=[stick]), body)
    assert np.mean(found.residual_m) == pytest.approx(0.0, abs=0.0015)


def test_a_bun_on_the_head_is_not_its_end(model: BodyModel, body: np.ndarray) -> None:
    x, y, z = body[np.argmax(body[:, 2])]
    for radius in (0.025, 0.04):
        bun = sphere((x, y + 0.02, z + 0.2 * radius), radius)
        assert not len(_reach(model, _view(model, body, beside=[bun]), body).place)


def test_a_head_beyond_the_image_is_no_crown(model: BodyModel, body: np.ndarray) -> None:
    taller = body * (2.3 / body[:, 2].max())
    assert not len(_reach(model, _view(model, taller), taller).place)


def test_a_bare_cloud_has_no_outline(model: BodyModel, body: np.ndarray) -> None:
    assert not len(crown_rows(model, [], [], body).place)


def test_a_corrected_camera_stands_where_its_points_are_moved_to(
    model: BodyModel, body: np.ndarray
) -> None:
    view = _view(model, body)
    local = (rays(UPPER) * view.depth_m[..., None])[view.depth_m > 0].astype(np.float64)
    points = transform(POSE, local)
    camera = np.zeros(len(points), np.int16)
    cloud = PointCloud(points, points, np.ones(len(points)), camera, ("front-upper",))
    corrections = CameraCorrections.build(cloud, [view]).updated(
        np.array([[0.003, -0.002, 0.001, 0.004, 0.001, -0.002]])
    )
    pose = corrections.poses([view])[0]
    assert np.allclose(transform(pose, local), corrections.apply(points, camera), atol=1e-9)


def test_cameras_are_believed_as_the_calibrations_cloud_is(
    model: BodyModel, body: np.ndarray
) -> None:
    """Poses that are known to 3 mm released cameras whose cloud was known to 0.1 mm."""
    view = _view(model, body)
    calibrated = replace(view.calibration, covariance=np.diag([1.4e-3] * 3 + [3e-3] * 3) ** 2)
    known = replace(view, calibration=calibrated)
    points = np.zeros((1, 3))
    cloud = PointCloud(points, points, np.ones(1), np.zeros(1, np.int16), ("front-upper",))

    def sigma_m(view: CameraView, predicted: PredictedError | None) -> float:
        information = CameraCorrections.build(cloud, [view], predicted).information[0]
        return float(np.sqrt(np.linalg.inv(information)[5, 5]))

    alone = sigma_m(view, None)
    said = PredictedError(1e-3, 5e-4, 1e-4, 1e-3)
    assert sigma_m(known, said) < 1.1 * alone
    assert sigma_m(known, replace(said, normal_rms_m=2e-3)) == pytest.approx(2e-3, rel=0.05)
    assert sigma_m(known, None) == pytest.approx(3e-3, rel=0.05)


def test_shifts_are_those_of_the_middle_of_each_cameras_points(
    model: BodyModel, body: np.ndarray
) -> None:
    """Three cameras, one of which has no points."""
    view = _view(model, body)
    names = ("one", "blind", "other")
    views = [replace(view, name=name) for name in names]
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (1000, 3))
    camera = np.repeat(np.array([0, 2], np.int16), 500)
    cloud = PointCloud(points, points, np.ones(1000), camera, names)
    xi = np.zeros((3, 6))
    xi[0, 3:], xi[2, :3] = (0.003, 0.0, 0.004), (0.0, 0.0, 0.01)
    corrections = CameraCorrections.build(cloud, views).updated(xi)
    shifts = corrections.shifts_m(cloud)
    assert set(shifts) == {"one", "other"}
    assert shifts["one"] == pytest.approx(0.005)
    middle = points[500:].mean(axis=0)
    lever = np.linalg.norm((middle - corrections.eyes[2])[:2])
    assert shifts["other"] == pytest.approx(0.01 * lever, rel=1e-4)
    bare = PointCloud(points, points, np.ones(1000), camera, ())
    assert CameraCorrections.build(bare, []).shifts_m(bare) == {}


def test_the_surface_rises_to_the_crown_that_no_point_lies_on(
    model: BodyModel, body: np.ndarray
) -> None:
    """Points up to 2 cm below the top of a head that is 6 mm higher from the ears up."""
    top = body[:, 2].max()
    share = np.clip((body[:, 2] - (top - 0.10)) / 0.10, 0.0, 1.0)
    higher = body + share[:, None] * HIGHER
    normals = vertex_normals(higher, model.faces)
    seen = higher[:, 2] < top - 0.02
    count = int(seen.sum())
    cloud = PointCloud(
        higher[seen],
        normals[seen],
        np.full(count, 1e-3),
        np.zeros(count, np.int16),
        ("front-upper",),
    )
    view = _view(model, higher)

    def missing(views: list[CameraView]) -> float:
        poses = [view.calibration.world_from_camera for view in views]
        fitted = fit_surface(model, body, cloud, views, poses)
        return float(higher[:, 2].max() - fitted.vertices[:, 2].max())

    assert missing([]) > 0.002
    assert abs(missing([view, view])) < 0.0015


def test_a_head_that_nobody_saw_end_has_a_height_of_its_own_uncertainty(
    model: BodyModel, body: np.ndarray
) -> None:
    """A man came out 14 mm too tall with no wall in range behind his head, and was sure of it."""

    nowhere = np.zeros(model.vertex_count, bool)

    def sigma_m(view: CameraView, fitted: np.ndarray) -> float:
        local = (rays(UPPER) * view.depth_m[..., None])[view.depth_m > 0].astype(np.float64)
        pose = view.calibration.world_from_camera
        return crown_sigma_m(model, [view], [pose], fitted, transform(pose, local), nowhere)

    assert sigma_m(_view(model, body), body) == 0.0
    open_air = _view(model, body, walls=False)
    assert 0.0025 < sigma_m(open_air, body) < 0.005
    too_tall = body + 2.0 * HIGHER * (body[:, 2:] > body[:, 2].max() - 0.1)
    assert sigma_m(open_air, too_tall) == pytest.approx(0.008)
    assert sigma_m(_view(model, body, bald=False), body) == pytest.approx(0.008)


def test_a_scanner_that_sees_the_top_of_a_head_adds_little(
    model: BodyModel, body: np.ndarray
) -> None:
    dense = body[model.faces].mean(axis=1)
    nothing, face = np.zeros(len(body), bool), np.ones(len(body), bool)
    assert crown_sigma_m(model, [], [], body, np.concatenate([body, dense]), nothing) <= 0.003
    low = body[body[:, 2] < 1.2]
    assert crown_sigma_m(model, [], [], body, low, nothing) == pytest.approx(0.03)
    assert crown_sigma_m(model, [], [], body, low, face) == pytest.approx(0.011)


def test_a_column_between_head_and_ear_has_no_outline() -> None:
    """A scan of a head that leant far ended in an error."""
    places = np.array([[10.0, 50.0], [19.5, 50.0], [20.5, 50.0], [30.0, 50.0]])
    columns, rows, _ = _outline(places, np.array([[0, 1], [2, 3]]), 640)
    assert {19, 21} <= set(columns)
    assert 20 not in columns
    assert np.isfinite(rows).all()
