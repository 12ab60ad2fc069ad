"""A log of who took, read or deleted which scan, without any body data.

One JSON object a line: time, who (operator, or a token's name), from where, what, which scan.
No label, no measurement, no file content.
"""

from __future__ import annotations

import json
import logging
import os
from datetime import UTC, datetime
from logging.handlers import RotatingFileHandler
from pathlib import Path

from station.core.files import private_folder

FILE = "audit.log"
_BYTES, _FILES = 5_000_000, 10


class AuditLog:
    """Appends; the oldest of ten files is dropped."""

    def __init__(self, folder: Path) -> None:
        private_folder(folder)
        mask = os.umask(0o177)
        try:
            self._handler = RotatingFileHandler(
                folder / FILE, maxBytes=_BYTES, backupCount=_FILES, encoding="utf-8"
            )
        finally:
            os.umask(mask)

    def note(self, who: str, address: str, what: str, scan_id: str = "") -> None:
        """One line."""
        entry = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "who": who,
            "from": address,
            "what": what,
            "scan": scan_id,
        }
        line = json.dumps(entry, ensure_ascii=True)
        self._handler.emit(logging.makeLogRecord({"msg": line, "levelno": logging.INFO}))

    def close(self) -> None:
        self._handler.close()
