"""Ctrl-C for a process that a test starts."""

from __future__ import annotations

import signal


def heard() -> None:
    """Undo what a shell does that runs the tests in the background: it ignores Ctrl-C on behalf of
    all. For `preexec_fn`."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
