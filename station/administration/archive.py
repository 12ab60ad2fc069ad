"""Backups: their parts, and folders with a manifest of checksums, written and read."""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from station.administration.booth_file import CONFIG, STATE_FOLDER, VIRTUAL
from station.core.config import BoothConfig
from station.core.errors import BoothError, FormatError
from station.core.files import fsync_folder, private_folder, publish_folder, read_json, write_json
from station.sensors.freenect import FreenectCamera

MANIFEST, CONTENT = "backup.json", "content"
FORMAT = "booth-backup"
VERSION = 1


_DATABASE = ".sqlite"
_JOURNAL_ENDS = (f"{_DATABASE}-wal", f"{_DATABASE}-shm")
_UNFINISHED = ".tmp"
_MODE = 0o600
_MOST_RESTORES = 100
_SCRATCH = ("tmp", "locks")
"""Folders of a spool that mean nothing without the processes that use them."""


@dataclass(frozen=True, slots=True)
class Part:
    """A file or folder of the booth and its name in a backup."""

    name: str
    place: Path
    personal: bool = False
    """Scans of persons: saved only when asked for."""


def parts(config_path: Path, config: BoothConfig) -> list[Part]:
    """All parts of a booth that a backup may contain."""
    names = ["booth.toml", "calibration.json", "calibrations", "console"]
    names += [f"spool/{path.name}" for path in _entries(config.spool.folder)]
    if config_path == CONFIG:
        named = {config.calibration, config.calibrate.folder, config.spool.folder}
        named |= {config.console.folder, STATE_FOLDER / VIRTUAL}
        named |= {
            camera.recording.parent
            for camera in config.cameras
            if isinstance(camera, FreenectCamera) and camera.recording
        }
        names += [f"state/{path.name}" for path in _entries(STATE_FOLDER) if path not in named]
        names += [f"etc/{path.name}" for path in _entries(config_path.parent)]
    found = [part(name, config_path, config) for name in names if name != "etc/booth.toml"]
    return [one for one in found if one.place.exists()]


def part(name: str, config_path: Path, config: BoothConfig) -> Part:
    """Find the place of a backup's part in the booth that is configured.

    Raises:
        FormatError: no backup has such a part.
    """
    named = {
        "booth.toml": config_path,
        "calibration.json": config.calibration,
        "calibrations": config.calibrate.folder,
        "console": config.console.folder,
    }
    if name in named:
        return Part(name, named[name])
    folders = {
        "spool": config.spool.folder,
        "state": STATE_FOLDER,
        "etc": CONFIG.parent,
    }
    group, _, rest = name.partition("/")
    if group not in folders or not rest or "/" in rest or rest in (".", ".."):
        raise FormatError(f"a backup has no part called {name!r}")
    return Part(name, folders[group] / rest, personal=group == "spool")


def _entries(folder: Path) -> list[Path]:
    """List a folder without names that begin with a dot, scratch, and journals of databases."""
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [
        path
        for path in found
        if path.name[0] != "."
        and path.name not in _SCRATCH
        and not path.name.endswith(_JOURNAL_ENDS)
    ]


def save(
    folder: Path, config_path: Path, config: BoothConfig, *, with_scans: bool
) -> tuple[Path, int]:
    """Write a new backup into `folder`; it appears under its name when it is complete.

    Returns:
        the backup, and how many files it holds.
    """
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    final = folder.resolve() / f"booth-{stamp}"
    temporary = private_folder(folder.resolve() / f".booth-{stamp}.tmp")
    try:
        names = []
        for one in parts(config_path, config):
            if with_scans or not one.personal:
                _copy(one.place, temporary / CONTENT / one.name)
                names.append(one.name)
        sums = {str(path.relative_to(temporary)): sha256(path) for path in _files(temporary)}
        manifest = {"format": FORMAT, "version": VERSION, "created": stamp, "parts": names}
        write_json(temporary / MANIFEST, manifest | {"with_scans": with_scans, "sha256": sums})
        publish_folder(temporary, final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return final, len(sums)


def check(backup: Path) -> list[str]:
    """Read a whole backup and compare it with its manifest.

    Returns:
        the names of its parts.

    Raises:
        FormatError: it is not a backup, of an unknown version, or a file is missing, extra or
        changed.
    """
    manifest = read_json(backup / MANIFEST, format=FORMAT, versions=(VERSION,))
    expected, names = manifest.get("sha256"), manifest.get("parts")
    if not isinstance(expected, dict) or not isinstance(names, list):
        raise FormatError(f"{backup / MANIFEST} is damaged; use another backup")
    found = {str(path.relative_to(backup)) for path in _files(backup)} - {MANIFEST}
    for name in sorted(expected.keys() - found):
        raise FormatError(f"{backup} does not contain {name}; use another backup")
    for name in sorted(found - expected.keys()):
        raise FormatError(
            f"{backup} contains {name}, which its manifest does not list; use another backup"
        )
    for name, digest in expected.items():
        if sha256(backup / name) != digest:
            raise FormatError(f"{backup / name} has changed since it was saved; use another backup")
    return [str(name) for name in names]


def restore_part(backup: Path, one: Part) -> Path | None:
    """Restore a part completely or not at all; returns where what it replaces is kept."""
    fresh = one.place.with_name(f".{one.place.name}.restored")
    _remove(fresh)
    _copy(backup / CONTENT / one.name, fresh)
    old = None
    if one.place.exists():
        old = _free_place(one.place)
        one.place.rename(old)
    fresh.rename(one.place)
    fsync_folder(one.place.parent)
    return old


def _free_place(place: Path) -> Path:
    """A place for what a backup replaces; what was kept before stays."""
    numbers = ("", *(f"-{number}" for number in range(2, _MOST_RESTORES)))
    for number in numbers:
        free = place.with_name(f".{place.name}.before-restore{number}")
        if not free.exists():
            return free
    raise BoothError(f"too much is kept beside {place} (.before-restore); delete some of it")


def sha256(path: Path) -> str:
    """Hexadecimal digest of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def _copy(source: Path, target: Path) -> None:
    """Copy a file or folder, readable only by its owner, without files that are being written."""
    found = (source, *sorted(source.rglob("*")))
    for path in found:
        if path.is_symlink():
            raise BoothError(f"{path} is a symbolic link; a backup contains plain files only")
    for path in found:
        place = target / path.relative_to(source)
        if path.is_dir():
            private_folder(place)
        elif not path.name.endswith((*_JOURNAL_ENDS, _UNFINISHED)):
            private_folder(place.parent)
            _copy_file(path, place)


def _copy_file(source: Path, target: Path) -> None:
    """Copy a file; a database is copied as of its last transaction, even while it is being
    written.

    Its mode is not copied: USB sticks have file systems that refuse to set one.
    """
    target.touch(_MODE)
    if source.suffix == _DATABASE:
        with closing(sqlite3.connect(source)) as live, closing(sqlite3.connect(target)) as copy:
            live.backup(copy)
    else:
        shutil.copyfile(source, target)
    written = source.stat()
    os.utime(target, ns=(written.st_atime_ns, written.st_mtime_ns))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
