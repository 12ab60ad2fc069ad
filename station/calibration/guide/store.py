"""All calibrations of a booth, each in a folder named by its date; none is ever overwritten.

calibrations/20261121T100000Z/   calibration.json, report.json, what it was solved from
calibrations/unfinished/         the one that is being done
calibrations/abandoned-1/        one that was begun anew before it was solved
calibrations/calibrate.lock      held by whoever calibrates
calibration.json                 a copy of the one in use
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from station.calibration.detect.scene import StaticView
from station.calibration.guide.session import SCENE, SESSION, Session
from station.core.config import BoothConfig
from station.core.drivers import CameraConfig
from station.core.errors import CalibrationError, FormatError
from station.core.files import (
    entries_of,
    fsync_folder,
    held,
    private_folder,
    publish_folder,
    write_bytes,
    write_json,
)
from station.core.rig import Rig
from station.sensors.identity import calibrated_serials, configured_serials, mismatch

CALIBRATION, REPORT, UNFINISHED = "calibration.json", "report.json", "unfinished"
_log = logging.getLogger(__name__)
_ABANDONED, LOCK = "abandoned-", "calibrate.lock"


@dataclass(frozen=True, slots=True)
class Entry:
    """One stored calibration."""

    name: str
    """Its date: 20261121T100000Z."""
    folder: Path
    rig: Rig
    in_use: bool


@dataclass(frozen=True, slots=True)
class CalibrationStore:
    """The folder of dated calibrations, and the file that the booth reads."""

    folder: Path
    in_use: Path

    @classmethod
    def of(cls, config: BoothConfig) -> CalibrationStore:
        """The store of a booth."""
        return cls(config.calibrate.folder, config.calibration)

    def locked(self) -> AbstractContextManager[None]:
        """Hold the store alone: two that calibrate at once would write into one journal.

        Raises:
            CalibrationError: another process holds it.
        """
        busy = f"another station calibrate is at work in {self.folder}; end it first"
        return held(self.folder / LOCK, CalibrationError(busy))

    @property
    def unfinished(self) -> Path:
        """Folder of the unfinished calibration."""
        return self.folder / UNFINISHED

    def entries(self) -> list[Entry]:
        """All stored calibrations that can be read, oldest first; each other one is a warning."""
        found = []
        for folder in self._folders():
            try:
                rig = Rig.load(folder / CALIBRATION)
            except FormatError as cause:
                # One damaged file must not hide the sound ones.
                _log.warning("  %s  cannot be used: %s", folder.name, cause)
                continue
            found.append(Entry(folder.name, folder, rig, self._is_used(folder)))
        return found

    def abandoned(self) -> list[tuple[str, str]]:
        """Folders of abandoned calibrations, and when each was begun, in that order.

        One that was killed while it began has no session: nothing was seen in it.
        """
        found = []
        begun = [path.parent for path in self.folder.glob(f"{_ABANDONED}*/{SESSION}")]
        for folder in sorted(begun, key=lambda folder: (len(folder.name), folder.name)):
            try:
                found.append((folder.name, Session.begun(folder)))
            except (FormatError, OSError) as cause:
                _log.warning("  %s  cannot be read: %s", folder.name, cause)
        return found

    def name_in_use(self) -> str:
        """Name of the calibration that the booth reads; empty if it is none of the stored ones."""
        return next((folder.name for folder in self._folders() if self._is_used(folder)), "")

    def from_elsewhere(self) -> bool:
        """Whether the booth reads a calibration that is none of the stored ones."""
        return self.in_use.exists() and not self.name_in_use()

    def rig_in_use(self) -> Rig:
        """The calibration that the booth reads.

        Raises:
            CalibrationError: there is none; names a stored one that could take its place.
            FormatError: it cannot be used.
        """
        if not self.in_use.exists():
            raise CalibrationError(self.missing_words())
        return Rig.load(self.in_use)

    def missing_words(self) -> str:
        """Words on a booth without a calibration in use, and how it gets one."""
        newest = self.newest()
        if newest is None:
            return "the booth is not calibrated, and takes no scans: run station calibrate"
        return (
            f"{self.in_use} is missing, and no scans are taken; put the newest calibration back "
            f"with station calibrate --use {newest} (--list shows all), or run station calibrate"
        )

    def newest(self) -> str | None:
        """Name of the last stored calibration, if there is one."""
        return max((folder.name for folder in self._folders()), default=None)

    def _folders(self) -> list[Path]:
        return [
            folder
            for folder in entries_of(self.folder)
            if not folder.name.startswith((UNFINISHED, _ABANDONED, "."))
            and (folder / CALIBRATION).exists()
        ]

    def _is_used(self, folder: Path) -> bool:
        if not self.in_use.exists():
            return False
        return (folder / CALIBRATION).read_bytes() == self.in_use.read_bytes()

    def finish(self, rig: Rig, report: dict[str, Any]) -> Entry:
        """Give the unfinished calibration its date and put it beside the others.

        Raises:
            CalibrationError: there is one of the same second already.
        """
        rig.save(self.unfinished / CALIBRATION)
        write_json(self.unfinished / REPORT, report)
        final = self.folder / dated(rig.created)
        try:
            publish_folder(self.unfinished, final)
        except FileExistsError as cause:
            raise CalibrationError(f"{cause}; solve again in a second") from None
        return Entry(final.name, final, rig, in_use=False)

    def resumable(self) -> str | None:
        """Name of the calibration in use, if what it was solved from is kept."""
        name = self.name_in_use()
        return name if name and (self.folder / name / SESSION).exists() else None

    def reopen(self, name: str) -> Session:
        """Take up a stored calibration again, for further steps."""
        for left in self.folder.glob(f".{UNFINISHED}.*"):
            shutil.rmtree(left)
        # A calibration that was killed while it began has no session: nothing was seen in it.
        self.abandon()
        copy = self.folder / f".{UNFINISHED}.{os.getpid()}"
        solved = shutil.ignore_patterns(CALIBRATION, REPORT)
        shutil.copytree(self.folder / name, copy, ignore=solved, copy_function=shutil.copyfile)
        Session.note_origin(copy, name)
        publish_folder(copy, self.unfinished)
        return Session.load(self.unfinished)

    def abandon(self) -> Path | None:
        """Make room for a new calibration; what the unfinished one has seen is kept."""
        if not self.unfinished.exists():
            return None
        number = 1
        while (kept := self.folder / f"{_ABANDONED}{number}").exists():
            number += 1
        os.rename(self.unfinished, kept)
        fsync_folder(self.folder)
        return kept

    def use(self, name: str, cameras: Sequence[CameraConfig] = ()) -> Entry:
        """Make a stored calibration the one that the booth reads.

        A calibration.json that came from elsewhere is put into the store first.

        Args:
            name: its date.
            cameras: the booth's; where they are given, a calibration of others is refused.

        Raises:
            CalibrationError: there is none of that name; names those that there are. Or it is of
                other cameras or sensors.
        """
        # A damaged one must not stand in the way of the others.
        folders = {folder.name: folder for folder in self._folders()}
        if name not in folders:
            known = ", ".join(folders) or "none"
            raise CalibrationError(f"there is no calibration {name} in {self.folder} ({known})")
        rig = Rig.load(folders[name] / CALIBRATION)
        words = mismatch(calibrated_serials(rig.cameras), configured_serials(cameras))
        if cameras and words:
            raise CalibrationError(f"calibration {name} cannot be used: {words}")
        if self.from_elsewhere():
            self._adopt()
        write_bytes(self.in_use, (folders[name] / CALIBRATION).read_bytes())
        return Entry(name, folders[name], rig, in_use=True)

    def _adopt(self) -> None:
        """Keep the file in use, which is not one of ours, under the date that it bears."""
        name = dated(Rig.load(self.in_use).created)
        folder, number = self.folder / f"{name}-found", 1
        while folder.exists():
            number += 1
            folder = self.folder / f"{name}-found-{number}"
        temporary = private_folder(self.folder / f".{folder.name}.{os.getpid()}")
        shutil.copyfile(self.in_use, temporary / CALIBRATION)
        publish_folder(temporary, folder)

    def scene(self) -> dict[str, StaticView]:
        """The empty booth as it was at the calibration in use; nothing where none was stored.

        Raises:
            FormatError: naming the file that cannot be read.
            OSError: a folder cannot be read.
        """
        for folder in self._folders():
            if self._is_used(folder):
                cameras = Rig.load(folder / CALIBRATION).cameras
                sizes = {name: (camera.height, camera.width) for name, camera in cameras.items()}
                views = [path for path in entries_of(folder / SCENE) if path.suffix == ".npz"]
                return {path.stem: StaticView.load(path, sizes.get(path.stem)) for path in views}
        return {}


def dated(created: str) -> str:
    """A folder's name from an ISO 8601 date: 2026-11-21T10:00:00Z -> 20261121T100000Z."""
    name = "".join(character for character in created if character.isalnum())
    if not name:
        raise CalibrationError("a calibration without a date cannot be stored")
    return name
