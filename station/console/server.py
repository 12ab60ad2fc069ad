"""The server of the console: address, certificate, limits on slow senders."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
import threading
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, ClassVar

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from station.console.api.console import Console
from station.console.app import create_app
from station.console.security.certificate import CERTIFICATE, KEY
from station.core.config import ConsoleConfig
from station.core.errors import BoothError, ConfigError

_HEAD_S = 10.0
"""A request's head has to arrive within this; a slow sender cannot hold a connection open."""
_HEAD_BYTES = 16 << 10
_MAX_CONNECTIONS = 200
_MAX_OF_ONE_ADDRESS = 64
"""A tablet opens less than ten; whoever opens more keeps nobody else out."""
_STOP_S = 2
_TRY_S = 1.0
"""Period of trying to listen. A third of the time after which a process counts as silent."""
_SEND_BYTES = 128 << 10
"""Two of the four cameras' pictures. The kernel's own choice, 4 MB, is ten seconds of them, drawn
for a viewer that reads nothing."""


class PatientProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, but a request's head has to arrive in time, and none opens too many."""

    _open: ClassVar[Counter[str]] = Counter()
    """Address -> its connections."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._head_timer: asyncio.TimerHandle | None = None
        self._address = self.client[0] if self.client else ""
        self._open[self._address] += 1
        if self._open[self._address] > _MAX_OF_ONE_ADDRESS:
            transport.abort()
            return
        self._expect_head()

    def data_received(self, data: bytes) -> None:
        before = self.cycle
        waiting = before is None or before.response_complete
        if waiting and self._head_timer is None:
            self._expect_head()
        super().data_received(data)
        if self.cycle is not before:
            self._cancel_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._cancel_head()
        self.release(self._address)
        super().connection_lost(exc)

    @classmethod
    def release(cls, address: str) -> None:
        """Forget one connection of an address."""
        cls._open[address] -= 1
        if not cls._open[address]:
            del cls._open[address]

    def handle_websocket_upgrade(self, event: Any) -> None:
        self._cancel_head()
        super().handle_websocket_upgrade(event)

    def _expect_head(self) -> None:
        self._head_timer = self.loop.call_later(_HEAD_S, self._too_slow)

    def _cancel_head(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _too_slow(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()


class CountedWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket: it takes a connection over from `PatientProtocol`, with its count."""

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        PatientProtocol.release(self.client[0] if self.client else "")


class _Server(uvicorn.Server):
    """uvicorn's server, which leaves signals to the process: streams have to end first."""

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        yield


def check_exposure(config: ConsoleConfig, has_password: bool) -> bool:
    """Whether to speak TLS.

    Raises: ConfigError: other machines can connect, and there is no password or certificate.
    """
    certificate = config.folder / CERTIFICATE
    if is_loopback(config.host):
        return certificate.exists()
    if not has_password:
        raise ConfigError(
            f"console.host is {config.host}: others could use the booth; set a password first: "
            "station console --set-password"
        )
    if not certificate.exists():
        raise ConfigError(
            f"console.host is {config.host}: passwords and bodies would cross the network in "
            "clear; make a certificate first: station console --make-certificate"
        )
    return True


def is_loopback(host: str) -> bool:
    """Whether an address is this machine's own."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def serve(console: Console, log: logging.Logger, stop: threading.Event) -> None:
    """Serve until told to stop."""
    config = console.config.console
    secure = check_exposure(config, console.vault.has_password)
    listener = _awaited_listener(console, log, stop)
    if listener is None:
        return
    server = _Server(
        uvicorn.Config(
            create_app(console),
            http=PatientProtocol,
            ws=CountedWebSocket,
            ws_max_size=1 << 10,
            ws_max_queue=2,
            h11_max_incomplete_event_size=_HEAD_BYTES,
            limit_concurrency=_MAX_CONNECTIONS,
            timeout_keep_alive=30,
            timeout_graceful_shutdown=_STOP_S,
            ssl_certfile=str(config.folder / CERTIFICATE) if secure else None,
            ssl_keyfile=str(config.folder / KEY) if secure else None,
            server_header=False,
            access_log=False,
            log_config=None,
            log_level="warning",
        )
    )
    threading.Thread(target=_until, args=(stop, server, console), daemon=True).start()
    scheme = "https" if secure else "http"
    log.info("the console is at %s://%s:%d", scheme, config.host, config.port)
    server.run(sockets=[listener])


def _until(stop: threading.Event, server: uvicorn.Server, console: Console) -> None:
    stop.wait()
    console.end_streams()
    server.should_exit = True


def _awaited_listener(
    console: Console, log: logging.Logger, stop: threading.Event
) -> socket.socket | None:
    """The socket to serve at, as soon as it can be had; None if told to stop before.

    A process that ended for it could tell nobody the reason but its log.
    """
    config, told = console.config.console, ""
    while not stop.is_set():
        try:
            return _listener(config.host, config.port)
        except BoothError as error:
            if not told:
                console.heart.ready()
            if str(error) != told:
                told = str(error)
                log.error("%s", told)
            console.heart.beat()
            console.heart.report({"problems": [told]})
        stop.wait(_TRY_S)
    return None


def _listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
    try:
        listener.bind((host, port))
        listener.listen(128)
    except OSError as cause:
        listener.close()
        raise BoothError(
            f"the console cannot listen at {host}:{port} ({cause.strerror}); end the program that "
            "uses this port, or choose another console.port in booth.toml and restart the booth"
        ) from None
    return listener
