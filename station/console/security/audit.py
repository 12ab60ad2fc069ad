"""A log of who took, read or deleted which scan, without any body data.

One JSON object a line: time, who (operator, or a token's name), from where, what, which scan.
No label, no measurement, no file content.
"""

from __future__ import annotations

import json
import logging
from io import TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path

from station.core.files import open_private, private_folder, utc_now

FILE = "audit.log"
_BYTES, _FILES = 5_000_000, 10


class _PrivateFiles(RotatingFileHandler):
    """A log whose files, the next ones too, only their owner may read."""

    def _open(self) -> TextIOWrapper:
        return open(self.baseFilename, "a", encoding=self.encoding, opener=open_private)


class AuditLog:
    """Appends; the oldest of ten files is dropped."""

    def __init__(self, folder: Path) -> None:
        private_folder(folder)
        self._handler = _PrivateFiles(
            folder / FILE, maxBytes=_BYTES, backupCount=_FILES - 1, encoding="utf-8"
        )

    def note(self, who: str, address: str, what: str, scan_id: str = "") -> None:
        """One line."""
        entry = {
            "time": utc_now("milliseconds"),
            "who": who,
            "from": address,
            "what": what,
            "scan": scan_id,
        }
        line = json.dumps(entry, ensure_ascii=True)
        self._handler.emit(logging.makeLogRecord({"msg": line, "levelno": logging.INFO}))

    def close(self) -> None:
        self._handler.close()
