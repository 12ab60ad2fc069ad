"""Waiting for what other threads and processes do, never for ever."""

from __future__ import annotations

import time
from collections.abc import Callable

PAUSE_S = 0.02


def wait_until(true: Callable[[], object], what: str = "", limit_s: float = 60.0) -> None:
    """Wait until something is true.

    Raises:
        AssertionError: it is not within the limit.
    """
    deadline_s = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < deadline_s, f"{what}: not within {limit_s:g} s".lstrip(": ")
        time.sleep(PAUSE_S)
