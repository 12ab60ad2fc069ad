"""Averaging, cleaning and merging a bundle's frames."""

import json
import shutil
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest

from station.core.bundle import read_bundle
from station.core.config import Volume
from station.core.errors import InputError
from station.core.kinect_v1 import RANDOM_SIGMA, STEP
from station.core.lens import project, rays
from station.core.rig import CameraCalibration, PredictedError
from station.simulation.scene import Mesh, box, chair, default_rig, load_mesh
from station.simulation.sensor import SimulatedBooth, render_bundle
from station.simulation.violations import FROZEN
from workers.cloud.average import average
from workers.cloud.observed import LOWERED_FLOOR, RAISED_FLOOR, TWO_PEOPLE
from workers.cloud.one_person import cells_of
from workers.cloud.people import count_people
from workers.cloud.points import normals, within
from workers.cloud.preprocess import filtered, preprocess

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def test_the_mean_leaves_out_what_flies() -> None:
    stack = np.full((10, 2, 2), 15_000, np.uint16)
    stack[3] = 22_000
    stack[4] = 0
    averaged = average(stack, 1e-4)
    assert np.allclose(averaged.depth_m, 1.5)
    assert (averaged.count == 8).all()


def test_a_flickering_pixel_is_no_reading() -> None:
    stack = np.zeros((10, 1, 2), np.uint16)
    stack[:3, 0, 0] = 15_000
    stack[:5, 0, 1] = 15_000
    averaged = average(stack, 1e-4)
    assert averaged.depth_m[0, 0] == 0.0
    assert averaged.depth_m[0, 1] > 0.0


@pytest.mark.parametrize("frames", [1, 4, 9])
def test_averages_are_what_their_definition_says(frames: int) -> None:
    """No median is computed where the extremes agree; the result is the same."""
    rng = np.random.default_rng(frames)
    spread = rng.choice([2.0, 60.0, 400.0], (1, 8, 40))
    stack = np.round(15_000 + spread * rng.standard_normal((frames, 8, 40))).astype(np.uint16)
    stack[rng.random(stack.shape) < 0.2] = 0
    averaged = average(stack, 1e-4)
    least = int(np.ceil(0.4 * frames))
    for y, x in np.ndindex(8, 40):
        values = 1e-4 * stack[:, y, x].astype(float)
        readings = values[values > 0.0]
        if len(readings) < least:
            assert averaged.depth_m[y, x] == averaged.count[y, x] == 0
            continue
        middle = np.median(readings)
        gate = (3.0 * RANDOM_SIGMA + STEP) * middle**2
        good = (values > 0.0) & (np.abs(values - middle) <= gate)
        stray = len(readings) - good.sum() >= 2
        assert averaged.unsettled_m[y, x] == pytest.approx(middle if stray else 0.0)
        assert averaged.count[y, x] == (good.sum() if good.sum() >= least else 0)
        if good.sum() >= least:
            assert averaged.depth_m[y, x] == pytest.approx(values[good].mean(), rel=1e-5)


def _box_by_matrices(
    camera: CameraCalibration, depth_m: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    pose = camera.world_from_camera
    world = (rays(camera) * depth_m[..., None]).astype(float) @ pose[:3, :3].T + pose[:3, 3]
    return np.asarray((depth_m > 0) & (world > low).all(axis=2) & (world < high).all(axis=2))


def test_the_volume_is_a_box_of_the_world() -> None:
    rng = np.random.default_rng(0)
    low, high = np.array([-0.6, -0.5, 0.3]), np.array([0.5, 0.6, 1.7])
    for camera in default_rig().cameras.values():
        depth = rng.uniform(0.5, 3.0, (camera.height, camera.width)).astype(np.float32)
        depth[rng.random(depth.shape) < 0.1] = 0.0
        depth[0, 0] = np.nan
        found = within(rays(camera), depth, camera.world_from_camera, low, high)
        expected = _box_by_matrices(camera, depth, low, high)
        # A point on a face may fall to either side of it.
        assert found.any()
        assert (found != expected).sum() < 5


def test_warming_up_compiles_what_a_scan_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read-only array is another type to the compiler than the same that can be written to."""
    module = import_module("workers.cloud.preprocess")
    called: list[tuple[numba.types.Type, ...]] = []

    def watched(*arguments: np.ndarray) -> np.ndarray:
        called.append(tuple(numba.typeof(argument) for argument in arguments))
        return np.asarray(within(*arguments))

    monkeypatch.setattr(module, "within", watched)
    module.warm_up()
    camera = default_rig().cameras["front-upper"]
    depth = camera.depth_correction.apply(np.full((camera.height, camera.width), 1.5, np.float32))
    module._in_volume(camera, depth.astype(np.float32), Volume())
    assert called[1] == called[0]


@pytest.mark.parametrize("count", [1, 2, 5000])
def test_cells_are_those_of_a_grid_with_an_empty_border(count: int) -> None:
    points = np.random.default_rng(count).uniform(-1.0, 2.0, (count, 3))
    points[-1] = points.min(axis=0)
    points[-1] += (0.05, 0.10, 0.0)  # on the border of a cell
    cell, shape = cells_of(points, 0.05)
    along = ((points - (points.min(axis=0) - 2 * 0.05)) / 0.05).astype(int)
    assert (np.stack(np.unravel_index(cell, shape), axis=1) == along).all()
    assert (along.min(axis=0) >= 1).all()
    assert (along.max(axis=0) < np.array(shape) - 1).all()


def test_projection_inverts_the_rays() -> None:
    camera = default_rig().cameras["front-upper"]
    points = 1.7 * rays(camera)[100:110, 200:210].reshape(-1, 3).astype(np.float64)
    v, u = np.meshgrid(np.arange(100, 110), np.arange(200, 210), indexing="ij")
    assert np.allclose(project(camera, points), np.stack([u.ravel(), v.ravel()], 1), atol=1e-3)


def test_normals_face_the_camera() -> None:
    camera = default_rig().cameras["front-upper"]
    depth = np.full((camera.height, camera.width), 1.5, np.float32)
    directions, valid = normals(rays(camera) * depth[..., None], depth)
    assert valid[2:-2, 2:-2].all()
    assert np.allclose(directions[240, 320], (0, 0, -1), atol=1e-3)


def test_normals_reach_up_to_where_a_surface_ends() -> None:
    """A plane at 60 degrees; above it nothing, beside it a shadow, below it another surface that
    ends below."""
    camera = default_rig().cameras["front-upper"]
    ray = rays(camera)
    normal = np.array([0.0, -np.sin(np.radians(60.0)), -np.cos(np.radians(60.0))])
    depth = (-0.75 / (ray @ normal)).astype(np.float32)
    depth[280:] += 0.2
    depth[:200] = 0.0
    depth[360:] = 0.0
    depth[:, :300] = 0.0
    directions, valid = normals(ray * depth[..., None], depth)
    assert valid[200:278, 302:400].all()
    assert not valid[:200].any()
    assert not valid[:, :302].any()
    assert not valid[278:282].any()
    assert not valid[358:].any()
    assert np.allclose(directions[200:278, 302:400], normal, atol=2e-3)


def test_noise_that_stays_from_frame_to_frame_is_noticed(tmp_path: Path) -> None:
    """Its variance is two fifths of 1.425e-3 z^2 squared: 2.6 mm at 1.7 m."""
    body = load_mesh(BODIES / "ann.npz")
    noise_m = {
        switches: preprocess(
            read_bundle(
                render_bundle(
                    body,
                    tmp_path / "-".join(("scan", *switches)),
                    SimulatedBooth(seed=1, violations=frozenset(switches)),
                )
            )
        ).cloud.excess_noise_m
        for switches in ((), (FROZEN,))
    }
    assert noise_m[()] < 0.4e-3
    assert noise_m[FROZEN,] == pytest.approx(2.6e-3, rel=0.15)


def test_the_filter_hardly_bends_skin_at_the_border_of_an_image() -> None:
    # Skin that tilts away by 3 mm a pixel; with a mirror at the border 3.1 and 0.9 mm.
    whole = np.tile(1.7 + 0.003 * np.arange(80, dtype=np.float32), (60, 1))
    off_m = np.abs(filtered(whole[:, 20:], 1.7) - filtered(whole, 1.7)[:, 20:])[10:-10]
    assert off_m[:, 0].max() < 0.0017
    assert off_m[:, 1].max() < 0.0005
    assert off_m[:, 3:].max() < 1e-5


def test_the_filter_is_wider_before_a_noisy_sensor() -> None:
    noise = np.random.default_rng(2).standard_normal((60, 60))
    depth_m = (1.7 + 4e-3 * noise).astype(np.float32)
    left = [float(filtered(depth_m, 1.7, ratio)[20:40, 20:40].std()) for ratio in (1.0, 4.0, 6.0)]
    assert left[1] < 0.8 * left[0]
    assert left[2] < left[1]
    # However noisy an image is, its filter costs no more, and reaches no farther.
    assert np.array_equal(filtered(depth_m, 1.7, 100.0), filtered(depth_m, 1.7, 6.0))


def test_a_flickering_pixel_of_a_covered_camera_is_no_surface(bundle: Path, tmp_path: Path) -> None:
    """The noise of no point was not a number, and the fit ended with Python's words."""
    covered = shutil.copytree(bundle, tmp_path / "covered")
    image = np.zeros((480, 640), np.uint16)
    image[240, 320] = 17_000
    for record in read_bundle(covered).frames["back-lower"]:
        assert cv2.imwrite(str(covered / record.file), image)
    scan = preprocess(read_bundle(covered))
    assert np.isfinite(scan.cloud.excess_noise_m)
    assert ("camera-blind", "back-lower") in [(f.code, f.camera) for f in scan.findings]


def test_a_person_who_moved_is_reported_in_millimetres(tmp_path: Path) -> None:
    body = load_mesh(BODIES / "ann.npz")
    booth = SimulatedBooth(seed=1, sway_m=0.0)
    first = render_bundle(body, tmp_path / "first", booth)
    later = Mesh(body.vertices + np.array([0.0, 0.03, 0.0]), body.faces)
    second = render_bundle(later, tmp_path / "second", booth)
    for index in range(6, 10):
        for camera in booth.rig.cameras:
            name = f"depth/{camera}/{index:03d}.png"
            shutil.copy(second / name, first / name)
    found = preprocess(read_bundle(first)).findings
    moved = [finding for finding in found if finding.code == "motion"]
    assert moved
    assert moved[0].value == pytest.approx(0.03, abs=0.015)
    assert "the person moved" in moved[0].message


def test_a_large_step_is_never_missed(tmp_path: Path) -> None:
    """Readings that moved by 10 cm were dropped as outliers, and the motion with them."""
    body = load_mesh(BODIES / "ann.npz")
    booth = SimulatedBooth(seed=1, sway_m=0.0)
    first = render_bundle(body, tmp_path / "first", booth)
    assert preprocess(read_bundle(first)).findings == ()
    later = Mesh(body.vertices + np.array([0.0, 0.1, 0.0]), body.faces)
    second = render_bundle(later, tmp_path / "second", booth)
    for index in (9, 8):
        for camera in booth.rig.cameras:
            name = f"depth/{camera}/{index:03d}.png"
            shutil.copy(second / name, first / name)
    found = preprocess(read_bundle(first)).findings
    assert {finding.code for finding in found} == {"motion"}


def test_what_a_calibration_says_of_its_errors_goes_with_the_scan(bundle: Path) -> None:
    read = read_bundle(bundle)
    said = PredictedError(0.002, 0.003, 0.0004, 0.0005)
    told = replace(read, rig=replace(read.rig, predicted=said))
    assert preprocess(told).predicted == said
    assert preprocess(read).predicted is None


def test_a_mat_that_was_not_there_at_the_calibration_is_named(tmp_path: Path) -> None:
    """Noise lifts some of it above the floor's clearance, and nothing matched a body any more."""
    body = load_mesh(BODIES / "ann.npz")
    standing = Mesh(body.vertices + np.array([0.0, 0.0, 0.008]), body.faces)
    booth = SimulatedBooth(seed=3, clutter=[box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.008))])
    scan = preprocess(read_bundle(render_bundle(standing, tmp_path / "mat", booth)))
    (finding,) = scan.findings
    assert finding.code == RAISED_FLOOR
    assert "take mats away" in finding.message
    level = (scan.cloud.points[:, 2] < 0.015) & (scan.cloud.normals[:, 2] > 0.9)
    assert level.sum() < 30


@pytest.mark.parametrize("lower_m", [0.01, 0.03])
def test_a_calibration_that_is_too_low_is_named(bundle: Path, lower_m: float) -> None:
    """Heights were too small by as much, to +-1.3 mm, with "ok"."""
    read = read_bundle(bundle)
    assert preprocess(read).findings == ()
    drop = np.eye(4)
    drop[2, 3] = -lower_m
    cameras = {
        name: replace(camera, world_from_camera=drop @ camera.world_from_camera)
        for name, camera in read.rig.cameras.items()
    }
    (finding,) = preprocess(replace(read, rig=replace(read.rig, cameras=cameras))).findings
    assert finding.code == LOWERED_FLOOR
    assert finding.value == pytest.approx(-lower_m, abs=0.003)


def test_nobody_in_the_volume_is_an_error(bundle: Path) -> None:
    with pytest.raises(InputError, match="the booth is empty"):
        preprocess(read_bundle(bundle), Volume(min_m=(1.2, -0.5, 0.5), max_m=(1.8, 0.5, 2.0)))


def test_the_cloud_is_one_person_without_floor_and_walls(bundle: Path) -> None:
    scan = preprocess(read_bundle(bundle))
    assert scan.findings == ()
    assert scan.cloud.points[:, 2].min() > 0.01
    assert np.abs(scan.cloud.points[:, :2]).max() < 1.0
    assert np.allclose(np.linalg.norm(scan.cloud.normals, axis=1), 1.0, atol=1e-5)
    assert len(scan.cloud) > 100_000
    assert set(scan.cloud.camera) == {0, 1, 2, 3}
    for view in scan.views:
        assert not (view.person & view.background).any()


def _side_by_side(apart_m: float) -> Mesh:
    """Two bodies in one mesh."""
    ann, cleo = load_mesh(BODIES / "ann.npz"), load_mesh(BODIES / "cleo.npz")
    aside = np.array([apart_m / 2, 0.0, 0.0])
    left, right = ann.vertices - aside, cleo.vertices + aside
    return Mesh(np.concatenate([left, right]), np.concatenate([ann.faces, cleo.faces + len(left)]))


@pytest.mark.parametrize("apart_m", [0.5, 0.7])
def test_two_people_whose_arms_touch_are_two(tmp_path: Path, apart_m: float) -> None:
    """They are one piece of cloud, and were one person in silence."""
    booth = SimulatedBooth(seed=1, sway_m=0.0)
    folder = render_bundle(_side_by_side(apart_m), tmp_path / "two", booth, frames=3)
    found = preprocess(read_bundle(folder)).findings
    assert TWO_PEOPLE in {finding.code for finding in found}


def test_a_chair_apart_is_no_second_person(tmp_path: Path) -> None:
    body = load_mesh(BODIES / "ann.npz")
    booth = SimulatedBooth(seed=1, sway_m=0.0, clutter=chair((0.75, 0.45)))
    scan = preprocess(read_bundle(render_bundle(body, tmp_path / "chair", booth, frames=3)))
    assert scan.findings == ()
    assert scan.cloud.points[:, 0].max() < body.vertices[:, 0].max() + 0.02


def test_dark_briefs_do_not_cut_a_body_in_two(tmp_path: Path) -> None:
    """They give no reading; only the larger half was kept, and the rest called unseen."""
    body = load_mesh(BODIES / "ann.npz")
    middle = body.vertices[body.faces].mean(axis=1)
    briefs = (middle[:, 2] > 0.72) & (middle[:, 2] < 0.96) & (np.abs(middle[:, 0]) < 0.23)
    booth = SimulatedBooth(seed=1, sway_m=0.0, clutter=chair((0.75, 0.45)))
    dark = Mesh(body.vertices, body.faces, briefs)
    scan = preprocess(read_bundle(render_bundle(dark, tmp_path / "briefs", booth, frames=3)))
    low, high = scan.cloud.points.min(axis=0), scan.cloud.points.max(axis=0)
    assert scan.findings == ()
    assert low[2] < 0.1
    assert high[2] > body.vertices[:, 2].max() - 0.05
    assert high[0] < body.vertices[:, 0].max() + 0.02


@pytest.mark.parametrize(
    ("low", "high"),
    [((-0.1, -0.1, 1.93), (0.1, 0.1, 2.05)), ((0.38, -0.2, 0.0), (0.48, 0.05, 0.45))],
    ids=["lamp above the head", "stool below the hand"],
)
def test_a_whole_body_is_not_added_to(
    tmp_path: Path, low: tuple[float, float, float], high: tuple[float, float, float]
) -> None:
    body = load_mesh(BODIES / "ann.npz")
    booth = SimulatedBooth(seed=1, sway_m=0.0, clutter=(box(low, high),))
    scan = preprocess(read_bundle(render_bundle(body, tmp_path / "beside", booth, frames=3)))
    assert scan.findings == ()
    points = scan.cloud.points
    inside = (points > np.array(low) - 0.01) & (points < np.array(high) + 0.01)
    assert not inside.all(axis=1).any()


def test_a_raised_hand_is_no_second_head() -> None:
    rng = np.random.default_rng(0)
    trunk = rng.uniform((-0.2, -0.12, 0.0), (0.2, 0.12, 1.45), (20_000, 3))
    head = rng.uniform((-0.08, -0.1, 1.45), (0.08, 0.1, 1.75), (3000, 3))
    arm = rng.uniform((0.2, -0.04, 1.3), (0.5, 0.04, 1.4), (2000, 3))
    hand = rng.uniform((0.42, -0.04, 1.4), (0.5, 0.04, 1.75), (1000, 3))
    assert count_people(np.concatenate([trunk, head, arm, hand])) == 1


def test_frames_that_all_cameras_lost_are_reported(tmp_path: Path) -> None:
    body = load_mesh(BODIES / "ann.npz")
    booth = SimulatedBooth(seed=1, sway_m=0.0)
    folder = render_bundle(body, tmp_path / "few", booth)
    manifest = json.loads((folder / "bundle.json").read_text())
    for camera in manifest["cameras"].values():
        camera["frames"] = camera["frames"][::3]
    (folder / "bundle.json").write_text(json.dumps(manifest))
    found = preprocess(read_bundle(folder)).findings
    assert [finding.camera for finding in found] == list(booth.rig.cameras)
    assert all("gave 4 of 10 frames" in finding.message for finding in found)
