"""Deletion of scans: everything that the spool keeps of one, and who has copies of it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import click

from station.archive.index import IndexBusyError, ScanIndex
from station.archive.records import PLACES, read_record
from station.booth.retention import Deleted, expire_old, forget_removed
from station.core.commands import config_option
from station.core.config_file import find_config, load_config
from station.core.errors import SpoolError
from station.core.files import delete
from station.core.scans import STATES, Notes, ScanId, boot_id, plain_label, scan_id_of
from station.core.service import set_up_logs
from station.core.spool import Spool
from station.handover.ledger import Ledger
from station.messaging.countdowns import counting_down

_OF_OTHERS = ("cameras", "handover")
"""Folders of the spool whose entries are not named after scans."""
_ORDER_S = 60.0
"""Time after which a scan without a bundle is no longer being taken, from its deadline on."""


class NoScanError(SpoolError):
    """The spool keeps nothing of a scan."""


def labelled(spool: Spool, label: str) -> list[ScanId]:
    """Ids of all scans with this label as lists show it, also of those whose results were taken
    away.

    From the folders themselves: a full disk has no room for the index.

    Raises:
        SpoolError: one may have it, and the disk refuses to read it.
    """
    # What was there before a backup was restored is kept beside it.
    before = [Notes(folder) for folder in spool.folder.glob(".scans.before-restore*")]
    noted = ((one, notes.read(one)) for notes in (spool.notes, *before) for one in notes.ids())
    wanted = plain_label(label)
    found = {one for one, note in noted if note and plain_label(note.label) == wanted}
    for place in PLACES:
        for one in spool.scans_in(place):
            record = read_record(spool, place, one)
            if record is not None and plain_label(record.label) == wanted:
                found.add(one)
            elif record is not None and record.unreadable and spool.notes.read(one) is None:
                raise SpoolError(
                    f"scan {one} may have this label, and its files cannot be read; check the "
                    "spool's disk, or delete it by its id"
                )
    return sorted(found)


def purge_scans(spool: Spool, scan_ids: Sequence[str], deleted: Deleted) -> None:
    """Delete scans: their bundles, results, notes and names; all of them or, if one is refused
    when all are looked at, none. What is deleted is added to ``deleted``.

    Raises:
        InputError: one is not a valid scan id.
        NoScanError: the spool keeps nothing of one.
        SpoolError: one is being taken or reconstructed.
    """
    ids = [scan_id_of(one) for one in scan_ids]
    queued = [one for one in ids if spool.path("queue", one).exists()]
    others = [one for one in ids if one not in queued]
    with ExitStack() as held:
        held.callback(forget_removed, spool)
        # A worker would take these meanwhile. Not all others as well: a label may have more scans
        # than a process may open files.
        listed = traces(spool)
        found = {one: held.enter_context(_removable(spool, one, listed)) for one in queued}
        for one in others:
            with _removable(spool, one, listed):
                pass
        for one, paths in found.items():
            _purge(spool, one, paths, deleted)
        for one in others:
            with suppress(NoScanError), _removable(spool, one, listed) as paths:
                _purge(spool, one, paths, deleted)


def refuse_counting(counting: Mapping[str, str], *, scan_id: str = "", label: str = "") -> None:
    """Let no scan in the console's countdown be deleted: the spool has nothing of it yet, and it
    would be taken.

    Args:
        counting: scans in their countdown, with their labels.

    Raises:
        SpoolError: this scan, or one with this label, is among them.
    """
    wanted = plain_label(label)
    for one, of in counting.items():
        if one == scan_id or plain_label(of) == wanted != "":
            raise SpoolError(f"scan {one} is being taken; try again when it is done")


def forget_labels(index: ScanIndex) -> None:
    """Let labels leave the index together with their scans, not at the next query."""
    with suppress(IndexBusyError):  # the disk is full; then at the next one
        index.find(limit=0)


def traces(spool: Spool) -> dict[str, list[Path]]:
    """Everything under the spool that bears a scan's name, by name: folders, notes, locks,
    leftovers."""
    found: dict[str, list[Path]] = {}
    for folder in sorted(spool.folder.iterdir()):
        if folder.is_dir() and folder.name not in _OF_OTHERS:
            for entry in sorted(folder.iterdir()):
                # Scan ids have no dots.
                found.setdefault(entry.name.removeprefix(".").split(".")[0], []).append(entry)
    return found


def _purge(spool: Spool, scan_id: ScanId, paths: list[Path], deleted: Deleted) -> None:
    ledger = Ledger(spool.folder)
    deleted.receivers.update(ledger.receivers(scan_id))
    for path in paths:
        with suppress(FileNotFoundError):  # taken away meanwhile
            if path.parent.name in STATES:
                spool.remove(path)
            else:
                delete(path)
            deleted.paths.append(path)
    # One may have received it meanwhile. Nothing else knows of the copies from now on.
    deleted.receivers.update(ledger.receivers(scan_id))
    ledger.forget(scan_id, replaced=True)


@contextmanager
def _removable(
    spool: Spool, scan_id: ScanId, listed: Mapping[str, Sequence[Path]]
) -> Iterator[list[Path]]:
    """Everything that is kept of a scan, while no worker may change it.

    Args:
        listed: the spool's `traces`, since when the scan may have gone on.
    """
    lock = spool.lock(scan_id, to_delete=True)
    try:
        if lock is None or spool.path("work", scan_id).exists():
            raise SpoolError(f"scan {scan_id} is being reconstructed; try again when it is done")
        note = spool.notes.read(scan_id)
        if note is not None and note.stage in ("armed", "capturing") and note.boot == boot_id():
            over_s = time.monotonic() - note.valid_until_s
            if spool.where(scan_id) is None and over_s < _ORDER_S:
                raise SpoolError(f"scan {scan_id} is being taken; try again when it is done")
        now = [spool.path(state, scan_id) for state in STATES] + [spool.notes.path(scan_id)]
        known = (path for path in listed.get(scan_id, ()) if path.parent.name != "locks")
        found = sorted(path for path in {*known, *now} if os.path.lexists(path))
        if not found:
            raise NoScanError(f"there is no scan {scan_id}; see station list")
        yield found
    finally:
        if lock is not None:
            spool.unlock(scan_id, lock)


@click.command()
@click.argument("scan_id", required=False)
@config_option
@click.option("--label", help="delete all scans with exactly this label")
@click.option("--old", is_flag=True, help="remove everything past its retention period")
@click.option("--logged", is_flag=True, hidden=True, help="tell it in the booth's log")
def purge(
    scan_id: str | None, config_path: Path | None, label: str | None, old: bool, logged: bool
) -> None:
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
    if label is not None and not plain_label(label):
        raise click.UsageError("the label is blank, as that of every scan without one; give ids")
    say: Callable[[str], None] = set_up_logs("purge").info if logged else click.echo
    config = load_config(find_config(config_path))
    spool = Spool(config.spool.folder)
    deleted = Deleted()
    try:
        if old:
            expire_old(spool, config.retention, deleted=deleted)
        else:
            counting = counting_down(config.runtime.folder)
            refuse_counting(counting, scan_id=scan_id or "", label=label or "")
            scans: Sequence[str] = [scan_id] if scan_id else labelled(spool, str(label))
            if not scans:
                raise NoScanError(
                    f"there is no scan with the label {label!r}; see station list; "
                    "a scan that is being taken is ended with station cancel"
                )
            purge_scans(spool, scans, deleted)
    finally:
        for path in deleted.paths:
            say(f"removed {path}")
        if words := deleted.copies_words():
            say(words)
    if old and not deleted.paths and not logged:
        click.echo("nothing is past its retention period")
    forget_labels(ScanIndex(spool))


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
