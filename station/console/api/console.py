"""State shared by all requests, and their senders."""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from fastapi import Depends, Header
from fastapi import Path as PathParameter
from starlette.requests import HTTPConnection

from station.archive.index import ScanIndex
from station.archive.records import ScanRecord
from station.console.api.problems import ProblemError
from station.console.live.cameras import Pictures
from station.console.live.countdown import ScanCountdown
from station.console.live.events import EventLog
from station.console.live.tasks import Tasks
from station.console.live.watch import Watch
from station.console.security.audit import AuditLog
from station.console.security.throttle import AT_ONCE, LoginThrottle
from station.console.security.vault import SCOPES, Scope, Vault
from station.core.config import BoothConfig
from station.core.scans import SCAN_ID
from station.core.service import Heartbeat
from station.core.spool import Spool
from station.handover.ledger import Ledger

COOKIE = "booth_session"


@dataclass(slots=True)
class Console:
    """The console's parts."""

    config: BoothConfig
    config_path: Path
    log: logging.Logger
    vault: Vault = field(init=False)
    audit: AuditLog = field(init=False)
    spool: Spool = field(init=False)
    index: ScanIndex = field(init=False)
    events: EventLog = field(init=False)
    watch: Watch = field(init=False)
    pictures: Pictures = field(init=False)
    countdown: ScanCountdown = field(init=False)
    tasks: Tasks = field(init=False)
    ledger: Ledger = field(init=False)
    throttle: LoginThrottle = field(init=False)
    checking: threading.BoundedSemaphore = field(init=False)
    """Held by each password that is being checked."""
    heart: Heartbeat = field(init=False)
    closing: threading.Event = field(init=False, default_factory=threading.Event)

    def __post_init__(self) -> None:
        folder = self.config.console.folder
        self.vault, self.audit = Vault(folder), AuditLog(folder)
        self.spool = Spool(self.config.spool.folder)
        self.index, self.events = ScanIndex(self.spool), EventLog()
        self.ledger = Ledger(self.config.spool.folder)
        self.watch = Watch(self.config, self.events, self.log)
        self.pictures = Pictures(self.config, self.log)
        self.countdown = ScanCountdown(self.config, self.events)
        self.tasks = Tasks(self.config_path, self.events)
        self.throttle, self.checking = LoginThrottle(), threading.BoundedSemaphore(AT_ONCE)
        self.heart = Heartbeat(self.config.runtime.folder, "console")

    def start(self) -> None:
        self.watch.start()
        self.pictures.start()

    def end_streams(self) -> None:
        """Let the answers end that go on for ever: uvicorn cuts them off, with a traceback."""
        self.closing.set()
        self.events.close()

    def close(self) -> None:
        self.end_streams()
        self.tasks.close()
        self.watch.close()
        self.pictures.close()
        self.audit.close()
        self.vault.close()

    def record(self, scan_id: str) -> ScanRecord:
        """A scan on disk.

        Raises:
            ProblemError: 404, there is none.
        """
        found = self.index.get(scan_id)
        if found is None:
            raise ProblemError(404, "no-such-scan", f"there is no scan {scan_id}")
        return found

    def result(self, scan_id: str) -> tuple[ScanRecord, Path]:
        """A delivered scan and its folder.

        Raises:
            ProblemError: 404, it has no result (yet).
        """
        found = self.record(scan_id)
        if found.state not in ("delivered", "rescan"):
            raise ProblemError(
                404, "no-result", f"scan {scan_id} has no result; its state is {found.state}"
            )
        return found, self.spool.path("outbox", scan_id)


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request."""

    name: str
    """The token's name, or "operator"."""
    address: str
    scopes: tuple[Scope, ...]


def console_of(connection: HTTPConnection) -> Console:
    """The console that serves a request."""
    console = connection.app.state.console
    assert isinstance(console, Console)
    return console


def caller_of(connection: HTTPConnection) -> Caller:
    """The sender of a request, or of a WebSocket.

    Raises:
        ProblemError: 401, the sender is unknown.
    """
    vault = console_of(connection).vault
    address = connection.client.host if connection.client else "?"
    given = connection.headers.get("authorization")
    if given is not None:
        kind, _, secret = given.partition(" ")
        token = vault.find_token(secret.strip()) if kind.lower() == "bearer" else None
        if token is None:
            raise _unknown("the token is unknown, expired or revoked; see station token list")
        return Caller(token.name, address, token.scopes)
    cookie = connection.cookies.get(COOKIE)
    # Without a password the console listens to this machine alone.
    if not vault.has_password or (cookie is not None and vault.session_holds(cookie)):
        return Caller("operator", address, SCOPES)
    raise _unknown("log in first, or give a token")


def _unknown(detail: str) -> ProblemError:
    return ProblemError(401, "not-logged-in", detail, {"WWW-Authenticate": 'Bearer realm="booth"'})


def need(scope: Scope) -> Callable[[HTTPConnection], Caller]:
    """Dependency that yields the caller if it has a scope."""

    def check(connection: HTTPConnection) -> Caller:
        caller = caller_of(connection)
        if scope not in caller.scopes:
            raise ProblemError(
                403, "not-allowed",
                f"this needs the scope {scope}; the token {caller.name} has "
                f"{', '.join(caller.scopes) or 'none'}",
            )  # fmt: skip
        return caller

    return check


async def _console(connection: HTTPConnection) -> Console:
    # As a coroutine it costs no thread, unlike a function.
    return console_of(connection)


Booth = Annotated[Console, Depends(_console)]
Reader = Annotated[Caller, Depends(need("read"))]
Scanner = Annotated[Caller, Depends(need("scan"))]
Manager = Annotated[Caller, Depends(need("manage"))]
ScanId = Annotated[str, PathParameter(pattern=f"^{SCAN_ID}$", examples=["20261121T100000Z-7f3a"])]
IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        pattern=r"^[\x20-\x7e]{1,200}$",
        description="a request with the same key is carried out only once",
    ),
]


def key_of(caller: str, key: str) -> str:
    """An idempotency key as it is kept: each caller has its own."""
    return hashlib.sha256(f"{caller}\0{key}".encode()).hexdigest()


def once(console: Console, caller: Caller, key: str | None, request: str, answer: str) -> str:
    """The answer recorded for a key: `answer` if the key is new, else the first answer.

    Raises:
        ProblemError: 422, the key was used for another request.
    """
    if key is None:
        return answer
    digest = key_of(caller.name, key)
    body = hashlib.sha256(request.encode()).hexdigest()
    first_body, first_answer = console.vault.remember(digest, body, answer)
    if first_body != body:
        raise ProblemError(
            422, "idempotency-key-reused", "this Idempotency-Key was used for another request"
        )
    return first_answer
