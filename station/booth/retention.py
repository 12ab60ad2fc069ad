"""Retention of body scans: what is kept too long is removed.

A wall clock may jump: a dead battery, a mistyped date. So time is counted in a file of the spool
(`retention.json`): within a boot by the kernel's clock since the boot, from one boot to the next by
the wall clock, but no more than four days at once. A longer shutdown, or a clock that jumps ahead,
deletes later, never earlier.
"""

from __future__ import annotations

import json
import logging
import math
import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from station.core.config import RetentionConfig
from station.core.errors import SpoolError
from station.core.files import held, read_bounded_json, write_bytes
from station.core.scans import STATES, ScanId, boot_id
from station.core.service import die_with_parent
from station.core.spool import Spool
from station.handover.ledger import Ledger

FILE = "retention.json"
_LOCK = "retention.lock"
LONGEST_OFF_S = 4 * 86_400.0
"""A long weekend."""
_DAY_S = 86_400.0
_TIDY_PERIOD_S = 600.0
_MAX_BYTES = 256 << 20
"""Two million scans: more than a spool can have, or the file could be written and not read."""
_BUSY = SpoolError("old scans are being removed at the moment; try again")


@dataclass(frozen=True, slots=True)
class Moment:
    """Three clocks at once."""

    wall_s: float
    since_boot_s: float
    boot: str

    @classmethod
    def now(cls) -> Moment:
        return cls(time.time(), time.clock_gettime(time.CLOCK_BOOTTIME), boot_id())


@dataclass(frozen=True, slots=True)
class Ages:
    """Counted time, and when each folder of a scan was first seen in it."""

    counted_s: float = 0.0
    last: Moment | None = None
    seen_s: dict[str, float] = field(default_factory=dict)
    """"<state>/<scan id>" -> counted time."""


@dataclass(slots=True)
class Deleted:
    """Files and folders that were deleted, also where the disk refused to delete the rest."""

    paths: list[Path] = field(default_factory=list)
    receivers: set[str] = field(default_factory=set)
    """Targets that have copies, which stay there."""

    def copies_words(self) -> str:
        """Sentence about the copies; empty if there are none."""
        names = ", ".join(sorted(self.receivers))
        return f"copies handed over to {names} stay there" if names else ""


def advance(ages: Ages, now: Moment) -> Ages:
    """The counted time at a moment (pure)."""
    last = ages.last
    if last is None:
        passed_s = 0.0
    elif last.boot == now.boot or not (last.boot and now.boot):
        # Of an unknown boot, too: its time since the boot may have been counted already.
        passed_s = max(0.0, now.since_boot_s - last.since_boot_s)
    else:
        off_s = now.wall_s - last.wall_s - now.since_boot_s
        passed_s = now.since_boot_s + min(max(off_s, 0.0), LONGEST_OFF_S)
    return replace(ages, counted_s=ages.counted_s + passed_s, last=now)


def due(ages: Ages, folders: list[str], limits_s: dict[str, float]) -> tuple[Ages, list[str]]:
    """Folders ("<state>/<scan id>") that are past their time (pure).

    A folder that is seen for the first time begins to age.
    """
    seen = {name: ages.seen_s.get(name, ages.counted_s) for name in folders}
    old = [
        name
        for name, first_s in seen.items()
        if ages.counted_s - first_s > limits_s.get(name.split("/")[0], float("inf"))
    ]
    return replace(ages, seen_s=seen), old


def expire_old(
    spool: Spool,
    retention: RetentionConfig,
    now: Moment | None = None,
    *,
    deleted: Deleted | None = None,
) -> list[Path]:
    """Remove bundles of delivered scans, results, failed scans and notes that are past their time.

    Returns what was removed. It is added to ``deleted``, if given, also where the disk refuses.

    Raises:
        OSError: the disk refuses; what it lets go is removed all the same.
    """
    result_s = retention.result_days * _DAY_S
    limits_s = {
        "done": retention.raw_days * _DAY_S,
        "outbox": result_s,
        "failed": result_s,
        "scans": max(result_s, retention.raw_days * _DAY_S),
    }
    with held(spool.folder / _LOCK, _BUSY):
        ages = advance(_load(spool), now or Moment.now())
        folders = [
            f"{state}/{name}"
            for state in STATES
            if state in limits_s
            for name in sorted(os.listdir(spool.folder / state))
        ]
        folders += [f"scans/{scan_id}" for scan_id in spool.notes.ids()]
        ages, old = due(ages, folders, limits_s)
        deleted = deleted or Deleted()
        refused: list[OSError] = []
        for name in old:
            try:
                _expire(spool, name, deleted)
            except FileNotFoundError:
                continue  # taken away meanwhile
            except OSError as error:
                refused.append(error)
        _save(spool, ages)
        Ledger(spool.folder).prune(
            lambda name: _exists(spool, f"outbox/{name}") or _exists(spool, f"scans/{name}")
        )
    if refused:
        raise refused[0]
    return deleted.paths


def _expire(spool: Spool, name: str, deleted: Deleted) -> None:
    """Remove what is past its time, and tell of it; a note is told with its scan."""
    state, scan_id = name.split("/", 1)
    ledger = Ledger(spool.folder)
    if state != "scans":
        spool.remove(spool.folder / name)
        deleted.paths.append(spool.folder / name)
        if state == "outbox":
            deleted.receivers.update(ledger.receivers(scan_id))
            if not _exists(spool, f"scans/{scan_id}"):
                ledger.forget(scan_id)
        return
    if spool.where(scan_id) is None and not spool.path("done", scan_id).exists():
        spool.notes.remove(ScanId(scan_id))
        # Its result may have been taken away.
        ledger.forget(scan_id)


def forget_removed(spool: Spool) -> None:
    """Keep no names of scans that no longer exist."""
    # Whoever removes old scans just now forgets them, too; so does the next one.
    with suppress(SpoolError, OSError), held(spool.folder / _LOCK, _BUSY):
        _save(spool, _load(spool))


def _load(spool: Spool) -> Ages:
    """The ages so far.

    Raises:
        OSError: the file cannot be read at the moment.
    """
    try:
        document: dict[str, Any] = read_bounded_json(spool.folder / FILE, _MAX_BYTES)
        seen = {str(name): float(value) for name, value in document["seen_s"].items()}
        last, counted_s = document["last"], float(document["counted_s"])
        moment = Moment(float(last["wall_s"]), float(last["since_boot_s"]), str(last["boot"]))
        times = (counted_s, moment.wall_s, moment.since_boot_s, *seen.values())
        if not all(map(math.isfinite, times)) or not all("/" in name for name in seen):
            return Ages()
        return Ages(counted_s, moment, seen)
    except (
        FileNotFoundError, ValueError, KeyError, TypeError, AttributeError, OverflowError,
        RecursionError,
    ):  # fmt: skip
        # All start to age now, which deletes late, never early.
        return Ages()


def _save(spool: Spool, ages: Ages) -> None:
    kept = {n: s for n, s in ages.seen_s.items() if _exists(spool, n)}
    last = None if ages.last is None else asdict(ages.last)
    document = {"counted_s": ages.counted_s, "last": last, "seen_s": kept}
    # In one piece: thousands of scans in lines of their own take megabytes for a moment.
    write_bytes(spool.folder / FILE, json.dumps(document, allow_nan=False).encode())


def _exists(spool: Spool, name: str) -> bool:
    state, scan_id = name.split("/", 1)
    if state == "scans":
        return spool.notes.path(ScanId(scan_id)).exists()
    return (spool.folder / name).exists()


class Tidying:
    """Removal, every ten minutes, of what dead writers left and of what is past its time.

    The second takes long where there is much of it: a process of its own does it meanwhile.
    """

    def __init__(self, spool: Spool, config_path: Path, log: logging.Logger) -> None:
        self._spool, self._config_path, self._log = spool, config_path, log
        self._begun_s = -_TIDY_PERIOD_S
        self._purge: subprocess.Popen[bytes] | None = None

    def look(self, now_s: float) -> None:
        """Begin if it is time, and log a removal that failed.

        Args:
            now_s: the monotonic clock's.
        """
        if now_s - self._begun_s > _TIDY_PERIOD_S:
            self._begun_s = now_s
            self._begin()
        code = None if self._purge is None else self._purge.poll()
        if code is None:
            return
        if code != 0:
            self._log.warning("old scans could not be removed: the purge ended with %d", code)
        self._purge = None

    def _begin(self) -> None:
        try:
            self._spool.sweep()
        except OSError as error:
            self._log.warning("what was left unfinished could not be removed: %s", error)
        try:
            if self._purge is not None:
                # It hangs, or there is very much; the next one goes on where this one ends.
                self._purge.kill()
                return
            command = [sys.executable, "-m", "station.cli", "purge", "--old", "--logged"]
            self._purge = subprocess.Popen(
                [*command, "--config", str(self._config_path)],
                stdin=subprocess.DEVNULL,
                preexec_fn=partial(die_with_parent, os.getpid()),
            )
        except OSError as error:
            self._log.warning("old scans could not be removed: %s", error)
