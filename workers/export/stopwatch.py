"""Seconds by step, for result.json."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(slots=True)
class Stopwatch:
    """Measures named steps, which may have several parts, and the whole from its creation on."""

    seconds: dict[str, float] = field(default_factory=dict)
    _start_s: float = field(default_factory=time.monotonic)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        start_s = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start_s

    def total_s(self) -> float:
        return time.monotonic() - self._start_s
