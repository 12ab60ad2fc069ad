"""Scans on disk: their ids, their notes, and the folders of their bundles and results.

    tmp/       being written
    scans/     a note of each scan
    queue/     accepted scans (bundles)
    work/      claimed by a worker (`station.core.spool`)
    outbox/    results, complete or not at all
    failed/    bundles that could not be reconstructed, with reason.json
    done/      bundles of delivered scans, until retention removes them

A note (`spool/scans/<scan id>.json`) records the order and its outcome. It is written before the
step that it describes, by one process at a time:

    control   armed       the operator's order
    sync      capturing   the order was taken up
    sync      failed      the verdict on a scan that was not accepted
    worker    delivering  the result is about to get its final name
    worker    delivered   it has it: from here on the result may be moved away
    worker    failed      no reconstruction

Where a scan's bundle and result are takes precedence over its note. A note
stays until the retention period ends, so that no scan is delivered twice.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import time
import unicodedata
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NewType, get_args

from station.core.errors import InputError, SpoolError
from station.core.files import (
    delete,
    entries_of,
    private_folder,
    publish_folder,
    read_bounded_json,
    write_json,
)

ScanId = NewType("ScanId", str)
"""A scan's id: 1 to 64 letters, digits, '-' and '_'. It names folders, so nothing else may."""
SCAN_ID = r"[A-Za-z0-9_-]{1,64}"
_SCAN_ID = re.compile(SCAN_ID)
_MAX_NOTE_BYTES = 1 << 16
_WRITTEN_S = 3600.0
"""Time after which nobody writes a note any more; it takes milliseconds."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

STATES = ("queue", "work", "outbox", "failed", "done")
REASON = "reason.json"
CANCELLED = "cancelled by the operator"
"""Reason of a scan that failed because it was cancelled."""
_BUNDLE_BYTES = 40 << 20
"""Larger than a bundle of forty depth frames."""
_FILES = 200
"""More than a bundle of forty depth frames and its result."""

Stage = Literal["armed", "capturing", "accepted", "delivering", "delivered", "failed"]


def scan_id_of(text: object) -> ScanId:
    """The scan id that a message, a command line or a folder's name gives.

    Raises:
        InputError: it is not a valid one.
    """
    if not isinstance(text, str) or _SCAN_ID.fullmatch(text) is None:
        raise InputError(
            f"{text!a:.80} is not a valid scan id: use 1 to 64 letters, digits, '-' and '_'"
        )
    return ScanId(text)


def is_scan_id(text: str) -> bool:
    """Whether a name is a scan id."""
    return _SCAN_ID.fullmatch(text) is not None


def plain_label(text: str) -> str:
    """A label in one line, without control characters, as lists show it: what looks the same is
    the same, also where letters and their accents are spelled apart."""
    text = unicodedata.normalize("NFC", text)
    return " ".join("".join(" " if unicodedata.category(c) == "Cc" else c for c in text).split())


def new_scan_id() -> ScanId:
    """An id that contains the time of the order (UTC)."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    return ScanId(f"{stamp}-{secrets.token_hex(2)}")


def boot_id() -> str:
    """Identifies the time since this machine was started; monotonic times hold within it."""
    return _BOOT_ID.read_text().strip() if _BOOT_ID.exists() else ""


@dataclass(frozen=True, slots=True)
class ScanNote:
    """Note of one scan."""

    scan_id: ScanId
    stage: Stage
    label: str = ""
    reason: str = ""
    valid_until_s: float = 0.0
    """Deadline for starting the order: host's monotonic clock of this boot."""
    boot: str = ""
    """The boot that the note was written in."""
    result: str = ""
    """Name under `tmp/` of the result that is being delivered."""
    verdict: str = ""
    """Verdict of the result: "ok" or "rescan"."""
    tries: int = 0
    """Number of reconstructions that failed on their own."""
    deaths: int = 0
    """Number of workers' processes that ended meanwhile; most likely no fault of the scan."""


def sweep_unwritten(folder: Path) -> None:
    """Remove files that were being written when their writer was killed."""
    for entry in entries_of(folder):
        with suppress(OSError):
            written_s = time.time() - entry.stat().st_mtime
            if entry.name[0] == "." and entry.is_file() and written_s > _WRITTEN_S:
                delete(entry)


def writer_lives(name: str) -> bool:
    """Whether the process that made a temporary name (`name.<pid>.<ns>`) still runs.

    Its number may be another process's by now, and is after each boot.
    """
    *_, pid, made_ns = ["", "", *name.split(".")]
    if not (pid.isdecimal() and made_ns.isdecimal()):
        return False
    try:
        # What follows the name, which may have any characters: its start, in ticks since the boot.
        started = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return False
    now_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    return started / os.sysconf("SC_CLK_TCK") <= int(made_ns) / 1e9 <= now_s


class Notes:
    """The notes of all scans of a spool."""

    def __init__(self, folder: Path) -> None:
        self.folder = private_folder(folder)

    def path(self, scan_id: ScanId) -> Path:
        return self.folder / f"{scan_id}.json"

    def read(self, scan_id: ScanId) -> ScanNote | None:
        """The note of a scan; None if there is none or it is damaged.

        Raises:
            OSError: the disk cannot be read.
        """
        try:
            return _note(read_bounded_json(self.path(scan_id), _MAX_NOTE_BYTES), scan_id)
        except (FileNotFoundError, ValueError, TypeError):
            return None

    def write(self, note: ScanNote, *, durable: bool) -> None:
        """Replace a scan's note.

        Args:
            durable: it must survive a loss of power, not only the end of a process.

        Raises:
            OSError: the disk cannot be written.
        """
        write_json(self.path(note.scan_id), asdict(note), durable=durable)

    def remove(self, scan_id: ScanId) -> None:
        self.path(scan_id).unlink(missing_ok=True)

    def sweep(self) -> None:
        """Remove what killed writers left beside the notes: it bears a scan's label, too."""
        sweep_unwritten(self.folder)

    def ids(self) -> list[ScanId]:
        """The ids of all scans that have a note."""
        names = (path.stem for path in entries_of(self.folder) if path.suffix == ".json")
        return sorted(ScanId(name) for name in names if is_scan_id(name))


_TYPES: dict[str, type | tuple[type, ...]] = {
    "valid_until_s": (int, float),
    "tries": int,
    "deaths": int,
}


def _note(document: Any, scan_id: ScanId) -> ScanNote:
    if not isinstance(document, dict) or document.get("stage") not in get_args(Stage):
        raise ValueError("not a scan's note")
    known = {item.name for item in fields(ScanNote)} - {"scan_id"}
    values = {key: value for key, value in document.items() if key in known}
    if not all(isinstance(value, _TYPES.get(key, str)) for key, value in values.items()):
        raise ValueError("a field of the scan's note has another type")
    note = ScanNote(scan_id=scan_id, **values)
    # What cannot be written again would end whoever goes on with the scan.
    json.dumps(values, allow_nan=False, ensure_ascii=False).encode()
    if note.result and not note.result.startswith(f"{scan_id}."):
        raise ValueError("another scan's result, or none")
    if note.stage == "delivering" and not note.result:
        raise ValueError("a result without a name")
    return note


class ScanFolders:
    """The folders of one spool and what is in them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("tmp", *STATES):
            private_folder(folder / name)
        self.notes = Notes(folder / "scans")

    def path(self, state: str, scan_id: str) -> Path:
        return self.folder / state / scan_id

    def temporary(self, name: str) -> Path:
        """A new name in the spool's own file system; the caller makes the folder."""
        made_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        return self.folder / "tmp" / f"{name}.{os.getpid()}.{made_ns}"

    def remove(self, folder: Path) -> None:
        """Delete a folder, or what else lies in its place: it leaves that at once, so that nobody
        finds a part of it there.

        What an interruption leaves is removed by the next sweep.
        """
        gone = self.temporary(folder.name if is_scan_id(folder.name) else "removed")
        os.rename(folder, gone)
        delete(gone)

    def check_space(self, min_free_mb: float) -> None:
        """Refuse a scan before it is taken, rather than lose it after.

        Raises:
            SpoolError: naming the folder and the space or the files that are missing, or a part
                of it in another file system, where nothing can be renamed to.
        """
        free = shutil.disk_usage(self.folder).free
        needed = min_free_mb * 1e6 + _BUNDLE_BYTES
        if free < needed:
            raise SpoolError(
                f"{self.folder} has {free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB are needed "
                "(spool.min_free_mb); free some space or run: station purge --old"
            )
        inodes = os.statvfs(self.folder)
        # File systems that have no fixed number of files say 0 of 0.
        if inodes.f_files and inodes.f_favail < _FILES:
            raise SpoolError(
                f"{self.folder} has room for {inodes.f_favail} more files, {_FILES} are needed; "
                "remove files from its file system or run: station purge --old"
            )
        for name in ("tmp", *STATES):
            if (self.folder / name).stat().st_dev != self.folder.stat().st_dev:
                raise SpoolError(
                    f"{self.folder / name} lies in another file system than {self.folder}; "
                    "move it back: a spool must be in one"
                )

    def where(self, scan_id: str) -> str | None:
        """The state of a scan, or None if it is in none of the folders.

        Folders are looked through against the order in which a scan passes them, and once more: a
        scan that is being renamed is in one of them at any moment, but not always in the one that
        is looked at.
        """
        for _ in range(2):
            for state in ("outbox", "failed", "work", "queue"):
                if self.path(state, scan_id).exists():
                    return state
        return None

    def note(self, scan_id: ScanId) -> ScanNote:
        """The note of a scan; of one that came without an order, a new one."""
        return self.notes.read(scan_id) or ScanNote(scan_id, "accepted")

    def submit(self, temporary: Path, scan_id: str) -> None:
        """Accept a finished bundle: from here on nothing short of losing the disk loses it.

        The same scan twice is one scan, also after its result was moved away.

        Raises:
            SpoolError: the id cannot name a scan.
            OSError: the disk refused; `where` tells whether the scan was accepted all the same.
        """
        if not is_scan_id(scan_id):
            raise SpoolError(f"{scan_id!a:.80} is not a valid scan id; the bundle is not accepted")
        note = self.notes.read(ScanId(scan_id))
        known = note is not None and note.stage in ("delivering", "delivered")
        if known or self.where(scan_id) is not None:
            shutil.rmtree(temporary, ignore_errors=True)
            return
        publish_folder(temporary, self.path("queue", scan_id))

    def waiting(self) -> list[ScanId]:
        """Scan ids in the queue, oldest first; other folders are ignored."""
        return self.scans_in("queue")

    def scans_in(self, state: str) -> list[ScanId]:
        """Scan ids in one of the folders, oldest first."""
        return scans_of(self.folder / state)


def scans_of(folder: Path) -> list[ScanId]:
    """Scan ids in a folder of a spool, oldest first, without what is no scan's folder; an OSError
    where the folder cannot be read."""
    with os.scandir(folder) as entries:
        return sorted(
            ScanId(entry.name)
            for entry in entries
            if is_scan_id(entry.name) and entry.is_dir(follow_symlinks=False)
        )


def count_scans(folder: Path) -> dict[str, int]:
    """State -> how many scans of a spool are in it; read-only.

    Raises:
        OSError: the spool belongs to another user.
    """
    found = {state: folder / state for state in STATES if (folder / state).is_dir()}
    counts = {state: len(scans_of(place)) for state, place in found.items()}
    return {state: count for state, count in counts.items() if count}


def failure_reason(folder: Path) -> str:
    """Reason why the bundle in a folder of failed/ was given up."""
    try:
        return str(read_bounded_json(folder / REASON, 1 << 16)["reason"])
    except (OSError, ValueError, KeyError, TypeError):
        return "unknown; see the workers' log"
