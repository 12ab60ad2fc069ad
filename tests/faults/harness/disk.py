"""Lives of scans, results and calibrations, cut at every call that the disk sees.

Run as a program with `faults.c` loaded (`disk_rows` does so): each point is a process of its own,
forked from a warm one, that is killed, or meets an errno, at its n-th file call. New processes go
on from what is on disk.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import later_lives
import lives
from injection import ERRNOS, Action, Injection, build, environment
from table import Row

_ROLE = "cut-lives"
_TRIES = 3
"""Processes that go on, one after the other, once the disk is well again."""


@dataclass(frozen=True, slots=True)
class Life:
    """Something that is written, and how to tell whether it is there as it should be."""

    name: str
    live: Callable[[Path], None]
    prepare: Callable[[Path], object]
    sound: Callable[[Path], bool]
    """At any time."""
    ended: Callable[[Path], bool]
    """At the end."""


def _scan(name: str, write_result: Callable[[Path], None], moved: bool) -> Life:
    """A scan whose result is taken from the outbox at once, or only at the end."""
    taken: dict[Path, int] = {}

    def sound(folder: Path) -> bool:
        taken[folder] = lives.delivered(folder) if moved else 0
        return taken[folder] <= 1 and lives.kept_bundles(folder) <= 1

    def ended(folder: Path) -> bool:
        once = taken.get(folder, 0) + lives.delivered(folder) == 1
        return once and lives.kept_bundles(folder) == 1

    return Life(name, lambda f: lives.scan(f, write_result), lambda _: None, sound, ended)


def _lives(real: bool) -> list[Life]:
    found = [
        _scan("scan", lives.small_result, moved=False),
        _scan("scan, result taken away", lives.small_result, moved=True),
        Life(
            "calibration", lives.calibration, lives.first_calibration, lives.calibrated,
            lives.finished,
        ),
        Life(
            "hand-over", later_lives.hand_over, later_lives.outbox_with_result,
            later_lives.whole_if_handed, later_lives.handed_over,
        ),
        Life(
            "scan that fails and is deleted", later_lives.fail_and_purge, lambda _: None,
            later_lives.nothing_torn, later_lives.nothing_left,
        ),
    ]  # fmt: skip
    if real:
        found.insert(1, _scan("scan with a body's result", lives.real_result(), moved=False))
    return found


def _process(live: Callable[[Path], None], folder: Path) -> None:
    """Live in a process of its own."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            quiet = os.open(os.devnull, os.O_WRONLY)
            os.dup2(quiet, 2)
            live(folder)
            code = 0
        finally:
            os._exit(code)
    os.waitpid(pid, 0)


class _Cutter:
    """Cuts lives at chosen calls."""

    def __init__(self, injection: Injection) -> None:
        self._injection = injection

    def calls(self, life: Life, *, changes: bool) -> int:
        """Number of file calls of an undisturbed life."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            life.prepare(folder)
            self._injection.arm(folder, "count", changes=changes)
            _process(life.live, folder)
            self._injection.disarm()
            if not life.ended(folder):
                raise RuntimeError(f"an undisturbed {life.name} does not end as it should")
            return self._injection.calls

    def well(self, life: Life, at: int, action: Action, value: int, *, changes: bool) -> bool:
        """Whether a life that met a fault at its n-th call is whole, and ends as it should."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            life.prepare(folder)
            self._injection.arm(folder, action, value, first=at, count=1, changes=changes)
            _process(life.live, folder)
            self._injection.disarm()
            sound = life.sound(folder)
            for _ in range(_TRIES):
                _process(life.live, folder)
            well = sound and life.ended(folder)
            if not well:
                where = f"{life.name}: {action} {value} at {at} ({self._injection.last_call})"
                print(
                    f"{where}: {'torn' if not sound else 'not whole at the end'}", file=sys.stderr
                )
            return well


def _cut(cutter: _Cutter, every: int, real: bool) -> list[Row]:
    found = _lives(real)
    kills = {life.name: cutter.calls(life, changes=False) for life in found}
    changing = sum(cutter.calls(life, changes=True) for life in found)
    wrong = points = 0
    for life in found:
        for at in range(1, kills[life.name] + 1, every):
            points += 1
            wrong += not cutter.well(life, at, "kill", 0, changes=False)
    rows = [
        Row(
            "kill at a file call",
            "0 torn, lost, doubled",
            f"{points} points of {sum(kills.values())} "
            f"({', '.join(f'{name}: {calls}' for name, calls in kills.items())}), "
            f"{changing} of which change something, {wrong} wrong",
            wrong == 0,
        )
    ]
    wrong = points = 0
    plain = [life for life in found if life.name != "scan"] if real else found
    for life in plain:
        calls = cutter.calls(life, changes=False)
        for code in ERRNOS:
            for at in range(1, calls + 1, every):
                points += 1
                wrong += not cutter.well(life, at, "fail", code, changes=False)
    names = ", ".join(errno.errorcode[code] for code in ERRNOS)
    rows.append(
        Row(
            "an errno at a file call of their writers",
            "whole, and as it should be in the end",
            f"{points} points ({names}), {wrong} wrong",
            wrong == 0,
        )
    )
    return rows


def disk_rows(every: int, real: bool) -> list[Row]:
    """Cut every life at every n-th call, by SIGKILL and by each errno.

    Args:
        real: with the files of a fitted body, too.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        library = build(folder)
        Injection(folder, _ROLE)
        variables = environment(library, folder, [_ROLE])
        done = subprocess.run(
            [sys.executable, __file__, _ROLE, str(folder), str(every), str(int(real))],
            env={**os.environ, **variables}, stdout=subprocess.PIPE, check=True,
        )  # fmt: skip
    return [Row(**row) for row in json.loads(done.stdout.splitlines()[-1])]


def main() -> None:
    folder, every, real = Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "1"
    rows = _cut(_Cutter(Injection(folder, _ROLE)), every, real)
    print(json.dumps([asdict(row) for row in rows]))


if __name__ == "__main__":
    main()
