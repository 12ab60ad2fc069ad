"""Retention of body scans, and the deletion of one.

A wall clock may jump: a dead battery, a mistyped date. So time is counted in a file of the spool
(`retention.json`): within a boot by the kernel's clock since the boot, from one boot to the next by
the wall clock, but no more than four days at once. A longer shutdown, or a clock that jumps ahead,
deletes later, never earlier.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import click

from station.archive.index import ScanIndex
from station.core.commands import config_option
from station.core.config import RetentionConfig
from station.core.config_file import find_config, load_config
from station.core.errors import SpoolError
from station.core.files import delete, held, read_bounded_json, write_bytes
from station.core.scans import STATES, ScanId, boot_id, scan_id_of
from station.core.spool import Spool
from station.handover.ledger import Ledger

FILE = "retention.json"
_LOCK = "retention.lock"
LONGEST_OFF_S = 4 * 86_400.0
"""A long weekend."""
_DAY_S = 86_400.0
_MAX_BYTES = 16 << 20
_BUSY = SpoolError("old scans are being removed at the moment; try again")
_ORDER_S = 60.0
"""Time after which a scan without a bundle is no longer being taken, from its order on."""


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


def advance(ages: Ages, now: Moment) -> Ages:
    """The counted time at a moment (pure)."""
    last = ages.last
    if last is None:
        passed_s = 0.0
    elif last.boot == now.boot:
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


def expire_old(spool: Spool, retention: RetentionConfig, now: Moment | None = None) -> list[Path]:
    """Remove bundles of delivered scans, results, failed scans and notes that are past their time.

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
        removed, refused = list[Path](), list[OSError]()
        for name in old:
            try:
                if _expire(spool, name):
                    removed.append(spool.folder / name)
            except FileNotFoundError:
                continue  # taken away meanwhile
            except OSError as error:
                refused.append(error)
        _save(spool, ages)
    if refused:
        raise refused[0]
    return removed


def _expire(spool: Spool, name: str) -> bool:
    """Remove what is past its time; False for a note, which is told with its scan."""
    state, scan_id = name.split("/", 1)
    if state != "scans":
        spool.remove(spool.folder / name)
        if state == "outbox":
            Ledger(spool.folder).forget(scan_id)
        return True
    if spool.where(scan_id) is None and not spool.path("done", scan_id).exists():
        spool.notes.remove(ScanId(scan_id))
        # Its result may have been taken away.
        Ledger(spool.folder).forget(scan_id)
    return False


def _load(spool: Spool) -> Ages:
    try:
        document: dict[str, Any] = read_bounded_json(spool.folder / FILE, _MAX_BYTES)
        seen = {str(name): float(value) for name, value in document["seen_s"].items()}
        last = document["last"]
        moment = Moment(float(last["wall_s"]), float(last["since_boot_s"]), str(last["boot"]))
        return Ages(float(document["counted_s"]), moment, seen)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
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


def traces(spool: Spool, scan_id: ScanId) -> list[Path]:
    """Everything under the spool that bears a scan's name: folders, notes, locks, leftovers."""
    found = []
    for folder in sorted(spool.folder.iterdir()):
        if folder.is_dir() and not folder.is_symlink():
            found += [entry for entry in sorted(folder.iterdir()) if _names(entry.name, scan_id)]
    return found


def _names(name: str, scan_id: ScanId) -> bool:
    plain = name.removeprefix(".")
    return plain == scan_id or plain.startswith(f"{scan_id}.")


@dataclass(slots=True)
class Removed:
    """Files that were deleted, also where the disk refused to delete the rest."""

    paths: list[Path] = field(default_factory=list)
    receivers: set[str] = field(default_factory=set)
    """Targets that have copies, which stay there."""


def purge_scans(spool: Spool, scan_ids: Sequence[str], removed: Removed) -> None:
    """Delete scans: their bundles, results, notes and names; all of them or, if one is refused,
    none. What is deleted is added to ``removed``.

    Raises:
        InputError: one is not a valid scan id.
        SpoolError: one does not exist, or is being taken or reconstructed.
    """
    # Not all locks at once: a label may have more scans than a process may open files.
    for scan_id in scan_ids:
        with _removable(spool, scan_id):
            pass
    for scan_id in scan_ids:
        with _removable(spool, scan_id) as paths:
            _purge(spool, scan_id, paths, removed)
    # Whoever removes old scans just now forgets these, too.
    with suppress(SpoolError), held(spool.folder / _LOCK, _BUSY):
        _save(spool, _load(spool))


def _purge(spool: Spool, scan_id: str, paths: list[Path], removed: Removed) -> None:
    ledger = Ledger(spool.folder)
    receivers = ledger.receivers(scan_id)
    for path in paths:
        if path.parent.name in STATES:
            spool.remove(path)
        else:
            delete(path)
        removed.paths.append(path)
    # Nothing else knows of the copies from now on.
    removed.receivers.update(receivers)
    ledger.forget(scan_id)


@contextmanager
def _removable(spool: Spool, scan_id: str) -> Iterator[list[Path]]:
    """Everything that is kept of a scan, while no other process may change it."""
    name = scan_id_of(scan_id)
    lock = spool.lock(name)
    try:
        if lock is None or spool.path("work", name).exists():
            raise SpoolError(f"scan {name} is being reconstructed; try again when it is done")
        note = spool.notes.read(name)
        if note is not None and note.stage in ("armed", "capturing"):
            age_s = time.time() - spool.notes.path(name).stat().st_mtime
            if spool.where(name) is None and 0.0 <= age_s < _ORDER_S:
                raise SpoolError(f"scan {name} is being taken; try again when it is done")
        found = [path for path in traces(spool, name) if path.parent.name != "locks"]
        if not found:
            raise SpoolError(f"there is no scan {name} in {spool.folder}")
        yield found
    finally:
        if lock is not None:
            spool.unlock(name, lock)


@click.command()
@click.argument("scan_id", required=False)
@config_option
@click.option("--label", help="delete all scans with exactly this label")
@click.option("--old", is_flag=True, help="remove everything past its retention period")
def purge(scan_id: str | None, config_path: Path | None, label: str | None, old: bool) -> None:
    """Delete a scan and its results, all scans with a label, or all that are past their retention
    period.

    \b
    Examples:
      station purge 20261121T100000Z-7f3a
      station purge --label "Order 1234"
      station purge --old
    """
    if sum([bool(scan_id), label is not None, old]) != 1:
        raise click.UsageError("give a scan id, --label or --old")
    config = load_config(find_config(config_path))
    spool = Spool(config.spool.folder)
    removed = Removed()
    try:
        if old:
            removed.paths = expire_old(spool, config.retention)
        else:
            scans = [scan_id] if scan_id else _labelled(spool, str(label))
            purge_scans(spool, scans, removed)
    finally:
        for path in removed.paths:
            click.echo(f"removed {path}")
        if removed.receivers:
            click.echo(f"copies handed over to {', '.join(sorted(removed.receivers))} stay there")
    if old and not removed.paths:
        click.echo("nothing is past its retention period")
    # Labels leave the index together with the scans, not at the next query.
    ScanIndex(spool).find(limit=0)


def _labelled(spool: Spool, label: str) -> list[str]:
    found = ScanIndex(spool).ids_of(label)
    if not found:
        raise SpoolError(
            f"there is no scan with the label {label!r}; see station list; "
            "a scan that is being taken is ended with station cancel"
        )
    return found


@click.command()
@click.argument("scan_id")
@config_option
def retry(scan_id: str, config_path: Path | None) -> None:
    """Reconstruct a failed scan again.

    \b
    Examples:
      station retry 20261121T100000Z-7f3a
    """
    config = load_config(find_config(config_path))
    Spool(config.spool.folder).retry(scan_id_of(scan_id))
    click.echo(f"scan {scan_id} is waiting to be reconstructed")
