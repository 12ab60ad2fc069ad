"""Index of scans, which follows the folders alone."""

import errno
import os
import re
import shutil
import sqlite3
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from station.archive import records
from station.archive.index import FILE, IndexBusyError, ScanIndex
from station.archive.records import PLACES, ScanRecord
from station.booth.deletion import labelled
from station.core.files import read_bounded_json, write_json
from station.core.scans import ScanId, ScanNote, scans_of
from station.core.spool import Spool


def _got(index: ScanIndex, scan_id: str) -> ScanRecord:
    found = index.get(scan_id)
    assert found is not None
    return found


def _labels(index: ScanIndex, *text: str) -> list[str]:
    return [scan.label for scan in index.find(*text)]


def test_scans_are_found_whatever_the_case_and_script(spool: Spool) -> None:
    index = ScanIndex(spool)
    assert _labels(index) == ["訂單 9", "ÅNGSTRÖM", "Order 1234", "Order 7"]
    assert _labels(index, "order 1234") == ["Order 1234"]
    assert _labels(index, "ångström") == ["ÅNGSTRÖM"]
    assert _labels(index, "訂單") == ["訂單 9"]
    assert _labels(index, "20261120t") == ["Order 7"]
    # A wildcard of the database is a character like any other.
    assert _labels(index, "%") == []
    verdicts = {scan.label: scan.verdict for scan in index.find()}
    assert verdicts == {"訂單 9": "rescan", "ÅNGSTRÖM": "failed", "Order 1234": "ok", "Order 7": ""}
    failed = index.find(states=["failed"])[0]
    assert failed.reasons == ("nobody there",)
    day = index.find(since="2026-11-21", until="2026-11-22")
    assert [scan.label for scan in day] == ["Order 1234"]


def test_a_result_that_the_disk_refuses_to_read_is_told_as_such(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was listed as usable, without its label, until its folder was moved."""
    index, scan_id = ScanIndex(spool), ScanId("20261123T100000Z-0003")
    spool.notes.write(ScanNote(scan_id, "delivered", "Order 9", verdict="rescan"), durable=False)
    tries = []

    def refused(path: Path, most_bytes: int) -> Any:
        if path.parent.name == scan_id:
            tries.append(path)
            raise OSError(errno.EIO, "Input/output error")
        return read_bounded_json(path, most_bytes)

    monkeypatch.setattr(records, "read_bounded_json", refused)
    for place in PLACES:
        os.utime(spool.folder / place, (1e9, 1e9))
    for _ in range(2):
        told = _got(index, scan_id)
        assert (told.state, told.label) == ("rescan", "Order 9")
        assert told.reasons == (
            "its files cannot be read (Input/output error); check the spool's disk",
        )
    # For each query the disk was asked again, and all others waited for it.
    assert len(_got(ScanIndex(spool), scan_id).reasons) == len(tries) == 1
    monkeypatch.setattr("station.archive.index._AGAIN_NS", 0)
    # Of what nobody knows, nobody is told that it is usable.
    spool.notes.remove(scan_id)
    assert _got(index, scan_id).state == "rescan"
    spool.notes.write(ScanNote(scan_id, "delivered", verdict="ok"), durable=False)
    assert _got(index, scan_id).state == "delivered"
    monkeypatch.setattr(records, "read_bounded_json", read_bounded_json)
    assert (_got(index, scan_id).label, _got(index, scan_id).reasons) == ("訂單 9", ("arm",))


@pytest.mark.parametrize("given", ["J\u00fcrg M\u00fcller", "J\u00fcrg  Mu\u0308ller\n"])
@pytest.mark.parametrize("asked", ["J\u00fcrg M\u00fcller", "Ju\u0308rg Mu\u0308ller "])
def test_accents_may_be_spelled_apart(spool: Spool, given: str, asked: str) -> None:
    """An order that was pasted from a Mac was not found, nor deleted, by the same name. Earlier
    versions kept what was given."""
    scan_id = "20261125T100000Z-0001"
    spool.path("outbox", scan_id).mkdir()
    write_json(spool.path("outbox", scan_id) / "result.json", {"label": given, "status": "ok"})
    index = ScanIndex(spool)
    assert [scan.scan_id for scan in index.find(asked.lower())] == [scan_id]
    assert [scan.scan_id for scan in index.find(label=asked)] == [scan_id]
    assert labelled(spool, asked) == [scan_id]


def test_pages_hold_each_scan_once(spool: Spool) -> None:
    index, seen, before = ScanIndex(spool), [], None
    while page := index.find(before=before, limit=3):
        seen += [scan.scan_id for scan in page]
        before = (page[-1].created, page[-1].scan_id)
    assert len(seen) == len(set(seen)) == 4


@pytest.mark.parametrize("damage", [b"", b"not a database, " * 400])
def test_a_lost_or_damaged_index_is_made_anew(spool: Spool, damage: bytes) -> None:
    assert len(ScanIndex(spool).find()) == 4
    for path in spool.folder.glob(f"{FILE}*"):
        path.unlink()
    if damage:
        (spool.folder / FILE).write_bytes(damage)
    assert len(ScanIndex(spool).find()) == 4


def test_an_index_with_damaged_pages_is_made_anew(spool: Spool) -> None:
    """Whoever asked for scans got a traceback, and every time again."""
    assert len(ScanIndex(spool).find()) == 4
    path = spool.folder / FILE
    head = path.read_bytes()[:4096]
    path.write_bytes(head + b"Z" * (path.stat().st_size - len(head)))
    assert len(ScanIndex(spool).find()) == 4
    assert _labels(ScanIndex(spool), "order 1234") == ["Order 1234"]


def test_an_index_of_the_version_before_is_read_anew_in_its_place(spool: Spool) -> None:
    """All processes start at once after an upgrade; each removed the file that another had just
    made, with the log that this one wrote to."""
    index, path = ScanIndex(spool), spool.folder / FILE
    index.find()
    with closing(sqlite3.connect(path, isolation_level=None)) as before:
        before.execute("UPDATE scans SET sought = 'as it was given'")
        before.execute("PRAGMA user_version = 1")
        file = path.stat().st_ino
        assert _labels(index, "order 1234") == ["Order 1234"]
        assert before.execute("PRAGMA user_version").fetchone() == (2,)
    assert path.stat().st_ino == file


def test_a_locked_index_is_not_thrown_away(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever held the file open lost it, and answered the next request with a server error."""
    index = ScanIndex(spool)
    assert len(index.find()) == 4
    monkeypatch.setattr("station.archive.index._BUSY_S", 0.1)
    path = spool.folder / FILE
    before = path.stat().st_ino
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("PRAGMA locking_mode = EXCLUSIVE")
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(IndexBusyError, match="try again"):
            index.find()
        other.execute("COMMIT")
    assert path.stat().st_ino == before
    assert len(index.find()) == 4


def test_the_index_follows_the_folders(spool: Spool) -> None:
    index = ScanIndex(spool)
    assert _got(index, "20261120T100000Z-0000").state == "accepted"
    spool.path("queue", "20261120T100000Z-0000").rename(spool.path("work", "20261120T100000Z-0000"))
    assert _got(index, "20261120T100000Z-0000").state == "reconstructing"
    shutil.rmtree(spool.path("outbox", "20261121T100000Z-0001"))
    assert index.get("20261121T100000Z-0001") is None
    # Nothing of a label stays in the file.
    assert b"Order 1234" not in b"".join(p.read_bytes() for p in spool.folder.glob(f"{FILE}*"))


def test_an_old_result_takes_its_label_from_its_bundle(spool: Spool) -> None:
    folder = spool.path("outbox", "20261125T100000Z-0005")
    folder.mkdir()
    write_json(folder / "result.json", {"status": "ok", "reasons": []})
    bundle = spool.path("done", folder.name)
    bundle.mkdir()
    write_json(bundle / "bundle.json", {"label": "Order 5", "created": "2026-11-25T10:00:01Z"})
    found = _got(ScanIndex(spool), folder.name)
    assert (found.label, found.created) == ("Order 5", "2026-11-25T10:00:01Z")


def test_a_look_at_the_index_drops_no_lock_of_its_process(spool: Spool) -> None:
    """Whoever closes a file anywhere drops all locks that the process has on it."""
    index = ScanIndex(spool)
    index.hold()
    index.find()
    before = _locks(spool.folder / FILE)
    index.find()
    assert before
    assert _locks(spool.folder / FILE) == before
    index.release()


def _locks(path: Path) -> list[str]:
    """Lines of the kernel's list about this process' locks on a file."""
    words = {str(os.getpid()), str(path.stat().st_ino)}
    lines = Path("/proc/locks").read_text().splitlines()
    return sorted(line.split(":", 1)[1] for line in lines if words <= set(re.split("[ :]", line)))


def test_a_folder_that_cannot_be_listed_once_loses_no_scans(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process with too many open files listed none, and neither did those after it."""
    index = ScanIndex(spool)

    def refused(folder: Path) -> list[ScanId]:
        if folder.name == "outbox":
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return scans_of(folder)

    monkeypatch.setattr("station.archive.index.scans_of", refused)
    with pytest.raises(IndexBusyError, match="outbox: Too many open files"):
        index.find()
    monkeypatch.undo()
    assert len(index.find()) == 4


def test_many_readers_at_once(spool: Spool) -> None:
    wrong: list[object] = []

    def look() -> None:
        for _ in range(20):
            found = ScanIndex(spool).find()
            if len(found) != 4:
                wrong.append(found)

    threads = [threading.Thread(target=look) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    # The mask of new files belongs to all threads: nobody enters a folder made under another one.
    later = spool.folder / "later"
    later.mkdir()
    assert later.stat().st_mode & 0o700 == 0o700


def test_a_waiting_scan_is_withdrawn_once(spool: Spool) -> None:
    assert spool.withdraw("20261120T100000Z-0000", "cancelled")
    assert not spool.withdraw("20261120T100000Z-0000", "cancelled")
    assert _got(ScanIndex(spool), "20261120T100000Z-0000").reasons == ("cancelled",)
    assert spool.claim() is None
