"""Ctrl-C, and a closed terminal, for a process that a test starts."""

from __future__ import annotations

import signal


def heard() -> None:
    """Undo what a shell does that runs the tests in the background, and nohup: they ignore Ctrl-C
    and a closed terminal on behalf of all. For `preexec_fn`."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
