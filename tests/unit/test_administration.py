"""Setting up, saving, restoring and migrating a booth, on real folders."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from station.administration.archive import parts, save
from station.administration.backup import backup
from station.administration.booth_file import administration, booth_toml, name_cameras
from station.administration.connected import connected_cameras, crowded_controllers
from station.administration.migrate import MIGRATIONS, VERSION, migrate, migrate_command
from station.administration.restore import _protect, restore
from station.administration.setup import compare_sensors, setup
from station.core import bundle, rig
from station.core.config_file import load_config
from station.core.errors import BoothError, ConfigError, FormatError, InputError
from station.core.files import held
from station.core.rig import Rig
from station.core.service import STATION_LOCK
from station.sensors.freenect import FreenectCamera
from station.sensors.recording import check_recording


def _recordings(folder: Path) -> Path:
    for name in ("front-lower", "back-upper"):
        (folder / name).mkdir(parents=True)
        (folder / name / "INDEX.txt").write_text("")
    (folder / "calibration.json").write_text("{}")
    return folder


def _run(command: object, *words: object) -> str:
    result = CliRunner().invoke(command, list(map(str, words)))  # type: ignore[arg-type]
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def test_setup_writes_a_booth_and_keeps_it(tmp_path: Path) -> None:
    """A second call must not undo what the technician has changed since."""
    config = tmp_path / "booth/booth.toml"
    recordings = _recordings(tmp_path / "recordings")
    words = _run(setup, "--config", config, "--recordings", recordings)
    booth = load_config(config)
    assert [camera.name for camera in booth.cameras] == ["back-upper", "front-lower"]
    assert booth.calibration.read_text() == "{}"
    assert "station run" in words
    config.write_text(config.read_text() + "[workers]\ncount = 3\n")
    before = config.read_bytes()
    assert "kept" in _run(setup, "--config", config)
    assert config.read_bytes() == before
    with pytest.raises(ConfigError, match="--replace"):
        _run(setup, "--config", config, "--recordings", recordings)
    _run(setup, "--config", config, "--recordings", recordings, "--replace")
    assert load_config(config).workers.count == 1
    assert config.with_name("booth.toml.old").read_bytes() == before


def test_one_setup_at_a_time(tmp_path: Path) -> None:
    config, recordings = tmp_path / "booth.toml", _recordings(tmp_path / "recordings")
    with administration(config), pytest.raises(BoothError, match="another station setup"):
        _run(setup, "--config", config, "--recordings", recordings)
    assert not config.exists()
    _run(setup, "--config", config, "--recordings", recordings)


def test_setup_says_where_the_recordings_are_missing(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no recordings"):
        _run(setup, "--config", tmp_path / "booth.toml", "--recordings", tmp_path)
    assert not (tmp_path / "booth.toml").exists()


def test_recordings_may_lie_in_a_folder_of_any_name(tmp_path: Path) -> None:
    """Set-up wrote no TOML, and the booth had to be set up by hand."""
    recordings = _recordings(tmp_path / 'the "good" ones \\ 录像')
    _run(setup, "--config", tmp_path / "booth.toml", "--recordings", recordings)
    folders = {getattr(c, "recording", None) for c in load_config(tmp_path / "booth.toml").cameras}
    assert folders == {recordings / "front-lower", recordings / "back-upper"}


def test_what_is_restored_beside_the_configuration_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder without the right to enter hid the key of a webhook from the services."""
    monkeypatch.setattr(shutil, "chown", lambda *_: None)
    (tmp_path / "keys").mkdir(0o700)
    (tmp_path / "keys/orders").write_text("topsecret")
    (tmp_path / "booth.toml").write_text("")
    (tmp_path / "link").symlink_to("/nowhere")
    _protect(tmp_path)
    modes = {p.name: p.lstat().st_mode & 0o777 for p in tmp_path.rglob("*") if not p.is_symlink()}
    assert modes == {"keys": 0o750, "orders": 0o640, "booth.toml": 0o640}


def test_setup_takes_no_recording_whose_name_no_camera_can_have(tmp_path: Path) -> None:
    recordings = _recordings(tmp_path / "recordings")
    (recordings / "back-upper").rename(recordings / "back upper")
    with pytest.raises(ConfigError, match="back upper: use 1 to 40 letters"):
        _run(setup, "--config", tmp_path / "booth.toml", "--recordings", recordings)


def test_a_virtual_booth_is_set_up_and_comes_back_without_its_recordings(tmp_path: Path) -> None:
    config = tmp_path / "booth.toml"
    _run(setup, "--config", config, "--virtual")
    assert Rig.load(load_config(config).calibration).cameras.keys() == {
        camera.name for camera in load_config(config).cameras
    }
    shutil.rmtree(tmp_path / "virtual")
    assert ", kept" in _run(setup, "--config", config)
    for camera in load_config(config).cameras:
        assert isinstance(camera, FreenectCamera)
        assert camera.recording is not None
        assert check_recording(camera.recording)


def test_sensors_get_the_names_that_were_given(tmp_path: Path) -> None:
    cameras = name_cameras(["A", "B", "C", "D", "E"], ["back-lower=B"])
    assert [(camera.serial, camera.name) for camera in cameras] == [
        ("A", "front-lower"),
        ("B", "back-lower"),
        ("C", "front-upper"),
        ("D", "back-upper"),
        ("E", "camera-5"),
    ]
    path = tmp_path / "booth.toml"
    path.write_text(booth_toml(cameras, installed=False))
    assert load_config(path).cameras == tuple(cameras)
    with pytest.raises(ConfigError, match="connected sensors: A"):
        name_cameras(["A"], ["front=Z"])
    for pairs, reason in (
        (["one=A", "one=B"], "twice"),
        (["one=A", "two=A"], "twice"),
        (["a b=A"], "letters, digits"),
        (["=A"], "letters, digits"),
    ):
        with pytest.raises(ConfigError, match=reason):
            name_cameras(["A", "B"], pairs)


def test_a_sensor_that_was_replaced_is_named_with_the_new_one() -> None:
    assert compare_sensors(["A1", "A2"], ["A2", "A1"]) == []
    left = compare_sensors(["A1", "A2"], ["A2", "B7"])
    assert left[0] == "connect the sensors A1"
    assert left[1].startswith("connected, but not in booth.toml: B7")


def test_two_kinects_on_one_controller_are_named(tmp_path: Path) -> None:
    """Each takes most of what USB 2 carries, whatever the number of ports."""
    devices = tmp_path / "devices"
    devices.mkdir()
    for number, (product, controller) in enumerate(
        [("02ae", "0000:00:14.0"), ("02bf", "0000:00:14.0"), ("02ae", "0000:05:00.0")]
    ):
        place = tmp_path / f"pci0000:00/{controller}/usb{number + 1}/{number + 1}-1"
        place.mkdir(parents=True)
        (place / "idVendor").write_text("045e\n")
        (place / "idProduct").write_text(f"{product}\n")
        (devices / place.name).symlink_to(place)
    cameras = connected_cameras(devices)
    assert [camera.model for camera in cameras] == [
        "Kinect for Xbox",
        "Kinect for Windows",
        "Kinect for Xbox",
    ]
    assert crowded_controllers(cameras) == {"0000:00:14.0": 2}


@pytest.fixture
def booth(tmp_path: Path) -> Path:
    """A booth with a calibration, a record of its own, and one delivered scan."""
    folder = tmp_path / "booth"
    _run(setup, "--config", folder / "booth.toml", "--recordings", _recordings(tmp_path / "r"))
    for name in ("calibrations/20261122/ball.npz", "spool/outbox/scan-1/mesh.ply", "spool/tmp/x"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode())
    (folder / "console").mkdir()
    (folder / "console/audit.jsonl").write_text("{}\n")
    return folder / "booth.toml"


def _content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.parts)
    }


@pytest.mark.parametrize("with_scans", [False, True])
def test_what_was_saved_comes_back_on_another_machine(
    booth: Path, tmp_path: Path, with_scans: bool
) -> None:
    saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=with_scans)
    expected = _content(booth.parent)
    del expected["spool/tmp/x"]
    if not with_scans:
        del expected["spool/outbox/scan-1/mesh.ply"]
    other = tmp_path / "other/booth.toml"
    done = _run(restore, saved, "--config", other)
    assert _content(other.parent) == expected
    # Without the option it would not be found.
    assert done.endswith(f"next: station run --config {other}\n")


def test_a_backup_goes_to_a_drive_that_is_there_and_says_what_it_lacks(
    booth: Path, tmp_path: Path
) -> None:
    """It was made on the system's disk where the drive was not mounted, without the webhook's key,
    and both showed too late."""
    orders = '\n[[deliver]]\nname = "orders"\nurl = "https://x"\nsecret_file = "orders.secret"\n'
    booth.write_text(booth.read_text() + orders)
    drive = tmp_path / "usb"
    with pytest.raises(InputError, match="is no folder; is the drive mounted"):
        _run(backup, drive, "--config", booth)
    assert not drive.exists()
    drive.mkdir()
    done = CliRunner().invoke(backup, [str(drive), "--config", str(booth)])
    assert done.exit_code == 0, done.output
    assert f"deliver orders is not in it: keep {booth.parent / 'orders.secret'}" in done.output


def test_a_disk_without_file_modes_takes_a_backup(
    booth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As FAT and exFAT, which USB sticks come with."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "chmod", refuse)
    saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=True)
    other = tmp_path / "other/booth.toml"
    _run(restore, saved, "--config", other)
    mesh = other.parent / "spool/outbox/scan-1/mesh.ply"
    assert mesh.read_bytes() == b"spool/outbox/scan-1/mesh.ply"
    assert mesh.stat().st_mode & 0o077 == mesh.parent.stat().st_mode & 0o077 == 0


def test_restoring_keeps_what_it_replaces(booth: Path, tmp_path: Path) -> None:
    saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=False)
    calibration = load_config(booth).calibration
    calibration.write_text('{"newer": true}')
    _run(restore, saved, "--config", booth)
    assert calibration.read_text() == "{}"
    old = calibration.with_name(".calibration.json.before-restore")
    assert old.read_text() == '{"newer": true}'
    calibration.write_text('{"newest": true}')
    again = _run(restore, saved, "--config", booth)
    assert old.read_text() == '{"newer": true}'
    second = old.with_name(f"{old.name}-2")
    assert second.read_text() == '{"newest": true}'
    assert str(second) in again


def test_a_booth_in_a_terminal_is_running_too(booth: Path, tmp_path: Path) -> None:
    """A running one was restored, and scans went to where nobody looks."""
    saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=False)
    runtime = load_config(booth).runtime.folder
    runtime.mkdir(parents=True, exist_ok=True)
    with held(runtime / STATION_LOCK, BoothError("held")):
        with pytest.raises(BoothError, match=r"the booth is running \(station run\)"):
            _run(restore, saved, "--config", booth)
        with pytest.raises(BoothError, match=r"the booth is running \(station run\)"):
            _run(backup, tmp_path / "usb", "--with-scans", "--config", booth)


def test_a_database_is_saved_while_it_is_written(booth: Path, tmp_path: Path) -> None:
    """The rows since the last checkpoint are in a journal beside it: copies of files lack them."""
    with closing(sqlite3.connect(booth.parent / "console/console.sqlite")) as live:
        live.execute("PRAGMA journal_mode = WAL")
        live.execute("CREATE TABLE token (name TEXT)")
        live.execute("INSERT INTO token VALUES ('till')")
        live.commit()
        saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=False)
    copy = saved / "content/console/console.sqlite"
    with closing(sqlite3.connect(copy)) as restored:
        assert restored.execute("SELECT name FROM token").fetchall() == [("till",)]


def test_journals_that_a_killed_process_left_are_no_parts(booth: Path, tmp_path: Path) -> None:
    index = booth.parent / "spool/index.sqlite"
    with closing(sqlite3.connect(index)) as live:
        live.execute("PRAGMA journal_mode = WAL")
        live.execute("CREATE TABLE scans (name TEXT)")
        assert index.with_name("index.sqlite-shm").exists()
        saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=True)
    names = [path.name for path in (saved / "content/spool").iterdir()]
    assert "index.sqlite" in names
    assert not any(name.endswith(("-wal", "-shm")) for name in names)


@pytest.mark.parametrize("fault", ["changed", "missing", "extra", "version", "name", "no sums"])
def test_a_damaged_backup_changes_nothing(booth: Path, tmp_path: Path, fault: str) -> None:
    saved, _ = save(tmp_path / "usb", booth, load_config(booth), with_scans=False)
    manifest = json.loads((saved / "backup.json").read_text())
    if fault == "changed":
        (saved / "content/calibration.json").write_text("{ }")
    elif fault == "missing":
        (saved / "content/calibration.json").unlink()
    elif fault == "extra":
        (saved / "content/more").write_text("")
    elif fault == "version":
        manifest["version"] = 2
    elif fault == "no sums":
        del manifest["sha256"]
    else:
        manifest["parts"].append("etc/../../passwd")
    (saved / "backup.json").write_text(json.dumps(manifest))
    before = _content(booth.parent)
    with pytest.raises(FormatError):
        _run(restore, saved, "--config", booth)
    assert _content(booth.parent) == before


def test_a_backup_appears_whole_or_not_at_all(booth: Path, tmp_path: Path) -> None:
    (booth.parent / "calibrations/link").symlink_to("/etc/passwd")
    with pytest.raises(BoothError, match="symbolic link"):
        save(tmp_path / "usb", booth, load_config(booth), with_scans=False)
    assert list((tmp_path / "usb").iterdir()) == []


def test_every_file_of_a_booth_belongs_to_a_part(booth: Path) -> None:
    """A backup must not forget what a later version adds to the spool."""
    names = {part.name for part in parts(booth, load_config(booth))}
    assert names == {
        "booth.toml",
        "calibration.json",
        "calibrations",
        "spool/outbox",
        "console",
    }


def test_a_new_state_folder_gets_this_version(tmp_path: Path) -> None:
    assert migrate(tmp_path / "state") == 1
    assert json.loads((tmp_path / "state/state.json").read_text())["version"] == 1


def test_only_a_stations_state_is_migrated(tmp_path: Path) -> None:
    """A folder that was mistyped became a new state."""

    def migrated(folder: Path) -> Result:
        return CliRunner().invoke(migrate_command, ["--state", str(folder)])

    assert "does not exist" in migrated(tmp_path / "typo").output
    (other := tmp_path / "other").mkdir()
    (other / "letters").mkdir()
    assert "is no station's state folder" in str(migrated(other).exception)
    assert not (tmp_path / "typo").exists()
    assert not (other / "state.json").exists()
    (other / "spool").mkdir()
    assert migrated(other).exit_code == 0
    assert (other / "state.json").exists()


def test_migrations_run_one_by_one_and_go_on_after_a_crash(tmp_path: Path) -> None:
    done: list[int] = []

    def crash(folder: Path) -> None:
        raise RuntimeError(folder)

    migrate(tmp_path)
    with pytest.raises(RuntimeError):
        migrate(tmp_path, {1: lambda _: done.append(1), 2: crash}, 3)
    migrate(tmp_path, {1: lambda _: done.append(1), 2: lambda _: done.append(2)}, 3)
    assert done == [1, 2]
    assert json.loads((tmp_path / "state.json").read_text())["version"] == 3


@pytest.mark.parametrize("version", [0, 2, "1"])
def test_a_layout_that_is_not_known_is_refused(tmp_path: Path, version: object) -> None:
    path = tmp_path / "state.json"
    path.write_text(json.dumps({"format": "booth-state", "version": version}))
    before = path.read_bytes()
    with pytest.raises(FormatError, match="version"):
        migrate(tmp_path)
    assert path.read_bytes() == before


def test_the_package_refuses_what_its_programs_do_not_read() -> None:
    """preinst is a shell script that runs before the package's own code is there."""
    script = (Path(__file__).parents[2] / "deploy/package/body-booth/preinst").read_text()
    read = {
        "state": {*MIGRATIONS, VERSION},
        "calibration": rig.VERSIONS,
        "bundle": bundle.VERSIONS,
    }
    for name, versions in read.items():
        assert f'known_{name}="{" ".join(map(str, sorted(versions)))}"' in script
