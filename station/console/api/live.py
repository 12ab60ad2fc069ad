"""Events as they happen, and the cameras' pictures."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, WebSocket
from fastapi.responses import StreamingResponse
from starlette.websockets import WebSocketDisconnect

from station.console.api.console import Booth, Reader, caller_of, console_of
from station.console.api.problems import ProblemError, responses

router = APIRouter(tags=["live"])
_RECHECK_S = 10.0
"""A viewer whose session ended or whose token was revoked is disconnected within this time."""
_PATIENCE_S = 60.0
"""A viewer that takes no picture for this long is disconnected."""


@router.get(
    "/events",
    response_class=StreamingResponse,
    responses={
        **responses(),
        200: {
            "description": "Server-sent events: camera, framesets, scan, job, result, fault, "
            'calibration, delivery; a scan may also be "deleted", or "taken" by a program or '
            "because its time was over; `reset` says that some were missed",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        },
    },
)
async def events(
    request: Request,
    console: Booth,
    caller: Reader,  # noqa: ARG001
    last_event_id: Annotated[str, Header(max_length=60)] = "",
    follow: Annotated[bool, Query(description="false: existing events only")] = True,
) -> StreamingResponse:
    """Events as they happen. With Last-Event-ID a program resumes where it stopped."""
    stream = _while_allowed(request, console.events.stream(last_event_id, follow))
    return StreamingResponse(stream, media_type="text/event-stream")


async def _while_allowed(request: Request, stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    checked_s = time.monotonic()
    async for part in stream:
        if time.monotonic() - checked_s > _RECHECK_S:
            checked_s = time.monotonic()
            try:
                caller_of(request)
            except ProblemError:
                return
        yield part


@router.websocket("/pictures")
async def pictures(socket: WebSocket) -> None:
    """Depth pictures: each message that the viewer sends asks for the next one."""
    console = console_of(socket)
    try:
        allowed = "read" in caller_of(socket).scopes
    except ProblemError:
        allowed = False
    if not allowed:
        await socket.close(code=1008, reason="log in first")
        return
    await socket.accept()
    checked_s = time.monotonic()
    try:
        while not console.closing.is_set():
            async with asyncio.timeout(_PATIENCE_S):
                await socket.receive_text()
                packed = await console.pictures.next()
                await socket.send_bytes(packed)
            if time.monotonic() - checked_s > _RECHECK_S:
                checked_s = time.monotonic()
                caller_of(socket)
    except (WebSocketDisconnect, RuntimeError, KeyError):
        return
    except (TimeoutError, ProblemError):
        await socket.close(code=1008)
