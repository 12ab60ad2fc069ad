"""booth.toml as `station setup` writes it: the cameras, and where a booth keeps its things."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from station.core.drivers import plain_name
from station.core.errors import BoothError, ConfigError
from station.core.files import held
from station.sensors.freenect import FreenectCamera

USUAL_NAMES = ("front-lower", "front-upper", "back-lower", "back-upper")


CONFIG = Path("/etc/booth/booth.toml")
STATE_FOLDER = Path("/var/lib/booth")
VIRTUAL = "virtual"
RUNTIME_FOLDER = Path("/run/booth")
"""Places of an installed booth; the units name the same ones. The virtual booth's recordings, in
the state folder, can be made anew."""


def administration(config_path: Path) -> AbstractContextManager[None]:
    """Only one command at a time sets up or restores a booth.

    Raises:
        BoothError: another one is at work.
    """
    busy = BoothError("another station setup or restore is at work; wait until it has ended")
    return held(config_path.with_name(".administration.lock"), busy)


def name_cameras(serials: Sequence[str], given: Sequence[str]) -> list[FreenectCamera]:
    """Cameras with their names: those given as NAME=SERIAL first, the usual names for the others.

    Raises:
        ConfigError: a pair is not NAME=SERIAL, or names a sensor that is not connected; a name
            cannot be used, or stands for two sensors; a sensor gets two names.
    """
    pairs: dict[str, str] = {}
    for words in given:
        name, separator, serial = words.partition("=")
        if not separator or serial not in serials:
            known = ", ".join(serials) or "none"
            raise ConfigError(f"--camera {words}: give NAME=SERIAL; connected sensors: {known}")
        _check_name(name, f"--camera {words}")
        if serial in pairs or name in pairs.values():
            raise ConfigError(f"--camera {words}: this name or this sensor is given twice")
        pairs[serial] = name
    free = iter(name for name in _names(len(serials)) if name not in pairs.values())
    return [
        FreenectCamera(name=pairs.get(serial) or next(free), driver="freenect", serial=serial)
        for serial in serials
    ]


def recorded_cameras(folder: Path) -> list[FreenectCamera]:
    """One camera for each recording in a folder, named as the recording is.

    Raises:
        ConfigError: there are no recordings, or the name of one cannot be a camera's.
    """
    found = sorted(index.parent for index in folder.resolve().glob("*/INDEX.txt"))
    if not found:
        raise ConfigError(f"{folder} holds no recordings (folders with INDEX.txt)")
    for path in found:
        _check_name(path.name, str(path))
    return [FreenectCamera(name=path.name, driver="freenect", recording=path) for path in found]


def _check_name(name: str, origin: str) -> None:
    try:
        plain_name(name)
    except ValueError as cause:
        raise ConfigError(f"{origin}: {cause}") from None


def booth_toml(cameras: Sequence[FreenectCamera], *, installed: bool) -> str:
    """The text of booth.toml.

    Args:
        installed: whether the folders are those of an installed booth, or lie beside booth.toml.
    """
    lines = ["# Written by `station setup`; booth.example.toml shows every key.", "version = 1"]
    if installed:
        lines.append(f'calibration = "{STATE_FOLDER / "calibration.json"}"')
    for camera in cameras:
        lines += ["", "[[cameras]]", f'name = "{camera.name}"', f'driver = "{camera.driver}"']
        if camera.serial:
            lines.append(f'serial = "{camera.serial}"')
        if camera.recording is not None:
            # Quotes and backslashes are escaped as in JSON.
            lines.append(f"recording = {json.dumps(str(camera.recording), ensure_ascii=False)}")
    if installed:
        lines += ["", "[calibrate]", f'folder = "{STATE_FOLDER / "calibrations"}"']
        lines += ["", "[spool]", f'folder = "{STATE_FOLDER / "spool"}"']
        lines += ["", "[console]", f'folder = "{STATE_FOLDER / "console"}"']
        lines += ["", "[runtime]", f'folder = "{RUNTIME_FOLDER}"']
    return "\n".join(lines) + "\n"


def _names(count: int) -> tuple[str, ...]:
    more = tuple(f"camera-{number}" for number in range(len(USUAL_NAMES) + 1, count + 1))
    return (*USUAL_NAMES, *more)
