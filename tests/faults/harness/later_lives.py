"""Lives of what is there already, cut at each file call: a hand-over, and a scan's bad end.

As in `lives`: with the functions of the real processes, and begun again at any point.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import lives

from station.archive.index import ScanIndex
from station.booth.deletion import purge_scans, traces
from station.booth.retention import Deleted, expire_old
from station.core.config import RetentionConfig
from station.core.files import private_folder
from station.core.spool import Claim, Spool
from station.core.words.tables import FILES
from station.handover.ledger import Ledger, Waiting
from station.handover.targets import FolderTarget, HandOverError

_TARGET = "shop"


def outbox_with_result(folder: Path) -> None:
    """A result that waits to be handed over, and the other program's folder."""
    (folder / "handed").mkdir()
    _write_tables(private_folder(Spool(folder / "spool").path("outbox", lives.SCAN)))


def hand_over(folder: Path) -> None:
    """A hand-over's life: followed, tried in vain, tried again, recorded."""
    spool = Spool(folder / "spool")
    ledger, index = Ledger(spool.folder), ScanIndex(spool)
    ledger.follow(_TARGET, [found.scan_id for found in index.find()], spool.notes.ids())
    for entry in ledger.waiting():
        _try(ledger, index, spool, entry)


def _try(ledger: Ledger, index: ScanIndex, spool: Spool, entry: Waiting) -> None:
    found, result = index.get(entry.scan_id), spool.path("outbox", entry.scan_id)
    assert found is not None
    handed = spool.folder.parent / "handed"
    if not entry.tries:
        try:
            FolderTarget(handed / "missing")(found, result)
        except HandOverError as error:
            ledger.keep(entry.failed(str(error), time.time()))
    FolderTarget(handed)(found, result)
    ledger.finish(entry)


def whole_if_handed(folder: Path) -> bool:
    """Whether the other program sees no part of a result, and the index can be asked."""
    ScanIndex(Spool(folder / "spool")).find()
    names = [path for path in (folder / "handed").iterdir() if not path.name.startswith(".")]
    return all(_same(folder, path) for path in names)


def handed_over(folder: Path) -> bool:
    """Whether the result was handed over whole, and is not handed over again."""
    done = folder / "spool/handover" / _TARGET / "done" / lives.SCAN
    left = list((folder / "spool/handover" / _TARGET / "waiting").glob("*.json"))
    place = folder / "handed" / lives.SCAN
    return done.exists() and not left and _same(folder, place) and whole_if_handed(folder)


def _same(folder: Path, place: Path) -> bool:
    result = folder / "spool/outbox" / lives.SCAN
    copies = all((place / p.name).read_bytes() == p.read_bytes() for p in result.iterdir())
    return copies and (place / "individual.smis").stat().st_size > 0


def _write_tables(result: Path) -> None:
    (result / "result.json").write_text(json.dumps({"scan_id": lives.SCAN, "status": "ok"}))
    for pose, name in FILES.items():
        table = {"format": "booth-measurements", "version": 1, "pose": pose, "measurements": []}
        (result / name).write_text(json.dumps(table))


def fail_and_purge(folder: Path) -> None:
    """A scan whose job crashes, that is given up, tried again by hand, delivered, deleted."""
    spool = Spool(folder / "spool")
    if spool.path("failed", lives.SCAN).exists():
        spool.retry(lives.SCAN)
    if spool.where(lives.SCAN) is None and not spool.path("done", lives.SCAN).exists():
        lives.submit(spool)
    spool.recover(lives.RETRIES)
    for end in (_crash, _give_up, lives.deliver_small):
        claim = spool.claim()
        if claim is None:
            break
        try:
            end(claim)
        finally:
            claim.close()
        if spool.path("failed", lives.SCAN).exists():
            spool.retry(lives.SCAN)
    expire_old(spool, RetentionConfig())
    purge_scans(spool, [lives.SCAN], Deleted())
    ScanIndex(spool).find(limit=0)


def _crash(claim: Claim) -> None:
    claim.count_try("the job ended unexpectedly")
    claim.put_back()


def _give_up(claim: Claim) -> None:
    claim.fail("there is nobody")


def nothing_torn(folder: Path) -> bool:
    """Whether the scan is there once, if at all, and so is its result."""
    return lives.kept_bundles(folder) <= 1 and lives.whole_results(folder)


def nothing_left(folder: Path) -> bool:
    """Whether no file bears the scan's name."""
    return lives.SCAN not in traces(Spool(folder / "spool"))
