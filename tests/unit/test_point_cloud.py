"""Reading a bare cloud: the same points each time, and the way back to the scanner's frame."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from station.core.errors import InputError
from station.core.geometry import so3_exp
from workers.cloud import cloud_file
from workers.cloud.bare import floor_sigma_m, roughness, several_people
from workers.cloud.cloud_file import read_cloud
from workers.cloud.floor import Z_UP
from workers.cloud.observed import PointCloud

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def _written(path: Path, points: np.ndarray) -> Path:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    o3d.io.write_point_cloud(str(path), cloud)
    return path


def test_a_cloud_goes_back_to_where_it_was(tmp_path: Path) -> None:
    points = _person(np.random.default_rng(1)) + np.array([1.0, 5.0, -3.0])
    cloud = read_cloud(_written(tmp_path / "a.ply", points), "z")
    assert np.allclose(cloud.points + cloud.origin_m, points, atol=1e-6)
    assert cloud.points[:, 2].min() == 0.0
    turned = read_cloud(_written(tmp_path / "b.ply", points[:, [0, 2, 1]] * (1, 1, -1)), "y")
    assert np.allclose(turned.points + turned.origin_m, points, atol=1e-6)


def test_a_large_cloud_is_thinned_the_same_way_each_time(tmp_path: Path) -> None:
    points = np.random.default_rng(1).uniform(0.0, 1.0, (260_000, 3))
    path = _written(tmp_path / "large.ply", points)
    first, again = read_cloud(path, "z"), read_cloud(path, "z")
    assert len(first) == cloud_file._MAX_POINTS
    assert np.array_equal(first.points, again.points)


@pytest.mark.parametrize(("low_m", "floor_m"), [(0.011, 0.0), (0.4, 0.4), (-0.9, -0.9)])
def test_soles_that_no_camera_saw_are_not_the_floor(
    tmp_path: Path, low_m: float, floor_m: float
) -> None:
    """Our own cloud.ply begins a centimetre above the floor it stands on."""
    points = np.random.default_rng(1).uniform((-0.3, -0.2, 0.0), (0.3, 0.2, 1.7), (2000, 3))
    points[:, 2] += low_m - points[:, 2].min()
    cloud = read_cloud(_written(tmp_path / "cloud.ply", points), "z")
    assert cloud.origin_m[2] == pytest.approx(floor_m, abs=1e-6)


@pytest.mark.parametrize("below_m", [0.01, 0.02, 0.05, 0.3])
def test_a_stray_point_below_the_soles_is_none_of_them(tmp_path: Path, below_m: float) -> None:
    """Heights were too large by as much, to +-1.3 mm, with "ok"."""
    points = _sampled("ann", 20_000)[0] + np.array([0.0, 0.0, 0.5])
    low_m = float(points[:, 2].min())
    stray = points[[np.argmin(points[:, 2])]] - (0.0, 0.0, below_m)
    cloud = read_cloud(_written(tmp_path / "a.ply", np.concatenate([points, stray])), "z")
    assert cloud.origin_m[2] == pytest.approx(low_m, abs=1e-6)


@pytest.mark.parametrize(
    ("count", "depth_m", "words"), [(3, 0.3, "a body needs"), (3000, 0.0, "is flat")]
)
def test_what_can_be_no_body_is_refused(
    tmp_path: Path, count: int, depth_m: float, words: str
) -> None:
    points = np.random.default_rng(0).uniform(0.0, (0.5, depth_m, 1.7), (count, 3))
    path = tmp_path / "odd.ply"
    o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    with pytest.raises(InputError, match=words):
        read_cloud(path, "z")


def _person(rng: np.random.Generator, count: int = 8000) -> np.ndarray:
    """A pillar of a person's size, on both of its feet."""
    angle, height = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.0, 1.75, count)
    return np.column_stack([0.18 * np.cos(angle), 0.12 * np.sin(angle), height])


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_points_without_a_reading_are_left_out(tmp_path: Path, kind: str) -> None:
    """Clouds of a depth image's pixels, NaN where it has no reading, were refused."""
    points = _person(np.random.default_rng(3))
    holed = np.insert(points, [5, 70], [[np.nan, np.nan, np.nan], [0.1, np.nan, 1.0]], axis=0)
    whole = read_cloud(_written(tmp_path / f"a.{kind}", points), "z")
    cloud = read_cloud(_written(tmp_path / f"b.{kind}", holed), "z")
    assert np.array_equal(cloud.points, whole.points)
    assert (whole.blank, cloud.blank) == (0, 2)
    points[7, 1] = np.inf
    with pytest.raises(InputError, match=r"1 of the 8000 points .* are infinite"):
        read_cloud(_written(tmp_path / f"c.{kind}", points), "z")


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1000.0, "looks like millimetres; use --unit mm"),
        (100.0, "looks like centimetres; use --unit cm"),
        (1 / 0.0254, "looks like inches; use --unit in"),
    ],
)
def test_other_units_are_named(tmp_path: Path, scale: float, words: str) -> None:
    path = _written(tmp_path / "a.ply", scale * _person(np.random.default_rng(2)))
    with pytest.raises(InputError, match=words):
        read_cloud(path, "z")


@pytest.mark.parametrize("stated", ["x", "y", "z"])
@pytest.mark.parametrize(("up", "columns"), [("x", [2, 0, 1]), ("y", [0, 2, 1]), ("z", [0, 1, 2])])
def test_the_axis_that_points_up_is_named(
    tmp_path: Path, stated: str, up: str, columns: list[int]
) -> None:
    path = _written(tmp_path / "a.ply", _person(np.random.default_rng(2))[:, columns])
    if stated != up:
        with pytest.raises(InputError, match=rf"lying down\? .* points up: --up {up}"):
            read_cloud(path, stated)
    assert np.ptp(read_cloud(path, up).points[:, 2]) == pytest.approx(1.75, abs=0.01)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_axis_may_point_down(tmp_path: Path, axis: int) -> None:
    """Camera frames have y down: no --up turned their clouds onto the feet."""
    upright = np.roll(_person(np.random.default_rng(2)), axis - 2, axis=1)
    up = "xyz"[axis]
    cloud = read_cloud(_written(tmp_path / "a.ply", upright), up)
    turned = read_cloud(_written(tmp_path / "b.ply", -upright), f"-{up}")
    assert np.allclose(np.sort(turned.points[:, 2]), np.sort(cloud.points[:, 2]), atol=1e-5)
    assert np.linalg.det(Z_UP[f"-{up}"]) == pytest.approx(1.0)


def test_two_people_are_told_as_such(tmp_path: Path) -> None:
    """Only what did not match a body was told: the left thigh, the head, a lean."""
    first, second = (_person(np.random.default_rng(seed)) for seed in (2, 3))
    alone = read_cloud(_written(tmp_path / "a.ply", first), "z")
    both = np.concatenate([first, second + np.array([0.7, 0.0, 0.0])])
    (found,) = several_people(read_cloud(_written(tmp_path / "b.ply", both), "z"))
    assert several_people(alone) == ()
    assert found.message.startswith("two people")


@pytest.mark.parametrize("length", [0.0, 10.0, np.nan])
def test_normals_that_are_no_directions_are_estimated(tmp_path: Path, length: float) -> None:
    points = _person(np.random.default_rng(2))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(np.tile([0.0, 0.0, length], (len(points), 1)))
    o3d.io.write_point_cloud(tmp_path / "a.ply", cloud)
    normals = read_cloud(tmp_path / "a.ply", "z").normals
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.abs(normals[:, 2]).mean() < 0.3


def test_a_point_that_is_repeated_counts_once(tmp_path: Path) -> None:
    """40 000 points in one place took 13 s, 250 000 ten minutes."""
    person = _person(np.random.default_rng(2))
    points = np.concatenate([person, np.tile(person[:1], (250_000 - len(person), 1))])
    assert len(read_cloud(_written(tmp_path / "a.ply", points), "z")) == len(person)
    with pytest.raises(InputError, match="has 1 different points; a body needs"):
        read_cloud(_written(tmp_path / "b.ply", points[-40_000:]), "z")


def test_a_cloud_in_millimetres_is_read_as_such(tmp_path: Path) -> None:
    points = _person(np.random.default_rng(2))
    path = _written(tmp_path / "a.ply", 1000.0 * points)
    assert np.ptp(read_cloud(path, "z", "mm").points[:, 2]) == pytest.approx(1.75, abs=0.01)


def test_the_floor_and_what_stands_on_it_are_taken_away(tmp_path: Path) -> None:
    """A slanted floor 0.4 m below the scanner's origin, and a stool in the corner."""
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(-1.5, 1.5, (20_000, 2)), np.zeros(20_000)])
    stool = rng.uniform((1.0, 1.0, 0.0), (1.3, 1.3, 0.45), (2000, 3))
    points = np.concatenate([_person(rng), floor, stool])
    points[:, 2] += 0.01 * points[:, 0] - 0.4 + 0.002 * rng.standard_normal(len(points))
    cloud = read_cloud(_written(tmp_path / "a.ply", points), "z")
    assert 7500 < len(cloud) <= 8000
    assert np.abs(cloud.points[:, :2]).max() < 0.2
    assert cloud.points[:, 2].max() == pytest.approx(1.75, abs=0.01)
    assert cloud.origin_m[2] == pytest.approx(-0.4, abs=0.005)


def test_one_of_two_people_on_a_floor_is_not_chosen(tmp_path: Path) -> None:
    """One of them was measured, with "ok"; a wall and a pole beside the person are none."""
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(-1.5, 1.5, (20_000, 2)), np.zeros(20_000)])
    wall = rng.uniform((-0.8, 1.2, 0.0), (0.8, 1.21, 2.0), (7000, 3))
    pole = rng.uniform((1.0, -1.0, 0.0), (1.05, -0.95, 2.0), (7000, 3))
    alone = np.concatenate([_person(rng), floor, wall, pole])
    cloud = read_cloud(_written(tmp_path / "a.ply", alone), "z")
    assert len(cloud) <= 8000
    assert several_people(cloud) == ()
    both = np.concatenate([alone, _person(rng, 6000) + np.array([0.9, -0.3, 0.0])])
    (found,) = several_people(read_cloud(_written(tmp_path / "b.ply", both), "z"))
    assert found.message.startswith("two people")


@pytest.mark.parametrize("tilt_deg", [2.0, 4.0, 10.0])
def test_a_tilted_floor_is_named(tmp_path: Path, tilt_deg: float) -> None:
    """It was left in the cloud, and the verdict spoke of the person's front."""
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(-1.0, 1.0, (20_000, 2)), np.zeros(20_000)])
    turn = so3_exp([np.radians(tilt_deg), 0.0, 0.0])
    points = np.concatenate([_person(rng), floor]) @ turn.T
    with pytest.raises(InputError, match=f"its floor is tilted by {tilt_deg:.0f} degrees"):
        read_cloud(_written(tmp_path / "a.ply", points), "z")


def test_a_level_plane_is_no_body(tmp_path: Path) -> None:
    """It has no points below its lowest ones, where a floor was searched for."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (3000, 2)), np.zeros(3000)])
    with pytest.raises(InputError, match="is flat; a body has a front and a back"):
        read_cloud(_written(tmp_path / "a.ply", points), "z")


def test_a_small_level_floor_is_not_tilted(tmp_path: Path) -> None:
    """Noise spread it over several bands: "its floor is tilted by 0 degrees"."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        floor = np.column_stack([rng.uniform(-0.4, 0.4, (768, 2)), rng.normal(0.0, 8e-3, 768)])
        points = np.concatenate([_person(rng), floor])
        read_cloud(_written(tmp_path / "a.ply", points), "z")


def test_a_person_without_a_floor_keeps_all_points(tmp_path: Path) -> None:
    points = _person(np.random.default_rng(4))
    assert len(read_cloud(_written(tmp_path / "a.ply", points), "z")) == len(points)


def test_normals_between_limbs_point_outwards(tmp_path: Path) -> None:
    """Skin between limbs, where another limb lies behind it and before it, is oriented too."""
    points, directions = _sampled("ann", 20_000)
    bare = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.io.write_point_cloud(tmp_path / "bare.ply", bare)
    normals = read_cloud(tmp_path / "bare.ply", "z").normals
    outwards = np.einsum("ni,ni->n", normals, directions) > 0.0
    assert outwards.mean() > 0.96


def _sampled(name: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a body's skin, and its normals there."""
    body = np.load(BODIES / f"{name}.npz")
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(body["vertices"]), o3d.utility.Vector3iVector(body["faces"])
    )
    surface.compute_triangle_normals()
    o3d.utility.random.seed(5)
    sampled = surface.sample_points_uniformly(count, use_triangle_normal=True)
    return np.asarray(sampled.points), np.asarray(sampled.normals)


def test_noise_widens_heights_and_is_named(tmp_path: Path) -> None:
    """2 mm of it put the floor 3 mm too low, 3 mm took girths with them, with "ok"."""
    points = _sampled("ann", 40_000)[0]
    rng = np.random.default_rng(6)

    def read(noise_m: float) -> PointCloud:
        noisy = points + rng.normal(0.0, noise_m, points.shape)
        return read_cloud(_written(tmp_path / f"{noise_m}.ply", noisy), "z")

    assert floor_sigma_m(read(0.0)) < 5e-4
    slight, strong = read(0.0015), read(0.003)
    assert slight.scatter_m == pytest.approx(0.0014, abs=2e-4)
    assert floor_sigma_m(slight) > 0.0015
    assert roughness(slight) == ()
    (finding,) = roughness(strong)
    assert finding.message.startswith("the points scatter by 2.6 mm about the skin")
    few = read_cloud(_written(tmp_path / "few.ply", points[:1600]), "z")
    assert roughness(few)


@pytest.mark.parametrize("mat_m", [0.003, 0.008, -0.01])
def test_a_person_stands_on_what_lies_around_the_feet(tmp_path: Path, mat_m: float) -> None:
    """The plane of the whole floor lies below a mat: heights were 2 to 7 mm too large."""
    rng = np.random.default_rng(8)
    floor = np.column_stack([rng.uniform(-1.0, 1.0, (40_000, 2)), rng.normal(0.0, 0.001, 40_000)])
    floor[(np.abs(floor[:, :2]) < 0.4).all(axis=1), 2] += mat_m
    body = _sampled("ann", 20_000)[0] + np.array([0.0, 0.0, mat_m])
    cloud = read_cloud(_written(tmp_path / "a.ply", np.concatenate([body, floor])), "z")
    assert cloud.origin_m[2] == pytest.approx(mat_m, abs=0.001)
