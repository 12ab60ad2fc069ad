"""Scan ids, and the note that is kept of each scan outside its bundle and result.

A note (`spool/scans/<scan id>.json`) records the order and its outcome. It is written before the
step that it describes, by one process at a time:

    control   armed       the operator's order
    sync      capturing   the order was taken up
    sync      failed      the verdict on a scan that was not accepted
    worker    delivering  the result is about to get its final name
    worker    delivered   it has it: from here on the result may be moved away
    worker    failed      no reconstruction

Where a scan's bundle and result lie (`station.core.spool`) takes precedence over its note. A note
stays until the retention period ends, so that no scan is delivered twice.
"""

from __future__ import annotations

import re
import secrets
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NewType, get_args

from station.core.errors import InputError
from station.core.files import private_folder, read_bounded_json, write_json

ScanId = NewType("ScanId", str)
"""A scan's id: 1 to 64 letters, digits, '-' and '_'. It names folders, so nothing else may."""
_SCAN_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MAX_NOTE_BYTES = 1 << 16
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

Stage = Literal["armed", "capturing", "accepted", "delivering", "delivered", "failed"]


def scan_id_of(text: object) -> ScanId:
    """The scan id that a message, a command line or a folder's name gives.

    Raises:
        InputError: it is not a valid one.
    """
    if not isinstance(text, str) or _SCAN_ID.fullmatch(text) is None:
        raise InputError(
            f"{text!a:.80} is not a valid scan id: use 1 to 64 letters, digits, '-' and '_', or "
            "leave it out to get a new one"
        )
    return ScanId(text)


def is_scan_id(text: str) -> bool:
    """Whether a name is a scan id."""
    return _SCAN_ID.fullmatch(text) is not None


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

    def ids(self) -> list[ScanId]:
        """The ids of all scans that have a note."""
        names = (entry.stem for entry in self.folder.glob("*.json"))
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
    return ScanNote(scan_id=scan_id, **values)
