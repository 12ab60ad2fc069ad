"""Numbered events: a program that lost its connection resumes where it stopped.

An id is `<start>-<number>`; `<start>` differs after each start of the console. A reader that asks
for events that this log no longer holds gets the event `reset` first and has to read everything
again. A slow reader only has a cursor that lags behind.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import threading
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any, Literal

from station.core.files import utc_now

Kind = Literal[
    "camera", "framesets", "scan", "job", "result", "fault", "calibration", "delivery", "reset"
]
KEPT = 2000
KEEP_ALIVE_S = 15.0


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened."""

    number: int
    kind: Kind
    data: str
    """JSON."""


class EventLog:
    """Written by threads, read by the server's loop."""

    def __init__(self) -> None:
        self.start = secrets.token_hex(4)
        self._events: deque[Event] = deque(maxlen=KEPT)
        self._number, self._closed = 0, False
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._news = asyncio.Event()

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Set the loop in which readers wait."""
        self._loop = loop

    def append(self, kind: Kind, data: dict[str, Any]) -> None:
        """Append an event; may be called from any thread."""
        now = utc_now("milliseconds")
        text = json.dumps({"time": now, **data}, ensure_ascii=False, allow_nan=False)
        with self._lock:
            self._number += 1
            self._events.append(Event(self._number, kind, text))
        self._tell()

    def close(self) -> None:
        """End all streams; may be called from any thread."""
        self._closed = True
        self._tell()

    def _tell(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        self._news.set()
        self._news = asyncio.Event()

    def after(self, number: int) -> list[Event]:
        """Events that are newer."""
        with self._lock:
            return [event for event in self._events if event.number > number]

    def _resume(self, last_id: str) -> tuple[int, bool]:
        """The number to resume after, and whether events in between are lost."""
        with self._lock:
            oldest = self._events[0].number if self._events else self._number + 1
            start, _, number = last_id.partition("-")
            if not last_id:
                return self._number, False
            if start != self.start or not (
                number.isascii() and number.isdigit() and len(number) < 20
            ):
                return self._number, True
            if int(number) > self._number:
                # Never given: waiting for it would be waiting for ever.
                return self._number, True
            return int(number), int(number) + 1 < oldest

    async def stream(self, last_id: str, follow: bool = True) -> AsyncIterator[bytes]:
        """Server-sent events (WHATWG HTML 9.2), until the log is closed or there are no more."""
        number, lost = self._resume(last_id)
        yield b"retry: 1000\n\n"
        if lost:
            yield self._packed(Event(number, "reset", "{}"))
        while not self._closed:
            news = self._news
            found = self.after(number)
            if found and found[0].number > number + 1 and number:
                # The reader missed more events than are kept.
                yield self._packed(Event(found[0].number - 1, "reset", "{}"))
            for event in found:
                number = event.number
                yield self._packed(event)
            if found:
                continue
            if not follow:
                return
            try:
                async with asyncio.timeout(KEEP_ALIVE_S):
                    await news.wait()
            except TimeoutError:
                yield b": still here\n\n"

    def _packed(self, event: Event) -> bytes:
        head = f"id: {self.start}-{event.number}\nevent: {event.kind}\n"
        return f"{head}data: {event.data}\n\n".encode()
