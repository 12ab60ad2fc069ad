"""`station setup`: from connected cameras to a running booth."""

from __future__ import annotations

import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import click

from station.administration import units
from station.administration.booth_file import (
    CONFIG,
    STATE_FOLDER,
    VIRTUAL,
    administration,
    booth_toml,
    name_cameras,
    recorded_cameras,
)
from station.administration.connected import (
    connected_cameras,
    crowded_controllers,
    serial_numbers,
)
from station.administration.ownership import USER, give_to_booth, is_installed_root
from station.console.security.vault import Vault
from station.core.commands import at_most_one, config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config, option_for
from station.core.drivers import CameraConfig
from station.core.errors import BoothError, ConfigError, DriverError
from station.core.files import write_bytes
from station.core.service import answered
from station.sensors.freenect import FreenectCamera

_ANSWER_S = 30.0
"""Control answers a second after its start; cold disks and four more processes take longer."""
_COMMAND = "/usr/bin/station"
_PASSWORD_GROUPS = 4
"""Groups of 16 random bits: 64 bits cannot be guessed against argon2id."""
_UNREADABLE = ("/home", "/root", "/tmp", "/run/user")
"""Folders that the services do not see."""


@click.command()
@config_option
@click.option("--camera", "pairs", multiple=True, metavar="NAME=SERIAL", help="name a sensor")
@click.option(
    "--recordings",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="replay the recordings in this folder instead of sensors",
)
@click.option("--virtual", is_flag=True, help="replay a virtual booth with a person in it")
@click.option(
    "--replace", is_flag=True, help="write a new booth.toml; the old one is kept beside it"
)
@click.option("--start/--no-start", default=True, help="enable and start the booth's services")
def setup(
    config_path: Path | None,
    pairs: tuple[str, ...],
    recordings: Path | None,
    virtual: bool,
    replace: bool,
    start: bool,
) -> None:
    """Find the cameras, write booth.toml, start the booth, and list what remains to be done.

    A second call changes nothing that is already there: a booth.toml that exists is kept.

    \b
    Examples:
      station setup
      station setup --camera front-upper=A00366902406041A --replace
      station setup --virtual
    """
    at_most_one(virtual=virtual, recordings=recordings, camera=pairs)
    path = find_config(config_path).resolve()
    if path == CONFIG and not is_installed_root():
        raise ConfigError(f"{path} belongs to root: run it with sudo, or give another --config")
    with administration(path):
        left = _set_up(path, pairs, recordings, virtual=virtual, replace=replace, start=start)
    click.echo("still to do:" if left else 'ready: station scan --label "Order 1234"')
    for number, words in enumerate(left, 1):
        click.echo(f"  {number}. {words}")


def _set_up(
    path: Path,
    pairs: Sequence[str],
    recordings: Path | None,
    *,
    virtual: bool,
    replace: bool,
    start: bool,
) -> list[str]:
    """Set up the booth that booth.toml at `path` describes; returns what is left to do."""
    installed = path == CONFIG
    changed = replace or not path.exists()
    if changed:
        if virtual:
            recordings = _record_virtual_booth(_virtual_folder(path))
        cameras = _find(pairs, recordings, installed=installed)
        _write(path, cameras, installed=installed)
    elif virtual or recordings or pairs:
        raise ConfigError(
            f"{path} exists; --replace writes a new one and keeps the old one beside it"
        )
    config = load_config(path)
    if any(_recording_folder(camera) == _virtual_folder(path) for camera in config.cameras):
        # A restored booth comes without them.
        _record_virtual_booth(_virtual_folder(path))
    click.echo(f"{path}: {len(config.cameras)} cameras" + ("" if changed else ", kept"))
    for camera in config.cameras:
        click.echo(f"  {camera.name:<16} {_source(camera)}")
    if recordings is not None and changed:
        _take_calibration(recordings, config)
    if installed and config.console.enabled:
        _give_password(config)
    streaming = True
    if start and installed and units.installed():
        units.start(afresh=changed)
        _wait_for_control()
        click.echo("the booth is running and will start with the machine")
        streaming = subprocess.run([_COMMAND, "start"], check=False).returncode == 0
    left = [] if streaming else ["remove the cause of the error above, then run: station start"]
    return left + _what_is_left(config, path, started=start and installed)


def _find(
    pairs: Sequence[str], recordings: Path | None, *, installed: bool
) -> list[FreenectCamera]:
    if recordings is not None:
        folder = recordings.resolve()
        if installed and any(folder.is_relative_to(place) for place in _UNREADABLE):
            raise ConfigError(
                f"the services cannot read {folder}; copy it to {STATE_FOLDER}/recordings"
            )
        return recorded_cameras(folder)
    serials = serial_numbers()
    seen = connected_cameras()
    if not serials:
        if seen:
            raise DriverError(
                f"{len(seen)} Kinects are connected but cannot be opened; unplug them and plug "
                "them in again, so that the new permissions take effect"
            )
        raise DriverError(
            "no Kinect is connected: check USB and the sensors' own power supplies, or try the "
            "booth without any: station setup --virtual"
        )
    return name_cameras(serials, pairs)


def _write(path: Path, cameras: Sequence[FreenectCamera], *, installed: bool) -> None:
    if path.exists():
        shutil.copy2(path, path.with_name(f"{path.name}.old"))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, booth_toml(cameras, installed=installed).encode())
    if is_installed_root() and installed:
        # The services read it and do not write it.
        shutil.chown(path, "root", USER)
        path.chmod(0o640)


def _virtual_folder(config_path: Path) -> Path:
    return (STATE_FOLDER if config_path == CONFIG else config_path.parent) / VIRTUAL


def _recording_folder(camera: CameraConfig) -> Path | None:
    recorded = isinstance(camera, FreenectCamera) and camera.recording
    return recorded.parent if recorded else None


def _record_virtual_booth(out: Path) -> Path:
    """Record the virtual booth that is shipped where it is not yet, as the booth's user."""
    if (out / "calibration.json").exists():
        return out
    click.echo("recording what four Kinects see of a virtual person ...")
    user = {"user": USER, "group": USER} if is_installed_root() else {}
    done = subprocess.run(
        [sys.executable, "-m", "station.simulation.shipped", str(out)],
        cwd="/",
        check=False,
        capture_output=True,
        text=True,
        **user,  # type: ignore[call-overload]
    )
    if done.returncode:
        cause = str(done.stderr).strip().rpartition("\n")[2]
        raise BoothError(f"the virtual booth could not be recorded in {out.parent} ({cause})")
    return out


def _take_calibration(recordings: Path, config: BoothConfig) -> None:
    """Copy the calibration that comes with recordings of a virtual booth."""
    source = recordings / "calibration.json"
    if source.exists() and not config.calibration.exists():
        write_bytes(config.calibration, source.read_bytes())
        give_to_booth([config.calibration])
        click.echo(f"{config.calibration}: taken from {recordings}")


def _give_password(config: BoothConfig) -> None:
    """Set a password for the console if there is none, and show it once."""
    with closing(Vault(config.console.folder)) as vault:
        missing = not vault.has_password
        if missing:
            password = "-".join(secrets.token_hex(2) for _ in range(_PASSWORD_GROUPS))
            vault.set_password(password)
    if missing:
        click.echo(f"the console's password, shown only once: {password}")
        click.echo("  to change it: station console --set-password")
    give_to_booth([config.console.folder])


def _wait_for_control() -> None:
    """Wait until control answers; the command runs as the booth's user, who owns the sockets."""
    deadline_s = time.monotonic() + _ANSWER_S
    while True:
        told = [_COMMAND, "status", "--json"]
        done = subprocess.run(told, capture_output=True, text=True, check=False)
        if answered(done.stdout):
            return
        if time.monotonic() > deadline_s:
            cause = done.stderr.strip().removeprefix("error: ")
            raise BoothError(f"the booth does not respond ({cause}); see journalctl -u 'booth-*'")
        time.sleep(0.2)


def _source(camera: CameraConfig) -> str:
    if isinstance(camera, FreenectCamera):
        return camera.serial or str(camera.recording)
    return camera.driver


def compare_sensors(named: Sequence[str], connected: Sequence[str]) -> list[str]:
    """List what is left to do where the sensors that booth.toml names are not those connected."""
    missing, unknown = sorted({*named} - {*connected}), sorted({*connected} - {*named})
    left = [f"connect the sensors {', '.join(missing)}"] if missing else []
    if unknown:
        left.append(
            f"connected, but not in booth.toml: {', '.join(unknown)}; to replace a sensor, put the "
            "new number in place of the old one there"
        )
    return left


def _what_is_left(config: BoothConfig, path: Path, *, started: bool) -> list[str]:
    left: list[str] = []
    installed = path == CONFIG
    named = option_for(path)
    physical = [c.serial for c in config.cameras if isinstance(c, FreenectCamera) and c.serial]
    if physical:
        left += compare_sensors(physical, serial_numbers())
        for controller, count in crowded_controllers(connected_cameras()).items():
            left.append(
                f"{count} sensors share one USB controller ({controller}): connect each to one of "
                "its own"
            )
        left.append(
            "unplug one camera after another and check in `station status` that the right one "
            "goes silent; if not, run station setup --replace --camera NAME=SERIAL"
        )
    if not started:
        left.append("systemctl enable --now booth.target" if installed else f"station run{named}")
    if not config.calibration.exists():
        beside = "" if installed else ", in another terminal"
        left.append(f"station calibrate{named}{beside}")
    return left
