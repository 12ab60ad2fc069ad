"""The background tells whether a camera moved; people and bare walls must not mislead it."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from moves import move_in
from numpy.typing import NDArray

from station.calibration.detect.scene import StaticView, static_view
from station.calibration.drift import check_cli
from station.calibration.drift.last_check import keep_check, last_check
from station.calibration.guide.feed import Feed
from station.calibration.moves.depths import ChangedDepths
from station.calibration.moves.motion import LEVER_M, CameraMove, depths_words
from station.calibration.moves.reference import DriftReference, plane_slopes
from station.core.config_file import load_config
from station.core.errors import CalibrationError, FormatError
from station.core.geometry import se3_exp
from station.core.kinect_v1 import DEPTH_SCALE_M, TABLE
from station.core.rig import CameraCalibration, Rig
from station.simulation.noise import TrueView, UnitError, observe
from station.simulation.scene import (
    Mesh,
    VirtualScene,
    booth_walls,
    box,
    chair,
    default_rig,
    fixed_posts,
    load_mesh,
)

CAMERA = default_rig().cameras["front-lower"]
ROOM = (*booth_walls(), *fixed_posts())
BODY = load_mesh(Path(__file__).parents[2] / "station/simulation/bodies/ben.npz")
UNIT = UnitError(0.008, (0.2, -0.1))
Twist = tuple[float, float, float, float, float, float]
STILL: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _view(meshes: tuple[Mesh, ...], xi: Twist = STILL) -> TrueView:
    return VirtualScene(meshes).view(CAMERA, CAMERA.world_from_camera @ se3_exp(xi))


def _frames(view: TrueView, count: int, seed: int) -> list[NDArray[np.uint16]]:
    rng = np.random.default_rng(seed)
    return [TABLE[observe(view, UNIT, rng)] for _ in range(count)]


@pytest.fixture(scope="module")
def stored() -> StaticView:
    return static_view(_frames(_view(ROOM), 30, seed=1), DEPTH_SCALE_M)


@pytest.fixture(scope="module")
def reference(stored: StaticView) -> DriftReference:
    return DriftReference.prepare(CAMERA, stored)


@pytest.mark.parametrize("meshes", [ROOM, (*ROOM, BODY)], ids=["empty", "person"])
def test_a_camera_that_stands_still_is_left_alone(
    reference: DriftReference, meshes: tuple[Mesh, ...]
) -> None:
    move = move_in(reference, _frames(_view(meshes), 10, seed=2))
    assert not move.moved
    assert not move.lost
    assert move.alarm() < 0.9
    assert move.xi @ np.linalg.solve(move.covariance, move.xi) < 30.0
    assert ("stands where" in move.words()) == (meshes is ROOM)
    assert ("shows no move, but" in move.words()) == (meshes is not ROOM)


@pytest.mark.parametrize(
    "xi",
    [
        (0.0, 0.0, 0.0, 0.008, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, 0.008, 0.0),
        (0.0, 0.0, 0.0, 0.0, 0.0, -0.007),
        (0.00524, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.00524, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, -0.00524, 0.0, 0.0, 0.0),
    ],
)
def test_moves_are_named_with_a_person_in_view(reference: DriftReference, xi: Twist) -> None:
    view = _view((*ROOM, BODY), xi)
    move = move_in(reference, _frames(view, 10, seed=3))
    assert move.moved
    assert "camera front-lower has moved" in move.words()
    scale = np.array([LEVER_M] * 3 + [1.0] * 3)
    assert np.abs((move.xi - xi) * scale).max() < 0.0025


def _with_chair(x: float, y: float, xi: Twist = STILL) -> TrueView:
    return _view((*booth_walls(), *chair((x, y))), xi)


@pytest.fixture(scope="module")
def furnished() -> DriftReference:
    frames = _frames(_with_chair(-0.8, 0.6), 30, seed=11)
    return DriftReference.prepare(CAMERA, static_view(frames, DEPTH_SCALE_M))


@pytest.mark.parametrize("by_m", [(0.03, 0.0), (0.02, -0.02), (0.3, 0.0)])
def test_a_chair_that_was_moved_is_no_moved_camera(
    furnished: DriftReference, by_m: tuple[float, float]
) -> None:
    """Its outlines agree with a camera that was shifted by centimetres, and were believed where
    few others show a shift along the wall."""
    x, y = by_m
    frames = _frames(_with_chair(x - 0.8, y + 0.6), 10, seed=12)
    move = move_in(furnished, frames)
    assert not move.moved


def test_a_moved_camera_is_named_though_a_chair_was_moved(furnished: DriftReference) -> None:
    xi: Twist = (0.0, 0.009, 0.0, 0.0, 0.0, 0.0)
    frames = _frames(_with_chair(-0.77, 0.6, xi), 10, seed=13)
    move = move_in(furnished, frames)
    assert move.moved
    off = move.xi - xi
    assert off @ np.linalg.solve(move.covariance, off) < 16.8


def test_a_hard_knock_is_measured(reference: DriftReference) -> None:
    """Outlines see only a few pixels far: the surfaces have to bring them there."""
    xi = (0.015, -0.02, 0.01, 0.03, -0.01, 0.02)
    move = move_in(reference, _frames(_view(ROOM, xi), 10, seed=4))
    assert move.moved
    assert np.allclose(move.xi[:3], xi[:3], atol=0.003)
    assert np.allclose(move.xi[3:], xi[3:], atol=0.006)


def test_a_covered_or_turned_camera_is_lost(reference: DriftReference) -> None:
    covered = move_in(reference, [np.full((480, 640), 8000, np.uint16)] * 3)
    assert covered.lost
    assert "no longer sees" in covered.words()
    turned = _view(ROOM, (0.0, 0.6, 0.0, 0.0, 0.0, 0.0))
    move = move_in(reference, _frames(turned, 5, seed=5))
    assert move.lost or move.moved


def test_a_bare_wall_says_nothing_of_moves_along_it() -> None:
    """Noise in the wall's slope once passed for structure: a shift along it was called certain."""
    wall = (box((-6.0, 1.0, -4.0), (6.0, 1.1, 6.0)),)
    bare = DriftReference.prepare(
        CAMERA, static_view(_frames(_view(wall), 20, seed=6), DEPTH_SCALE_M)
    )
    along = _view(wall, (0.0, 0.0, 0.0, 0.01, 0.0, 0.0))
    move = move_in(bare, _frames(along, 10, seed=7))
    assert {"shift sideways", "shift up or down", "roll"} <= set(move.unseen_words())
    assert not move.moved
    nearer = _view(wall, (0.0, 0.0, 0.0, 0.0, 0.0, 0.005))
    assert not any("forward" in words for words in move.unseen_words())
    assert move_in(bare, _frames(nearer, 10, seed=8)).moved


def test_an_edge_that_loses_pixels_is_no_moved_camera() -> None:
    """A wall's upper edge alone showed the camera's height. Pixels that it lost were expected with
    another profile across the edge than a shift has, and counted as 8 mm."""
    wall = (box((-6.0, 1.6, -4.0), (6.0, 1.7, 1.3)),)
    bare = DriftReference.prepare(
        CAMERA, static_view(_frames(_view(wall), 45, seed=14), DEPTH_SCALE_M)
    )
    lost = [_without_edges(frame, 2) for frame in _frames(_view(wall), 10, seed=15)]
    move = move_in(bare, lost)
    assert move.alarm() < 0.6
    assert "shift up or down" in move.unseen_words()


def _without_edges(frame: NDArray[np.uint16], pixels: int) -> NDArray[np.uint16]:
    """A frame whose silhouettes against nothing lose pixels."""
    square = np.ones((5, 5), np.uint8)
    nothing = cv2.morphologyEx((frame == 0).astype(np.uint8), cv2.MORPH_OPEN, square)
    reach = np.ones((2 * pixels + 1,) * 2, np.uint8)
    return np.where(cv2.dilate(nothing, reach) > 0, 0, frame).astype(np.uint16)


def test_a_move_within_the_tolerance_never_alarms_and_words_say_where() -> None:
    sure = np.diag([1e-4**2] * 3 + [1e-4**2] * 3)
    turned = float(np.radians(0.14))
    assert not CameraMove("a", np.array([turned, 0, 0, 0, 0.0019, 0]), sure, 1.0).moved
    far = CameraMove("a", np.array([0, np.radians(-0.4), 0, 0, 0, 0.006]), sure, 1.0)
    assert far.moved
    assert far.words() == (
        "camera a has moved since it was calibrated: by about 6 mm (mostly forward) and "
        "0.4 degrees (mostly to the left)"
    )
    # A turn to the right and a shift to the left that are not told apart: neither is judged.
    together = np.zeros((6, 6))
    mixed = np.array([0, 1 / LEVER_M, 0, -1.0, 0, 0])
    together += 0.02**2 * np.outer(mixed, mixed)
    unsure = CameraMove("a", 0.006 * mixed, sure + together, 1.0)
    assert not unsure.moved
    assert set(unsure.unseen_words()) == {"turn to the left or right", "shift sideways"}
    assert np.abs(unsure.known()).max() < 0.001


def test_a_move_that_the_view_shows_only_roughly_is_not_told_as_none() -> None:
    """It was told as "by about 0 mm and 0.1 degrees"."""
    rough = np.diag([1e-4**2] * 3 + [0.004**2, 1e-4**2, 1e-4**2])
    aside = CameraMove("a", np.array([0, 0, 1e-3, 0.05, 0, 0]), rough, 1.0)
    assert aside.moved
    assert aside.words() == (
        "camera a has moved since it was calibrated, in a direction that its view shows only "
        "roughly"
    )
    turned = CameraMove("a", np.array([0, 0, 0.01, 0.05, 0, 0]), rough, 1.0)
    assert turned.words().endswith(": by about 0.6 degrees (mostly clockwise)")
    shifted = CameraMove("a", np.array([0, 0, 0, 0.05, 0, -0.009]), rough, 1.0)
    assert shifted.words().endswith(": by about 9 mm (mostly backward)")


def test_slopes_hold_beside_gaps() -> None:
    """Slopes of blurred images are too small there: a floor then seems to change as a camera moves
    along it."""
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    known = (x > 40) & (y < 80)
    slopes = plane_slopes(np.where(known, 0.3 + 1e-3 * x - 2e-3 * y, 0.0).astype(np.float32), known)
    assert np.allclose(slopes[known], (1e-3, -2e-3), rtol=0.01)


def test_a_stored_view_comes_back(stored: StaticView, tmp_path: Path) -> None:
    path = tmp_path / "front-lower.npz"
    stored.save(path)
    found = StaticView.load(path)
    assert np.array_equal(found.inverse_depth, stored.inverse_depth)
    # Shares once came back in steps of 1/255: the wall stood 2 mm nearer, and cameras "moved".
    assert np.allclose(found.share, stored.share, rtol=0.0, atol=1e-6)
    assert np.allclose(found.noise, stored.noise, rtol=1e-3, atol=1e-6)
    assert found.frames == 30
    depth = found.depth_m()
    assert 1.0 < np.median(depth[depth > 0]) < 4.5
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(FormatError, match=r"front-lower\.npz cannot be read"):
        StaticView.load(path)
    with pytest.raises(FormatError, match=r"nothing\.npz"):
        StaticView.load(tmp_path / "nothing.npz")


def test_a_damaged_view_is_named(stored: StaticView, tmp_path: Path) -> None:
    """A page of zeros in it ended a check of the cameras in a traceback."""
    path = tmp_path / "front-lower.npz"
    stored.save(path)
    content = path.read_bytes()
    for at in range(0, len(content) - 4096, len(content) // 40):
        path.write_bytes(content[:at] + bytes(4096) + content[at + 4096 :])
        with pytest.raises(FormatError, match=r"front-lower\.npz cannot be read"):
            StaticView.load(path)


def test_a_views_size_is_looked_at_before_it_is_unpacked(
    stored: StaticView, tmp_path: Path
) -> None:
    """A file of 1.3 MB took 1.7 GB."""
    path = tmp_path / "front-lower.npz"
    stored.save(path)
    height, width = stored.noise.shape
    assert StaticView.load(path, (height, width)).frames == 30
    with pytest.raises(FormatError, match=r"inverse_depth of \(9, 9\) was expected, not"):
        StaticView.load(path, (9, 9))
    with zipfile.ZipFile(path) as archive:
        content = {name: bytearray(archive.read(name)) for name in archive.namelist()}
    for name in ("inverse_depth.npy", "readings.npy", "noise.npy", "outline_noise.npy"):
        large = f"({height}, {width}), }}".encode(), f"(9000, {width}) }}".encode()
        content[name] = content[name].replace(*large)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    with pytest.raises(FormatError, match=r"inverse_depth is .9000, .* at most 4096 pixels"):
        StaticView.load(path)


@pytest.mark.parametrize(
    "change",
    [
        {"frames": np.array(0)}, {"frames": np.array(np.inf)}, {"noise": np.full((4, 4), np.nan)},
        {"inverse_depth": np.zeros(4)}, {"readings": np.zeros((2, 4))}, {"frames": np.full(9, 30)},
        {"outline_noise": np.full((4, 4), "x")},
    ],
)  # fmt: skip
def test_a_view_that_no_camera_has_is_named(tmp_path: Path, change: dict[str, np.ndarray]) -> None:
    names = ("inverse_depth", "readings", "noise", "outline_noise")
    whole = {name: np.zeros((4, 4)) for name in names}
    path = tmp_path / "back-upper.npz"
    content: Any = {**whole, "version": np.array(1), "frames": np.array(30), **change}
    np.savez(path, **content)
    with pytest.raises(FormatError, match=r"back-upper\.npz cannot be read"):
        StaticView.load(path)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_depths_that_changed_everywhere_are_no_moved_cameras(sign: float) -> None:
    """Sensors at another temperature were four cameras to be put back. Estimates of a booth whose
    depths are 0.3 % too large."""
    sure = 1e-4**2 * np.eye(6)
    shifts_mm = [(4.1, -1.1, -8.7), (1.9, -4.8, -10.5), (-3.6, -1.2, -10.4), (-2.5, -3.7, -10.3)]
    moves = [
        CameraMove(name, 1e-3 * sign * np.array([0.0, 0.0, 0.0, *shift]), sure, 1.0)
        for name, shift in zip("abcd", shifts_mm, strict=True)
    ]
    words = depths_words(moves)
    assert words is not None
    assert ("farther away" if sign > 0.0 else "nearer") in words
    still = CameraMove("e", np.zeros(6), sure, 1.0)
    assert depths_words([*moves, still]) is None
    assert depths_words(moves[:1]) is None
    aside = replace(moves[0], xi=1e-3 * np.array([0.0, 0.0, 0.0, 9.0, 0.0, -5.0]))
    assert depths_words([aside, *moves[1:]]) is None
    opposite = replace(moves[0], xi=-moves[0].xi)
    assert depths_words([opposite, *moves[1:]]) is None
    turned = [replace(move, xi=move.xi + np.array([0.03, 0, 0, 0, 0, 0])) for move in moves]
    assert depths_words(turned) is None


def test_depths_that_changed_are_told_in_front_of_plain_walls() -> None:
    """The shift along a wall is hardly known there, and was taken for a move."""
    moves = []
    for name in ("front-upper", "back-lower"):
        camera = default_rig().cameras[name]
        view = VirtualScene(booth_walls()).view(camera, camera.world_from_camera)
        frames = _frames(view, 30, seed=4)
        before = DriftReference.prepare(camera, static_view(frames[:20], DEPTH_SCALE_M))
        nearer = [np.round(0.997 * frame).astype(np.uint16) for frame in frames[20:]]
        moves.append(move_in(before, nearer))
    assert "nearer than when they were" in str(depths_words(moves))


def test_a_check_of_a_booth_that_looks_different_is_not_kept_as_good(tmp_path: Path) -> None:
    """One made in a terminal was not kept at all: the page said that there had been none."""
    assert last_check(tmp_path) is None
    sure = 1e-8 * np.eye(6)
    keep_check(
        tmp_path, [CameraMove("a", np.zeros(6), sure, 0.6), CameraMove("b", np.zeros(6), sure, 1.0)]
    )
    last = last_check(tmp_path)
    assert last is not None
    assert (last["moved"], last["changed"]) == ([], ["a"])


def test_a_check_keeps_how_a_camera_moved(tmp_path: Path) -> None:
    """One whose view was covered was told as moved, on the page; of no move it said how far."""
    sure = 1e-8 * np.eye(6)
    pushed = CameraMove("a", np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0]), sure, 1.0)
    covered = CameraMove("b", np.zeros(6), sure, 0.05)
    keep_check(tmp_path, [pushed, covered, CameraMove("c", np.zeros(6), sure, 1.0)])
    last = last_check(tmp_path)
    assert last is not None
    assert last["moves"] == [pushed.words(), covered.words()]
    assert "20 mm (mostly to the right)" in last["moves"][0]
    assert "something stands in its way" in last["moves"][1]


def _rig(names: str, serial: str = "") -> Rig:
    cameras = {name: replace(CAMERA, name=name, serial=serial) for name in names}
    return replace(default_rig(), cameras=cameras, reference=names[0])


def test_cameras_without_a_picture_of_the_empty_booth_are_named(tmp_path: Path) -> None:
    """Several were "camera a, b"."""
    section = '[[cameras]]\nname = "{0}"\ndriver = "recorded"\nrecording = "{0}"\n'
    for names, words in (("a", "camera a;"), ("ab", "cameras a, b;")):
        _rig(names).save(tmp_path / "calibration.json")
        (tmp_path / "booth.toml").write_text("".join(map(section.format, names)))
        with pytest.raises(CalibrationError, match=f"no picture of the empty booth by {words}"):
            check_cli._compared(load_config(tmp_path / "booth.toml"), None, quiet=True)


@pytest.mark.parametrize(("change", "code"), [(1e-3, 0), (-5e-3, 3)])
def test_a_check_fails_where_depths_changed_too_much_for_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: float, code: int
) -> None:
    """It was "no camera has moved", and every scan was refused."""
    (tmp_path / "booth.toml").write_text(
        '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
    )
    still = CameraMove("a", np.zeros(6), 1e-8 * np.eye(6), 1.0)
    found: Any = {}, ChangedDepths(change, {}, 1e-3), [still]
    monkeypatch.setattr(check_cli, "_compared", lambda *_, **__: found)
    options = ["--config", str(tmp_path / "booth.toml"), "--recordings", str(tmp_path)]
    done = CliRunner().invoke(check_cli.check, options)
    assert done.exit_code == code, done.output
    assert ("no camera has moved" in done.output) == (code == 0)


def test_cameras_that_were_not_calibrated_are_not_checked(tmp_path: Path) -> None:
    """A sensor that had been exchanged was compared with the picture of another one."""
    section = '[[cameras]]\nname = "{0}"\ndriver = "recorded"\nrecording = "{0}"\nserial = "{1}"\n'
    _rig("ab", "A1").save(tmp_path / "calibration.json")
    for cameras, words in (
        ({"a": "A1"}, "camera b was calibrated and is not in booth.toml"),
        ({"a": "A1", "b": "B2"}, "camera b is sensor B2, but A1 was calibrated"),
    ):
        sections = (section.format(name, serial) for name, serial in cameras.items())
        (tmp_path / "booth.toml").write_text("".join(sections))
        with pytest.raises(CalibrationError, match=f"{words}; put the sensors and booth.toml"):
            check_cli._compared(load_config(tmp_path / "booth.toml"), None, quiet=True)


class _Exchanged(Feed):
    """Sensors that are not those that booth.toml once named."""

    def __init__(self) -> None:
        pass

    def cameras(self, timeout_s: float) -> dict[str, CameraCalibration]:
        del timeout_s
        return dict(_rig("a", "B2").cameras)


def test_a_sensor_that_was_not_calibrated_is_not_looked_at() -> None:
    with pytest.raises(CalibrationError, match="camera a is sensor B2, but A1 was calibrated; put"):
        check_cli._look(_Exchanged(), _rig("a", "A1"), ["a"], quiet=True)


def test_cameras_that_share_unseen_directions_are_told_together(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Each had the same long sentence."""
    blind = np.diag([1e-6] * 3 + [1.0, 1e-8, 1e-8])
    sharp = 1e-8 * np.eye(6)
    moves = [
        CameraMove(name, np.zeros(6), covariance, 1.0)
        for name, covariance in (("a", blind), ("b", sharp), ("c", blind))
    ]
    *first, last = moves[0].unseen_words()
    words = f"{', '.join(first)} or {last}" if first else last
    assert "shift sideways" in words
    check_cli._tell(moves, [], "", moved=False)
    assert capsys.readouterr().out.splitlines() == [
        *(f"camera {name} stands where it was calibrated" for name in "abc"),
        f"  cameras a, c: a small {words} cannot be detected",
        "  a fixed post or corner in a camera's view would make it possible",
        "the booth is in order: no camera has moved, as far as their views can show",
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (9e-4, "0.09 % farther away than when they were calibrated"),
        (-7e-4, "0.07 % nearer than when they were calibrated"),
        (0.0, ""),
    ],
)
def test_depths_that_changed_are_told(
    capsys: pytest.CaptureFixture[str], change: float, words: str
) -> None:
    """Girths were 7 mm off where nothing showed it."""
    moves = [CameraMove(name, np.zeros(6), 1e-8 * np.eye(6), 1.0) for name in "abcd"]
    depths = ChangedDepths(change, {}, 1e-3).words() if change else ""
    check_cli._tell(moves, [], depths, moved=False)
    out = capsys.readouterr().out
    assert ("all cameras see the booth" in out) == bool(words)
    assert ("the booth is in order" in out) != bool(words)
    assert words in out
