"""Faults at the file calls of running processes: `faults.c`, built and steered from here."""

from __future__ import annotations

import errno
import mmap
import os
import shutil
import struct
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

ERRNOS = (errno.EIO, errno.ENOSPC, errno.EROFS, errno.EPERM, errno.EMFILE)
Action = Literal["count", "kill", "fail", "stall", "slow"]
_ACTIONS = {"count": 3, "kill": 1, "fail": 2, "stall": 3, "slow": 4}
_NEVER = 1 << 62
_SOURCE = Path(__file__).parent / "faults.c"
_WORDS, _FOLDER, _CALL = struct.Struct("9q"), 512, 64
_ACTION, _WALL = 3 * 8, 7 * 8
"""Offsets of these words, bytes."""


def build(folder: Path) -> Path:
    """Compile the library into a folder.

    Raises:
        RuntimeError: there is no C compiler.
    """
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("faults at file calls need a C compiler: apt install gcc libc6-dev")
    library = folder / "libfaults.so"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", str(_SOURCE), "-o", str(library), "-ldl"], check=True
    )
    return library


class Injection:
    """One role: all processes with that word on their command line."""

    def __init__(self, folder: Path, role: str) -> None:
        self._wall_s = 0
        size = _WORDS.size + _FOLDER + _CALL
        path = folder / role
        # The processes map the file at their start: one that is there is not made anew.
        with path.open("r+b" if path.exists() else "w+b") as stream:
            stream.truncate(size)
            self._memory = mmap.mmap(stream.fileno(), size)

    def arm(
        self,
        folder: Path,
        action: Action,
        value: int = 0,
        *,
        first: int = 1,
        count: int = _NEVER,
        every: int = 1,
        changes: bool = False,
    ) -> None:
        """Hit calls on files below a folder, from the first-th on every so many, so many in all.

        Args:
            action, value: "fail" with an errno, "stall" for milliseconds, "slow" to bytes a
                second, "kill"; "count" hits nothing.
            changes: count calls that change something alone (open to write, write, fsync, ...).
        """
        self.disarm()
        first = _NEVER if action == "count" else first
        where = os.fsencode(folder) + b"\0"
        self._memory[_WORDS.size : _WORDS.size + len(where)] = where
        last = min(_NEVER, first + (count - 1) * every)
        words = (0, first, last, 0, value, 0, int(changes), self._wall_s, every)
        self._memory[: _WORDS.size] = _WORDS.pack(*words)
        struct.pack_into("q", self._memory, _ACTION, _ACTIONS[action])

    def move_wall_clock(self, seconds: int) -> None:
        """Let the wall clock be ahead of the true one."""
        self._wall_s = seconds
        struct.pack_into("q", self._memory, _WALL, seconds)

    def disarm(self) -> None:
        """No more faults; the counts stay."""
        struct.pack_into("q", self._memory, _ACTION, 0)

    @property
    def calls(self) -> int:
        """Calls since it was armed."""
        return int(_WORDS.unpack_from(self._memory)[0])

    @property
    def hits(self) -> int:
        """Calls that met the fault."""
        return int(_WORDS.unpack_from(self._memory)[5])

    @property
    def last_call(self) -> str:
        """Name of the call that met it last."""
        start = _WORDS.size + _FOLDER
        return bytes(self._memory[start : start + _CALL]).split(b"\0")[0].decode()


def environment(library: Path, folder: Path, roles: Iterable[str]) -> dict[str, str]:
    """Variables that put the library into a process and its children."""
    return {
        "LD_PRELOAD": str(library),
        "BOOTH_FAULTS": str(folder),
        "BOOTH_FAULT_ROLES": " ".join(roles),
    }
