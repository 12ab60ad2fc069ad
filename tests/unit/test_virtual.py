"""The virtual Kinect: what it shows, its noise, its clock, and its recordings."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
import synthetic_calibration as synthetic

from station.core.errors import DriverError, FormatError, InputError
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE, depth_m_of_raw, depth_of_raw
from station.sensors.freenect import FreenectCamera
from station.sensors.recorded import RecordedCamera
from station.sensors.recording import check_recording, read_raw, write_recording
from station.sensors.registry import make_driver
from station.simulation.driver import SimulatedCamera
from station.simulation.noise import UnitError, axial_sigma_m, raw_from_depth
from station.simulation.scene import (
    VirtualScene,
    box,
    default_rig,
    load_mesh,
    sphere,
    uneven,
)
from station.simulation.sensor import TICK_HZ, SimulatedBooth, VirtualCamera, recorded_frames

BODIES = Path(__file__).parents[2] / "station/simulation/bodies"


def test_raw_values_and_depths_are_inverse() -> None:
    raw = np.arange(500, 1000)
    assert np.array_equal(raw_from_depth(depth_m_of_raw(raw).astype(np.float32)), raw)
    assert TABLE[2047] == 0
    assert TABLE[0] > 0


def test_a_frame_of_any_height_is_converted_whatever_its_higher_bits() -> None:
    raw = np.arange(100 * 41, dtype=np.uint16).reshape(100, 41) * 16
    assert np.array_equal(depth_of_raw(raw), TABLE[raw % 2048])


def test_an_off_centre_ball_stands_where_it_is() -> None:
    """A ray caster whose pictures were turned by 180 degrees went unnoticed with a centred body."""
    center = np.array([0.25, -0.1, 1.7])
    rig = default_rig()
    booth = SimulatedBooth(rig=rig, walls=False, clutter=[sphere(center, 0.1)])
    for name, seen in (("front-upper", True), ("back-upper", True)):
        frame = next(VirtualCamera(booth, name, None).frames(1))
        v, u = np.nonzero(TABLE[frame.raw])
        assert bool(len(v)) is seen
        camera = rig.cameras[name]
        local = np.linalg.inv(camera.world_from_camera) @ np.append(center, 1.0)
        pixel = camera.K @ (local[:3] / local[2])
        assert np.hypot(np.median(u) - pixel[0], np.median(v) - pixel[1]) < 6.0
        depth = np.median(TABLE[frame.raw][v, u]) * DEPTH_SCALE_M
        assert local[2] - 0.1 < depth < local[2]


def test_the_same_seed_gives_the_same_frames() -> None:
    booth = SimulatedBooth(walls=False, clutter=[sphere((0, 0, 1.5), 0.2)])
    first, again = (
        [frame.raw for frame in VirtualCamera(booth, "front-upper", None).frames(3)]
        for _ in range(2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first[0], first[1])


def test_the_random_error_grows_as_published() -> None:
    """sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 (Nguyen et al. 2012), here beside quantisation."""
    booth = SimulatedBooth(walls=False, clutter=[sphere((0, 0, 1.47), 0.3)])
    frames = VirtualCamera(booth, "front-upper", None).frames(30)
    stack = np.stack([TABLE[frame.raw] for frame in frames]) * DEPTH_SCALE_M
    nearest = stack[:, 238:242, 318:322].reshape(30, -1)
    z = nearest.mean()
    step = z**2 / (8 * 585 * 0.075)
    expected = np.hypot(0.0012 + 0.0019 * (z - 0.4) ** 2, step / np.sqrt(12))
    assert nearest.std(axis=0).mean() == pytest.approx(expected, rel=0.35)


def test_a_units_depth_error_is_of_the_form_that_is_corrected() -> None:
    error = UnitError(0.012, (0.2, -0.1), gain=1e-3, curvature=3e-3)
    for true_m in (1.0, 1.7, 2.4):
        image = np.full((48, 64), true_m, np.float32)
        image[0, 0] = 0.0
        measured = error.apply(image)
        assert measured[0, 0] == 0.0
        away = synthetic.true_correction(error).apply(measured) - image
        assert np.abs(away[1:]).max() < 4e-4
        assert np.abs(measured - image)[1:].max() > 3e-3


def test_an_uneven_floor_has_soft_bumps() -> None:
    flat = box((-2.0, -2.0, -0.05), (2.0, 2.0, 0.0))
    floor = uneven(flat, 2, 5e-4, np.random.default_rng(0))
    top = floor.vertices[floor.vertices[:, 2] > -0.02]
    inside = top[np.abs(top[:, :2]).max(axis=1) < 1.99]
    assert inside[:, 2].std() == pytest.approx(5e-4, rel=0.2)
    scene = VirtualScene([floor])
    camera = default_rig().cameras["front-lower"]
    view, plane = (s.view(camera, camera.world_from_camera) for s in (scene, VirtualScene([flat])))
    seen = (view.depth_m > 0) & (plane.depth_m > 0)
    slope = np.diff(np.where(seen, view.depth_m - plane.depth_m, 0.0), axis=1)
    assert 0.0 < np.abs(slope[seen[:, 1:] & seen[:, :-1]]).max() < 2e-3
    assert uneven(flat, 2, 0.0, np.random.default_rng(0)) is flat


def test_grazing_surfaces_are_noisier() -> None:
    depth = np.full(3, 1.6, np.float32)
    sigma = axial_sigma_m(depth, np.radians([0.0, 59.0, 75.0]).astype(np.float32))
    assert sigma[0] == sigma[1]
    assert sigma[2] > 1.4 * sigma[0]


def test_a_swaying_person_leans_from_frame_to_frame() -> None:
    """Ten frames of a sway of 10 mm saw nearly none of it: all began upright, in coarse steps."""
    spans, starts = [], []
    for seed in range(5):
        booth = SimulatedBooth(walls=False, sway_m=0.01, seed=seed)
        frames = VirtualCamera(booth, "front-upper", sphere((0.0, 0.0, 1.47), 0.2)).frames(10)
        depths = [TABLE[frame.raw] * DEPTH_SCALE_M for frame in frames]
        middles = [float(depth[200:280, 280:360].mean()) for depth in depths]
        spans.append(np.ptp(middles))
        starts.append(middles[0])
    assert max(spans) > 0.002
    assert np.ptp(starts) > 0.004


def test_a_live_virtual_sensor_keeps_time() -> None:
    camera = SimulatedCamera(name="front-upper", body=BODIES / "ann.npz", seed=2)
    driver = make_driver(camera)
    info = driver.open()
    frames = [driver.read(1.0) for _ in range(6)]
    driver.close()
    taken = [frame for frame in frames if frame is not None]
    assert len(taken) == 6
    steps = np.diff([frame.device_ticks for frame in taken]) / info.tick_hz
    assert np.allclose(steps, 1 / 30, rtol=1e-3)
    assert [frame.sequence for frame in taken] == list(range(6))
    assert (taken[0].depth > 0).mean() > 0.2


def test_a_camera_that_the_virtual_booth_has_not_is_named() -> None:
    camera = SimulatedCamera(name="ceiling", body=BODIES / "ann.npz")
    with pytest.raises(DriverError, match="camera ceiling"):
        make_driver(camera).open()


def test_recordings_come_back_with_their_clock(tmp_path: Path) -> None:
    booth = SimulatedBooth(walls=False, clutter=[sphere((0, 0, 1.5), 0.2)])
    camera = VirtualCamera(booth, "front-upper", None)
    count = write_recording(tmp_path / "a", recorded_frames(camera, 3), tick_hz=TICK_HZ, passes=4)
    frames = check_recording(tmp_path / "a")
    assert count == len(frames) == 12
    seconds = [entry[0] for entry in frames]
    assert np.allclose(np.diff(seconds), 1 / 30, atol=1e-5)
    ticks = np.array([entry[1] for entry in frames], dtype=np.int64)
    assert np.allclose(np.diff(ticks) % 2**32 / TICK_HZ, 1 / 30, rtol=1e-3)
    assert np.array_equal(read_raw(frames[0][2]), read_raw(frames[3][2]))
    frames[5][2].unlink()
    frames[5][2].write_bytes(b"P5 640 480 65535\n")
    with pytest.raises(FormatError, match="is torn"):
        check_recording(tmp_path / "a")


def test_a_recording_that_is_not_there_says_what_to_do(tmp_path: Path) -> None:
    """It spoke of a file in the folder that did not exist, and of no wrong path."""
    missing = tmp_path / "b"
    with pytest.raises(FormatError, match=f"no recording {missing}; correct the recording's path"):
        check_recording(missing)
    missing.mkdir()
    with pytest.raises(FormatError, match=r"INDEX.txt cannot be read .*station record-virtual --"):
        check_recording(missing)
    for kind in (RecordedCamera, FreenectCamera):
        camera = kind(name="a", recording=tmp_path / "c")
        with pytest.raises(DriverError, match=f"no recording {tmp_path / 'c'}; correct"):
            make_driver(camera).open()


@pytest.mark.parametrize(
    ("index", "words"),
    [
        (b"d-0-7-0.pgm\nd-\xff", "INDEX.txt is not text"),
        (b"c-0-7-0.ppm\nd-nan-7-0.pgm", "INDEX.txt, line 2: 'd-nan-7-0.pgm' is not d-<seconds>"),
        (b"d-inf-7-0.pgm", "line 1: 'd-inf-7-0.pgm' is not d-<seconds>"),
        (b"d-0-4294967296-0.pgm", "is not d-<seconds>-<ticks of 32 bits>"),
        (b"d-0-" + 5000 * b"9" + b"-0.pgm", "is not d-<seconds>-<ticks of 32 bits>"),
        (b"d-0-7-0.pgm\nd-1-8-1.pgm\nd-2-7-2.pgm", "line 3: its ticks are those of line 1"),
        (b"d-9-7-0.pgm\nd-8-8-1.pgm", "its last frame is earlier than its first"),
        (b"c-0-7-0.ppm", "lists no depth frame"),
    ],
)
def test_a_line_that_no_recorder_writes_is_named(tmp_path: Path, index: bytes, words: str) -> None:
    for name in index.split():
        if len(name) < 100:
            path = tmp_path / os.fsdecode(name)
            path.write_bytes(b"P5 640 480 65535\n" + bytes(2 * 640 * 480))
    (tmp_path / "INDEX.txt").write_bytes(index)
    with pytest.raises(FormatError, match=re.escape(words)):
        check_recording(tmp_path)


def test_ticks_may_start_over_and_come_again_after_a_turn(tmp_path: Path) -> None:
    names = ("d-0-9-0.pgm", "d-1-70-1.pgm", "d-2-8-2.pgm", "d-72-9-3.pgm")
    for name in names:
        (tmp_path / name).write_bytes(b"P5 640 480 65535\n" + bytes(2 * 640 * 480))
    (tmp_path / "INDEX.txt").write_text("\n".join(names))
    assert [ticks for _, ticks, _ in check_recording(tmp_path)] == [9, 70, 8, 9]


@pytest.mark.parametrize("content", [b"", b"no mesh"])
def test_an_unusable_body_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "body.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"body\.npz"):
        load_mesh(path)


def test_what_is_no_mesh_is_refused_without_other_words(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A coloured warning of the library stood before the error."""
    (tmp_path / "README.md").write_text("no mesh")
    with pytest.raises(InputError, match="holds no usable mesh"):
        load_mesh(tmp_path / "README.md")
    assert capfd.readouterr() == ("", "")
