"""Persistent credentials of the console: password, sessions, tokens and idempotency keys, stored as
hashes.

A session's or token's secret is 256 random bits, so one SHA-256 hides it well; the password is a
person's, so it is hashed with argon2id (RFC 9106) in a file of its own.
"""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import sqlite3
import threading
import time
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from station.core.errors import BoothError
from station.core.files import private_file, private_folder, write_bytes

Scope = Literal["read", "scan", "manage"]
SCOPES: tuple[Scope, ...] = ("read", "scan", "manage")
"""See scans and the booth; take scans and move the sensors; delete, calibrate."""
PASSWORD = "password"
SHORTEST_PASSWORD = 8
_DATABASE = "console.sqlite"
_DISK_ERRORS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_CANTOPEN: errno.EIO,
    sqlite3.SQLITE_READONLY: errno.EROFS,
}
"""Primary codes of sqlite for a disk that refuses, and the system's."""
_TOKEN_PREFIX = "booth_"
_KEYS_KEPT_S = 7 * 86_400.0
_SCHEMA = """
CREATE TABLE IF NOT EXISTS sessions (hash TEXT PRIMARY KEY, expires REAL NOT NULL);
CREATE TABLE IF NOT EXISTS tokens (
  name TEXT PRIMARY KEY, hash TEXT UNIQUE NOT NULL, scopes TEXT NOT NULL,
  made REAL NOT NULL, expires REAL);
CREATE TABLE IF NOT EXISTS keys (
  key TEXT PRIMARY KEY, request TEXT NOT NULL, answer TEXT NOT NULL, made REAL NOT NULL);
"""


@dataclass(frozen=True, slots=True)
class Token:
    """An access token of a program."""

    name: str
    scopes: tuple[Scope, ...]
    made: float
    """Seconds since 1970."""
    expires: float | None


class Vault:
    """The console's private folder. Safe for several threads and processes."""

    def __init__(self, folder: Path) -> None:
        self._folder = private_folder(folder)
        self._hasher = PasswordHasher()
        self._lock = threading.Lock()
        self._ended: set[str] = set()
        """Hashes of sessions that ended while the disk refused to delete them."""
        self._path = private_file(folder / _DATABASE)
        with _disk_told(self._path):
            self._database = sqlite3.connect(
                self._path, timeout=10, isolation_level=None, check_same_thread=False
            )
            self._database.execute("PRAGMA journal_mode = WAL")
            self._database.executescript(_SCHEMA)

    def close(self) -> None:
        self._database.close()

    def _run(self, query: str, *values: object) -> list[tuple[object, ...]]:
        """Run one statement.

        Raises:
            OSError: the disk refuses.
        """
        with _disk_told(self._path), self._lock:
            return self._database.execute(query, values).fetchall()

    @property
    def has_password(self) -> bool:
        return (self._folder / PASSWORD).exists()

    def set_password(self, password: str) -> None:
        """Hash and keep the operator's password; whoever is logged in has to log in again.

        Raises:
            BoothError: it is too short.
        """
        if len(password) < SHORTEST_PASSWORD:
            raise BoothError(f"the password needs {SHORTEST_PASSWORD} characters or more")
        stored = self._hasher.hash(_composed(password)).encode()
        write_bytes(self._folder / PASSWORD, stored, private=True)
        self._run("DELETE FROM sessions")

    def check_password(self, password: str) -> bool:
        """Whether it is the operator's; takes tens of milliseconds in either case."""
        try:
            stored = (self._folder / PASSWORD).read_text()
            return self._hasher.verify(stored, _composed(password))
        except (OSError, BoothError, VerificationError, InvalidHashError):
            return False

    def open_session(self, hours: float) -> str:
        """A new session's secret, for the cookie."""
        secret = secrets.token_urlsafe(32)
        now = time.time()
        self._run("DELETE FROM sessions WHERE expires < ?", now)
        for digest in tuple(self._ended):
            self._run("DELETE FROM sessions WHERE hash = ?", digest)
            self._ended.discard(digest)
        self._run("INSERT INTO sessions VALUES (?, ?)", _hash(secret), now + 3600 * hours)
        return secret

    def session_holds(self, secret: str) -> bool:
        query = "SELECT 1 FROM sessions WHERE hash = ? AND expires > ?"
        digest = _hash(secret)
        return digest not in self._ended and bool(self._run(query, digest, time.time()))

    def close_session(self, secret: str) -> None:
        """End a session. Where the disk refuses, this process alone knows until the next login."""
        digest = _hash(secret)
        try:
            self._run("DELETE FROM sessions WHERE hash = ?", digest)
        except OSError:
            # No other secret: anybody may send any number of them.
            if self.session_holds(secret):
                self._ended.add(digest)

    def make_token(self, name: str, scopes: Iterable[Scope], days: float | None) -> str:
        """A new token; shown once, only its hash is kept.

        Raises:
            BoothError: the name is taken.
        """
        secret = _TOKEN_PREFIX + secrets.token_urlsafe(32)
        now = time.time()
        expires = None if days is None else now + 86_400 * days
        try:
            self._run(
                "INSERT INTO tokens VALUES (?, ?, ?, ?, ?)",
                name, _hash(secret), " ".join(s for s in SCOPES if s in scopes), now, expires,
            )  # fmt: skip
        except sqlite3.IntegrityError:
            raise BoothError(
                f"there is a token {name} already; revoke it first: station token revoke {name}"
            ) from None
        return secret

    def tokens(self) -> list[Token]:
        rows = self._run("SELECT name, scopes, made, expires FROM tokens ORDER BY made")
        return [_token(row) for row in rows]

    def revoke_token(self, name: str) -> None:
        """Revoke a token, with immediate effect.

        Raises:
            BoothError: there is none of that name.
        """
        if not self._run("DELETE FROM tokens WHERE name = ? RETURNING name", name):
            known = ", ".join(token.name for token in self.tokens()) or "none"
            raise BoothError(f"there is no token {name} (there are: {known})")

    def find_token(self, secret: str) -> Token | None:
        """The token with this secret, unless it expired or was revoked."""
        rows = self._run(
            "SELECT name, scopes, made, expires FROM tokens WHERE hash = ? "
            "AND (expires IS NULL OR expires > ?)",
            _hash(secret),
            time.time(),
        )
        return _token(rows[0]) if rows else None

    def remember(self, key: str, request: str, answer: str) -> tuple[str, str]:
        """Record the answer for an idempotency key, unless it has one.

        Returns:
            (request, answer) recorded for the key.
        """
        now = time.time()
        self._run("DELETE FROM keys WHERE made < ?", now - _KEYS_KEPT_S)
        found: list[tuple[object, ...]] = []
        # Another request with this key may be refused between the two, and forget it. Nothing is
        # written where it has an answer, for which a full disk would have no room.
        while not found:
            found = self._run(
                "INSERT OR IGNORE INTO keys VALUES (?, ?, ?, ?) RETURNING request, answer",
                key, request, answer, now,
            ) or self._run("SELECT request, answer FROM keys WHERE key = ?", key)  # fmt: skip
        return str(found[0][0]), str(found[0][1])

    def forget(self, key: str) -> None:
        """Free an idempotency key: what it asked for was refused."""
        self._run("DELETE FROM keys WHERE key = ?", key)


@contextmanager
def _disk_told(path: Path) -> Iterator[None]:
    """Work on a database whose errors of the disk are told as such; sqlite's own would not be.

    Raises:
        OSError: the disk refuses.
    """
    try:
        yield
    except sqlite3.OperationalError as error:
        code = _DISK_ERRORS.get(error.sqlite_errorcode & 0xFF)
        if code is None:
            raise
        raise OSError(code, os.strerror(code), str(path)) from None


def _token(row: tuple[object, ...]) -> Token:
    name, scopes, made, expires = row
    granted = tuple(scope for scope in SCOPES if scope in str(scopes).split())
    return Token(
        str(name), granted, float(str(made)), None if expires is None else float(str(expires))
    )


def _composed(password: str) -> bytes:
    """UTF-8 of a password; keyboards differ in how they spell an accented letter.

    RFC 8265 (OpaqueString) prescribes NFC.

    Raises:
        BoothError: it holds what is no character.
    """
    try:
        return unicodedata.normalize("NFC", password).encode()
    except UnicodeEncodeError:
        raise BoothError("the password holds bytes that are not UTF-8; type another one") from None


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
