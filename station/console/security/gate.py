"""The gate that every request passes first (sizes, host, origin), and every answer's headers."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from station.console.security.origin import host_allowed, same_origin

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]

LARGEST_BODY_BYTES = 64 << 10
"""Only labels and passwords are ever sent here."""
LARGEST_HEAD_BYTES = 16 << 10
SLOWEST_BODY_S = 10.0
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", _POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-frame-options", b"DENY"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), microphone=(), geolocation=()"),
)


class Gate:
    """ASGI middleware."""

    def __init__(self, app: App, names: frozenset[str]) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        host, origin = headers.get("host", ""), headers.get("origin")
        secure = scope["scheme"] in ("https", "wss")
        refusal = self._refusal(scope, host, origin, "https" if secure else "http", headers)
        if refusal is not None:
            await _refuse(scope, receive, send, *refusal)
            return

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                names = {name for name, _ in message["headers"]}
                message["headers"] = [
                    *message["headers"],
                    *(pair for pair in _HEADERS if pair[0] not in names),
                ]
                if b"cache-control" not in names:
                    message["headers"].append((b"cache-control", b"no-store"))
                if secure:
                    message["headers"].append((b"strict-transport-security", b"max-age=31536000"))
            await send(message)

        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        try:
            body = await _whole_body(receive)
        except TimeoutError:
            await _refuse(scope, receive, send, 408, *_TOO_SLOW)
            return
        if body is None:
            await _refuse(scope, receive, send, 413, *_TOO_LARGE)
            return
        await self._app(scope, _replayed(body, receive), answer)

    def _refusal(
        self, scope: Message, host: str, origin: str | None, scheme: str, headers: dict[str, str]
    ) -> tuple[int, str, str] | None:
        if not host_allowed(host, self._names):
            return (
                421, "unknown-host",
                f"this console is not {host[:80]!r}; add the name to console.names in booth.toml",
            )  # fmt: skip
        asks_only = scope["type"] == "http" and scope["method"] in _SAFE
        if origin is not None and not asks_only and not same_origin(origin, host, scheme):
            return 403, "cross-site", "this request was sent by a page of another site"
        cross = headers.get("sec-fetch-site") in ("cross-site", "same-site")
        navigation = headers.get("sec-fetch-mode") == "navigate"
        if cross and not (asks_only and navigation):
            return 403, "cross-site", "this request was sent by a page of another site"
        if scope["type"] == "websocket" and origin is None and "authorization" not in headers:
            return 403, "cross-site", "a WebSocket needs an Origin, or a token"
        if sum(len(name) + len(value) for name, value in scope["headers"]) > LARGEST_HEAD_BYTES:
            return 431, *_HEAD_TOO_LARGE
        length = headers.get("content-length", "0")
        if not length.isascii() or not length.isdigit() or int(length) > LARGEST_BODY_BYTES:
            return 413, *_TOO_LARGE
        return None


_HEAD_TOO_LARGE = ("head-too-large", f"at most {LARGEST_HEAD_BYTES} bytes of headers are accepted")
_TOO_LARGE = ("too-large", f"at most {LARGEST_BODY_BYTES} bytes are accepted")
_TOO_SLOW = ("too-slow", f"the request did not arrive within {SLOWEST_BODY_S:g} s")


async def _whole_body(receive: Receive) -> bytes | None:
    """The body of a request; None if it is too large.

    Raises:
        TimeoutError: it did not come in time.
    """
    body = b""
    async with asyncio.timeout(SLOWEST_BODY_S):
        while True:
            message = await receive()
            body += message.get("body", b"")
            if len(body) > LARGEST_BODY_BYTES:
                return None
            if not message.get("more_body", False):
                return body


def _replayed(body: bytes, receive: Receive) -> Receive:
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            # What comes after the body is the end of the connection.
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed


async def _refuse(
    scope: Message, receive: Receive, send: Send, status: int, kind: str, detail: str
) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": detail[:120]})
        return
    problem = {"type": f"/problems/{kind}", "title": kind.replace("-", " "), "status": status}
    body = json.dumps({**problem, "detail": detail}).encode()
    headers = [
        (b"content-type", b"application/problem+json"),
        (b"content-length", str(len(body)).encode()),
        (b"connection", b"close"),
        *_HEADERS,
    ]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
