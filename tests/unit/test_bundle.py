import errno
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from station.core.bundle import CapturedFrame, read_bundle, write_bundle
from station.core.depth.correction import DepthCorrection
from station.core.errors import BundleError, CalibrationError, DiskReadError, FormatError
from station.core.files import read_regular
from station.core.rig import CameraCalibration, Rig


@pytest.fixture
def bundle_folder(tmp_path: Path) -> Path:
    camera = CameraCalibration(
        name="front",
        serial="A001",
        model="kinect-v1",
        width=64,
        height=48,
        K=np.array([[58.0, 0.0, 32.0], [0.0, 58.0, 24.0], [0.0, 0.0, 1.0]]),
        distortion=np.zeros(5),
        depth_correction=DepthCorrection(),
        world_from_camera=np.eye(4),
    )
    rng = np.random.default_rng(0)
    frames = [
        CapturedFrame(rng.integers(0, 40_000, (48, 64), dtype=np.uint16), 7 * i, 60e6, 0.1 * i, i)
        for i in range(3)
    ]
    folder = tmp_path / "scan"
    write_bundle(
        folder,
        scan_id="20261121T100000Z-7f3a",
        created="2026-11-21T10:00:00Z",
        label="demo",
        depth_scale_m=1e-4,
        rig=Rig("2026-11-21T09:00:00Z", "front", {"front": camera}, 0.001),
        frames={"front": frames},
        spread_s_max=0.012,
    )
    return folder


def test_frames_come_back_exactly(bundle_folder: Path) -> None:
    bundle = read_bundle(bundle_folder)
    rng = np.random.default_rng(0)
    expected = [rng.integers(0, 40_000, (48, 64), dtype=np.uint16) for _ in range(3)]
    assert np.array_equal(bundle.depth_stack("front"), expected)
    assert bundle.frames["front"][2].sequence == 2
    assert bundle.label == "demo"


@pytest.mark.parametrize("length", [0, 4, 100, -1])
def test_a_torn_frame_is_named(bundle_folder: Path, length: int) -> None:
    """OpenCV decodes the first rows of a torn PNG and leaves the rest black, in silence."""
    path = bundle_folder / "depth/front/001.png"
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(BundleError, match=r"001\.png is torn"):
        read_bundle(bundle_folder).depth_stack("front")


@pytest.mark.parametrize(
    ("number", "of_the_disk"), [(errno.EIO, True), (errno.EMFILE, True), (errno.ENOTDIR, False)]
)
def test_a_disk_that_refuses_is_not_the_scans_fault(
    bundle_folder: Path, monkeypatch: pytest.MonkeyPatch, number: int, of_the_disk: bool
) -> None:
    """A passing error of the disk failed a scan for good, whose person had left."""
    bundle = read_bundle(bundle_folder)
    camera, frames = next(iter(bundle.frames.items()))

    def refused(*_: object) -> bytes:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("station.core.bundle.read_regular", refused)
    with pytest.raises(FormatError, match="cannot be read") as raised:
        bundle.read_frame(camera, frames[0])
    assert isinstance(raised.value, DiskReadError) == of_the_disk


@pytest.mark.parametrize("name", ["bundle.json", "calibration.json"])
@pytest.mark.parametrize(("number", "of_the_disk"), [(errno.EIO, True), (errno.EACCES, False)])
def test_neither_is_one_that_refuses_a_description(
    bundle_folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, number: int, of_the_disk: bool
) -> None:
    """A scan whose manifest could not be read failed at once, for good."""

    def read_except(path: Path, most_bytes: int) -> bytes:
        if path.name == name:
            raise OSError(number, os.strerror(number))
        return read_regular(path, most_bytes)

    monkeypatch.setattr("station.core.files.read_regular", read_except)
    with pytest.raises(FormatError, match=rf"{name} cannot be read") as raised:
        read_bundle(bundle_folder)
    assert isinstance(raised.value, DiskReadError) == of_the_disk


def test_a_missing_frame_is_named(bundle_folder: Path) -> None:
    (bundle_folder / "depth/front/002.png").unlink()
    with pytest.raises(BundleError, match=r"002\.png cannot be read"):
        read_bundle(bundle_folder).depth_stack("front")


def _edit(folder: Path, **changes: object) -> None:
    path = folder / "bundle.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_an_unknown_version_is_refused_with_the_known_ones(bundle_folder: Path) -> None:
    _edit(bundle_folder, version=2)
    with pytest.raises(FormatError, match=r"bundle\.json has .* version 2; this program reads 1"):
        read_bundle(bundle_folder)


def test_a_camera_absent_from_the_calibration_is_named(bundle_folder: Path) -> None:
    cameras = json.loads((bundle_folder / "bundle.json").read_text())["cameras"]
    _edit(bundle_folder, cameras={"rear": cameras["front"]})
    with pytest.raises(CalibrationError, match="camera rear is not in calibration"):
        read_bundle(bundle_folder)


def test_a_bundle_cannot_reach_outside_its_folder(bundle_folder: Path) -> None:
    cameras = json.loads((bundle_folder / "bundle.json").read_text())["cameras"]
    cameras["front"]["frames"][0]["file"] = "../../secret.png"
    _edit(bundle_folder, cameras=cameras)
    with pytest.raises(BundleError, match="outside the bundle"):
        read_bundle(bundle_folder)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cameras": {}}, "no camera has a frame"),
        ({"depth_scale_m": 0}, "depth_scale_m is 0"),
        ({"depth_scale_m": 1}, "depth_scale_m is 1"),
        ({"sync": None}, "sync is null, not an object"),
        ({"sync": {"spread_s_max": "0.1"}}, 'spread_s_max is "0.1", not a number'),
        ({"depth_scale_m": None}, "depth_scale_m is null, not a number"),
        ({"depth_scale_m": 10**400}, "depth_scale_m is too large"),
        ({"cameras": ["front"]}, "cameras is a list, not an object"),
        ({"cameras": {"front": {"frames": {}}}}, "camera 'front': frames is an object"),
        ({"cameras": {"front": {"frames": ["000.png"]}}}, 'a frame is "000.png", not an object'),
        ({"label": "order \ud800"}, "label has characters that no file can hold"),
        ({"label": {"order": 7}}, "label is an object {...}, not text"),
        ({"scan_id": 7}, "scan_id is 7, not text"),
    ],
)
def test_contradictions_are_refused(
    bundle_folder: Path, changes: dict[str, object], words: str
) -> None:
    _edit(bundle_folder, **changes)
    with pytest.raises(BundleError, match=words):
        read_bundle(bundle_folder)


def test_parts_of_a_tick_are_left_out(bundle_folder: Path) -> None:
    """A program that computes moments writes them; the contract does not forbid it."""
    cameras = json.loads((bundle_folder / "bundle.json").read_text())["cameras"]
    cameras["front"]["frames"][0]["device_ticks"] = 1234.5
    _edit(bundle_folder, cameras=cameras)
    assert read_bundle(bundle_folder).frames["front"][0].device_ticks == 1234


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("sequence", None, r"depth/front/000\.png: sequence is null, not a number"),
        ("sequence", True, "sequence is true, not a number"),
        ("sequence", 1.5, r"sequence is 1\.5, not a whole number"),
        ("host_time_s", "12", 'host_time_s is "12", not a number'),
        ("file", None, "the name of a frame's file is null, not text"),
    ],
)
def test_a_frames_wrong_field_is_named(
    bundle_folder: Path, key: str, value: object, words: str
) -> None:
    """A message of Python's own named neither: "float() argument must be a string"."""
    cameras = json.loads((bundle_folder / "bundle.json").read_text())["cameras"]
    cameras["front"]["frames"][0][key] = value
    _edit(bundle_folder, cameras=cameras)
    with pytest.raises(BundleError, match=words):
        read_bundle(bundle_folder)


def test_a_folder_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="is not a folder"):
        read_bundle(tmp_path / "nothing")


def test_an_images_size_is_looked_at_before_it_is_decoded(bundle_folder: Path) -> None:
    """A PNG of 30 kB that claimed 30000 x 30000 pixels took 3.8 GB."""
    path = bundle_folder / "depth/front/001.png"
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 30_000, 30_000)
    path.write_bytes(bytes(data))
    with pytest.raises(BundleError, match=r"001\.png is \(30000, 30000\)"):
        read_bundle(bundle_folder).depth_stack("front")


@pytest.mark.parametrize("target", ["/dev/zero", "/etc/hostname"])
def test_no_link_is_followed(bundle_folder: Path, target: str) -> None:
    path = bundle_folder / "depth/front/001.png"
    path.unlink()
    path.symlink_to(target)
    with pytest.raises(BundleError, match="is a link"):
        read_bundle(bundle_folder).depth_stack("front")


def test_a_folder_of_the_bundle_may_be_no_link(bundle_folder: Path, tmp_path: Path) -> None:
    (bundle_folder / "depth").rename(tmp_path / "elsewhere")
    (bundle_folder / "depth").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BundleError, match="reached through a symbolic link"):
        read_bundle(bundle_folder).depth_stack("front")


def test_a_spool_may_lie_behind_a_link(bundle_folder: Path, tmp_path: Path) -> None:
    whole = read_bundle(bundle_folder).depth_stack("front")
    (tmp_path / "real/queue").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    bundle_folder.rename(tmp_path / "real/queue/scan")
    found = read_bundle(tmp_path / "link/queue/scan").depth_stack("front")
    assert np.array_equal(found, whole)


def test_no_pipe_is_waited_for(bundle_folder: Path) -> None:
    path = bundle_folder / "bundle.json"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(BundleError, match="not a regular file"):
        read_bundle(bundle_folder)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"format": "booth-bundle", "version": 1e400}', '{"a": ' * 50_000]
)
def test_strange_json_is_refused_in_one_line(bundle_folder: Path, text: str) -> None:
    (bundle_folder / "bundle.json").write_text(text)
    with pytest.raises(FormatError):
        read_bundle(bundle_folder)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tick_hz", 0),
        ("host_time_s", float("nan")),
        ("sequence", -1),
        ("device_ticks", 1e400),
        ("device_ticks", 10**400),
        ("file", "a\0b"),
        ("file", 7),
    ],
)
def test_impossible_numbers_are_refused(bundle_folder: Path, field: str, value: object) -> None:
    cameras = json.loads((bundle_folder / "bundle.json").read_text())["cameras"]
    cameras["front"]["frames"][1][field] = value
    _edit(bundle_folder, cameras=cameras)
    with pytest.raises(BundleError):
        read_bundle(bundle_folder).depth_stack("front")


def test_a_negative_covariance_is_refused(bundle_folder: Path) -> None:
    path = bundle_folder / "calibration.json"
    document = json.loads(path.read_text())
    document["cameras"]["front"]["covariance"] = (-np.eye(6)).tolist()
    path.write_text(json.dumps(document))
    with pytest.raises(FormatError, match="covariance is not symmetric and positive"):
        read_bundle(bundle_folder)
