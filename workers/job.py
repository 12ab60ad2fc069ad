"""One scan, bundle to result, readable as the paper's steps.

Zhou, Pan, Tong, Liu & Pan, "Fast 3D Human Body Reconstruction from Kinects" (2013): merge and
filter the depth images, fit the SCAPE model to them, measure the body.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

Progress = Callable[[str, float], None]
"""Called with the step's name and the share of the whole job that is done, 0 to 1."""


@dataclass(frozen=True, slots=True)
class JobSummary:
    """What an operator has to know of a result."""

    status: str
    """"ok" or "rescan"."""
    reasons: tuple[str, ...]


@dataclass(slots=True)
class Stopwatch:
    """Seconds by step, for result.json."""

    seconds: dict[str, float] = field(default_factory=dict)
    _start_s: float = field(default_factory=time.monotonic)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        start_s = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] = time.monotonic() - start_s

    def total_s(self) -> float:
        return time.monotonic() - self._start_s
