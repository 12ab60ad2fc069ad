"""Handling of Ctrl-C while a command is still being loaded."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Let Ctrl-C end the process at once and without a word, as a shell's own commands end (130).

    Where modules are imported there is nothing to clean up, and Python shows where in them it was.
    Who ignores Ctrl-C, or handles it, goes on doing so.
    """
    before = signal.getsignal(signal.SIGINT)
    # Only the main thread handles signals.
    mine = threading.current_thread() is threading.main_thread()
    if before is not signal.default_int_handler or not mine:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
