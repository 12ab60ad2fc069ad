"""All scans of a spool by label and time, found without reading every folder again.

A database beside the folders (`index.sqlite`) caches their contents. The folders are authoritative:
each query compares names, reads new folders and removes missing ones, and a missing or damaged
database is rebuilt from them.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from station.archive.records import PLACES, ScanRecord, ScanState, read_record
from station.core.errors import SpoolError
from station.core.files import private_file
from station.core.scans import ScanId, plain_label, scans_of
from station.core.spool import Spool

FILE = "index.sqlite"
_VERSION = 2
_OF_OTHER_TEXTS = 1
"""Version with the same tables, in which labels are sought as they were given."""
_BUSY_S, _PAUSE_S = 10.0, 0.01
_SETTLED_NS = 50_000_000
"""A folder that changed this recently may change again within the same tick of its clock."""
_UNREAD = "?"
"""Before the place of a scan that the disk refused to read; as a place, when it refused last."""
_AGAIN_NS = 10_000_000_000
"""Time until such a scan is read again. A failing disk may take seconds to refuse, for which all
other queries wait."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS scans (
  scan_id TEXT PRIMARY KEY, place TEXT NOT NULL, state TEXT NOT NULL,
  label TEXT NOT NULL, sought TEXT NOT NULL, booth TEXT NOT NULL,
  created TEXT NOT NULL, finished TEXT NOT NULL, reasons TEXT NOT NULL, seconds TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS by_time ON scans (created DESC, scan_id DESC);
CREATE TABLE IF NOT EXISTS folders (place TEXT PRIMARY KEY, changed_ns INTEGER NOT NULL);
"""
_COLUMNS = "scan_id, state, label, booth, created, finished, reasons, seconds"


class IndexBusyError(SpoolError):
    """The index cannot be read at the moment."""


class ScanIndex:
    """Scans by label and time. Safe for several processes at once."""

    def __init__(self, spool: Spool) -> None:
        self._spool = spool
        self._path = spool.folder / FILE
        self._held: sqlite3.Connection | None = None

    def hold(self) -> None:
        """Keep the database open until `release`; the last one to close it writes it to disk."""
        with suppress(sqlite3.Error):
            self._held = self._connect(shared=True)

    def release(self) -> None:
        """Undo `hold`, from any thread."""
        if self._held is not None:
            self._held.close()
            self._held = None

    def find(
        self,
        text: str = "",
        *,
        label: str | None = None,
        since: str = "",
        until: str = "",
        states: Sequence[ScanState] = (),
        before: tuple[str, str] | None = None,
        limit: int = 100,
    ) -> list[ScanRecord]:
        """Scans, the newest first.

        Args:
            text: text that the label or the scan id contains, ignoring case.
            label: the whole label, as lists show it.
            since, until: bounds of `created`, ISO 8601, the second one excluded.
            states: any of them; all if empty.
            before: (created, scan_id) of the last scan of the previous page.
            limit: maximum number of scans.
        """
        where, values = ["1"], list[str | int]()
        if text:
            where.append("(instr(sought, ?) OR instr(lower(scan_id), ?))")
            values += [plain_label(text).casefold(), text.lower()]
        if label is not None:
            # Earlier versions kept labels as they were given.
            where.append("sought = ? AND plain_label(label) = ?")
            plain = plain_label(label)
            values += [plain.casefold(), plain]
        if since:
            where.append("created >= ?")
            values.append(since)
        if until:
            where.append("created < ?")
            values.append(until)
        if states:
            where.append(f"state IN ({', '.join('?' * len(states))})")
            values += states
        if before:
            where.append("(created, scan_id) < (?, ?)")
            values += before
        query = (
            f"SELECT {_COLUMNS} FROM scans WHERE {' AND '.join(where)} "
            "ORDER BY created DESC, scan_id DESC LIMIT ?"
        )
        return [_record(row) for row in self._rows(query, *values, limit)]

    def get(self, scan_id: str) -> ScanRecord | None:
        """One scan, or None if no folder of the spool holds it."""
        rows = self._rows(f"SELECT {_COLUMNS} FROM scans WHERE scan_id = ?", scan_id)
        return _record(rows[0]) if rows else None

    def _rows(self, query: str, *values: str | int) -> list[tuple[str, ...]]:
        """Answer of the database, brought up to date with the folders.

        Raises:
            IndexBusyError: it cannot be used at the moment.
        """
        try:
            try:
                return self._fresh_rows(query, values)
            except sqlite3.OperationalError:
                # Locked for long, or a busy disk: others are at work in a sound file.
                raise
            except sqlite3.DatabaseError:
                # Damaged, or not this program's: its contents are rebuilt from the folders.
                for suffix in ("", "-wal", "-shm"):
                    Path(f"{self._path}{suffix}").unlink(missing_ok=True)
                return self._fresh_rows(query, values)
        except sqlite3.OperationalError as error:
            raise IndexBusyError(
                f"the index of scans cannot be used ({error}); try again"
            ) from None

    def _fresh_rows(self, query: str, values: Sequence[str | int]) -> list[tuple[str, ...]]:
        with closing(self._connect()) as database:
            self._refresh(database)
            return database.execute(query, values).fetchall()

    def _connect(self, *, shared: bool = False) -> sqlite3.Connection:
        try:
            _create(self._path)
        except OSError as error:
            raise sqlite3.OperationalError(error.strerror) from None
        database = sqlite3.connect(
            self._path, timeout=_BUSY_S, isolation_level=None, check_same_thread=not shared
        )
        try:
            database.create_function("plain_label", 1, plain_label, deterministic=True)
            _share(database)
            # The folders are what lasts: nobody waits for the disk for the sake of this cache.
            database.execute("PRAGMA synchronous = NORMAL")
            # Labels of purged scans must not stay behind in the file's free pages.
            database.execute("PRAGMA secure_delete = ON")
            found = database.execute("PRAGMA user_version").fetchone()[0]
            if found not in (0, _OF_OTHER_TEXTS, _VERSION):
                raise sqlite3.DatabaseError(f"version {found}")
            database.executescript(_SCHEMA)
            if found == _OF_OTHER_TEXTS:
                _empty(database)
            if found == 0:
                # Only once: whoever writes waits for all others who do.
                database.execute(f"PRAGMA user_version = {_VERSION}")
        except sqlite3.Error:
            database.close()
            raise
        return database

    def _refresh(self, database: sqlite3.Connection) -> None:
        """Update the database to the current contents of the folders."""
        changed = {place: self._changed_ns(place) for place in PLACES}
        known = dict(database.execute("SELECT place, changed_ns FROM folders"))
        refused_ns = known.pop(_UNREAD, None)
        if known == changed and not _is_over(refused_ns):
            return
        with _transaction(database):
            rows = dict(database.execute("SELECT scan_id, place FROM scans"))
            # Later folders overwrite: a result's bundle may not have been put away yet.
            found = {name: place for place in PLACES for name in _names(self._spool.folder / place)}
            gone = rows.keys() - found.keys()
            for scan_id in gone:
                database.execute("DELETE FROM scans WHERE scan_id = ?", [scan_id])
            # Another may have read them while this one waited for it.
            refused = "SELECT changed_ns FROM folders WHERE place = ?"
            refused_ns = next(database.execute(refused, [_UNREAD]), [None])[0]
            if again := _is_over(refused_ns):
                database.execute("DELETE FROM folders WHERE place = ?", [_UNREAD])
            all_read = True
            for scan_id, place in found.items():
                row = rows.get(scan_id)
                if row != place and (again or row != _UNREAD + place):
                    all_read &= self._take(database, place, scan_id)
            now_ns = time.time_ns()
            # A clock that was put back since does not come to the same tick before long.
            settled = {p: ns if abs(now_ns - ns) > _SETTLED_NS else 0 for p, ns in changed.items()}
            if not all_read:
                settled[_UNREAD] = now_ns
            database.executemany(
                "INSERT OR REPLACE INTO folders VALUES (?, ?)", list(settled.items())
            )
        if gone:
            # While others have the database open, its log keeps the labels of deleted scans.
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def _changed_ns(self, place: str) -> int:
        try:
            return (self._spool.folder / place).stat().st_mtime_ns
        except OSError:
            return 0

    def _take(self, database: sqlite3.Connection, place: str, scan_id: str) -> bool:
        """Read a scan anew; whether it could be read."""
        record = read_record(self._spool, place, scan_id)
        if record is None:
            return True
        if record.unreadable:
            place = _UNREAD + place
        database.execute(
            "INSERT OR REPLACE INTO scans VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                record.scan_id, place, record.state, record.label,
                plain_label(record.label).casefold(),
                record.booth, record.created, record.finished,
                json.dumps(record.reasons), json.dumps(dict(record.seconds)),
            ],
        )  # fmt: skip
        return not record.unreadable


def _is_over(refused_ns: int | None) -> bool:
    """Whether scans that the disk refused to read are to be read again."""
    return refused_ns is not None and not 0 <= time.time_ns() - refused_ns < _AGAIN_NS


def _create(path: Path) -> None:
    """Create an empty file that only its owner may read, if there is none.

    One that is there is not opened: to close it would drop the locks that this process' other
    connections have on it.
    """
    if path.exists():
        return
    beside = private_file(path.with_name(f".{path.name}.{uuid.uuid4().hex}"))
    try:
        with suppress(FileExistsError):
            os.link(beside, path)
    finally:
        beside.unlink()


def _share(database: sqlite3.Connection) -> None:
    """Let readers and a writer be at work at once. For this change SQLite waits for nobody."""
    deadline_s = time.monotonic() + _BUSY_S
    while True:
        try:
            database.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            busy = error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY
            if not busy or time.monotonic() > deadline_s:
                raise
        time.sleep(_PAUSE_S)


def _empty(database: sqlite3.Connection) -> None:
    """Let an older version's rows be read anew from the folders.

    Its file stays: the booth's processes start at the same time, and one that replaced it would
    take it away from the others.
    """
    with _transaction(database):
        # Another process may have done so meanwhile.
        if database.execute("PRAGMA user_version").fetchone()[0] == _OF_OTHER_TEXTS:
            database.execute("DELETE FROM scans")
            database.execute("DELETE FROM folders")
            database.execute(f"PRAGMA user_version = {_VERSION}")


@contextmanager
def _transaction(database: sqlite3.Connection) -> Iterator[None]:
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        database.execute("ROLLBACK")
        raise
    database.execute("COMMIT")


def _names(folder: Path) -> list[ScanId]:
    try:
        return scans_of(folder)
    except FileNotFoundError:
        return []
    except OSError as error:
        # Its scans would be missing until the folder changes, also where others wait for them.
        raise sqlite3.OperationalError(f"{folder}: {error.strerror}") from None


def _record(row: tuple[str, ...]) -> ScanRecord:
    scan_id, state, label, booth, created, finished, reasons, seconds = row
    return ScanRecord(
        scan_id,
        state,  # type: ignore[arg-type]  # only such are written
        label,
        booth,
        created,
        finished,
        tuple(json.loads(reasons)),
        json.loads(seconds),
    )
