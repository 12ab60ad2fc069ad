"""Compilation of the reconstruction, for which the first one after an installation waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


class _Listener(event.Listener):
    """Tells once that something is being compiled."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        tell, self._tell = self._tell, None
        if tell is not None:
            tell()

    def on_end(self, event: Any) -> None:
        """Do nothing."""


@contextmanager
def compilation_told(tell: Callable[[], None]) -> Iterator[None]:
    """Call ``tell`` when the first function is compiled that no earlier process has kept."""
    with event.install_listener("numba:compile", _Listener(tell)):
        yield
