"""Whether something came into a folder or left it, told by the kernel at once (inotify(7))."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterable
from pathlib import Path

_CREATE, _DELETE, _MOVED_FROM, _MOVED_TO = 0x100, 0x200, 0x40, 0x80
_CHANGES = _CREATE | _DELETE | _MOVED_FROM | _MOVED_TO
_READ_BYTES = 1 << 16


class FolderChanges:
    """A file descriptor that becomes readable upon a change; -1 where the kernel gives none."""

    def __init__(self, folders: Iterable[Path]) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._descriptor: int = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        for folder in folders if self._descriptor >= 0 else ():
            libc.inotify_add_watch(self._descriptor, os.fsencode(folder), _CHANGES)

    def fileno(self) -> int:
        return self._descriptor

    def any(self) -> bool:
        """Whether anything has changed since the last call."""
        try:
            return bool(os.read(self._descriptor, _READ_BYTES))
        except BlockingIOError:
            return False

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
