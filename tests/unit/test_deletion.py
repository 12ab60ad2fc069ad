"""Deletion takes all that bears a scan's name or label, nothing else, and names who has copies."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from station.archive.index import ScanIndex
from station.booth.deletion import NoScanError, forget_labels, labelled, purge_scans
from station.booth.retention import FILE, Deleted, Moment, expire_old
from station.core.config import RetentionConfig
from station.core.errors import SpoolError
from station.core.files import write_json
from station.core.scans import ScanId, ScanNote, Stage, boot_id
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting

_DAY_S = 86_400.0
_ONE, _TWO, _THREE, _FOUR = (ScanId(f"20261121T100000Z-000{n}") for n in (1, 2, 3, 4))


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    """Three scans of one label: delivered, delivered and taken away, waiting."""
    spool = Spool(tmp_path / "spool")
    for scan_id, states in ((_ONE, ("outbox", "done")), (_TWO, ("done",)), (_THREE, ("queue",))):
        for state in states:
            spool.path(state, scan_id).mkdir()
            name = "result.json" if state == "outbox" else "bundle.json"
            write_json(spool.path(state, scan_id) / name, {"label": "Order 9", "status": "ok"})
    for scan_id in (_ONE, _TWO):
        note = ScanNote(scan_id, "delivered", label="Order 9", verdict="ok")
        spool.notes.write(note, durable=False)
    return spool


def test_a_label_is_also_that_of_results_that_were_taken_away(spool: Spool) -> None:
    """The bundle and the note of one whose result a program had taken stayed, and it was said
    that there was no such scan."""
    spool.notes.write(ScanNote(ScanId("other"), "failed", label="Order 99"), durable=False)
    # As it is given, with the space of a Chinese keyboard; it is kept as it is shown.
    found = labelled(spool, " Order\u3000 9")
    assert [scan.scan_id for scan in ScanIndex(spool).find(label="Order\u30009")] == [_ONE, _THREE][
        ::-1
    ]
    assert found == [_ONE, _TWO, _THREE]
    purge_scans(spool, found, Deleted())
    left = [path for path in spool.folder.rglob("*") if path.name.startswith("20261121")]
    assert left == []
    assert spool.notes.ids() == ["other"]


def test_a_label_is_also_that_of_what_a_restored_backup_replaced(spool: Spool) -> None:
    (spool.folder / "scans").rename(spool.folder / ".scans.before-restore")
    (spool.folder / "done").rename(spool.folder / ".done.before-restore")
    spool = Spool(spool.folder)
    found = labelled(spool, "Order 9")
    assert found == [_ONE, _TWO, _THREE]
    purge_scans(spool, found, Deleted())
    assert [path for path in spool.folder.rglob("*") if path.name.startswith("20261121")] == []


def test_no_worker_takes_a_scan_whose_label_is_being_deleted(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others were gone when it was refused."""
    remove = Spool.remove

    def with_a_worker(self: Spool, path: Path) -> None:
        assert Spool(spool.folder).claim() is None
        remove(self, path)

    monkeypatch.setattr(Spool, "remove", with_a_worker)
    purge_scans(spool, [_ONE, _TWO, _THREE], Deleted())
    assert spool.where(_THREE) is None


@pytest.mark.parametrize("stage", ["armed", "capturing"])
@pytest.mark.parametrize("ahead_s", [-3600.0, 0.0, 3600.0])
def test_a_scan_that_is_being_taken_is_known_whatever_the_wall_clock_says(
    spool: Spool, stage: Stage, ahead_s: float
) -> None:
    """A clock that was set during an order let the scan be deleted, and it went on."""
    note = ScanNote(_FOUR, stage, valid_until_s=time.monotonic() + 5.0, boot=boot_id())
    spool.notes.write(note, durable=False)
    os.utime(spool.notes.path(_FOUR), times=2 * (time.time() - ahead_s,))
    with pytest.raises(SpoolError, match="is being taken"):
        purge_scans(spool, [_FOUR], Deleted())
    # Whoever was to take it ended long ago, or with the last boot.
    for ended in (replace(note, valid_until_s=time.monotonic() - 61.0), replace(note, boot="x")):
        spool.notes.write(ended, durable=False)
        purge_scans(spool, [_FOUR], Deleted())
        assert spool.notes.ids() == [_ONE, _TWO]


def test_scans_are_deleted_where_no_file_can_be_made(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each needed a file for its lock, which only a deletion would have made room for."""
    other, opened = Spool(spool.folder), os.open

    def full(path: str | Path, flags: int, *mode: int, **options: Any) -> int:
        if flags & os.O_CREAT and not os.path.lexists(path):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return opened(path, flags, *mode, **options)

    def refuses(scan_id: ScanId) -> None:
        with pytest.raises(SpoolError, match="is being reconstructed"):
            purge_scans(other, [scan_id], Deleted())

    monkeypatch.setattr(os, "open", full)
    # Nothing else is begun there.
    with pytest.raises(OSError, match="No space left"):
        spool.claim()
    for scan_id in (_ONE, _TWO, _THREE):
        lock = spool.lock(scan_id, to_delete=True)
        assert lock is not None
        refuses(scan_id)
        assert other.lock(scan_id) is None
        spool.unlock(scan_id, lock)
    purge_scans(spool, [_ONE, _TWO, _THREE], Deleted())
    assert [path for path in spool.folder.rglob("*") if path.name.startswith("20261121")] == []


def test_what_others_remove_meanwhile_stops_no_deletion(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    remove = Spool.remove

    def after_another(self: Spool, path: Path) -> None:
        for state in ("outbox", "done"):
            shutil.rmtree(spool.path(state, _ONE), ignore_errors=True)
        remove(self, path)

    monkeypatch.setattr(Spool, "remove", after_another)
    purge_scans(spool, [_ONE, _TWO], Deleted())
    assert spool.notes.ids() == []
    assert not spool.path("done", _TWO).exists()


def test_a_target_named_like_a_scan_keeps_its_record(spool: Spool) -> None:
    """It was deleted, and every result handed over again."""
    ledger = Ledger(spool.folder)
    ledger.finish(Waiting("share", _ONE))
    with pytest.raises(NoScanError):
        purge_scans(spool, ["share"], Deleted())
    assert ledger.receivers(_ONE) == ["share"]


def test_who_receives_a_result_while_it_is_deleted_is_told(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger, remove = Ledger(spool.folder), Spool.remove

    def while_it_is_handed_over(self: Spool, path: Path) -> None:
        ledger.finish(Waiting("share", _ONE))
        remove(self, path)

    monkeypatch.setattr(Spool, "remove", while_it_is_handed_over)
    deleted = Deleted()
    purge_scans(spool, [_ONE], deleted)
    assert deleted.receivers == {"share"}


def test_receivers_are_known_as_long_as_anything_of_a_scan_is(spool: Spool) -> None:
    """They were forgotten with the result, while bundle and note stayed."""
    ledger = Ledger(spool.folder)
    ledger.finish(Waiting("share", _ONE))
    ledger.finish(Waiting("gone", "20250101T000000Z-0000"))
    retention, start = RetentionConfig(raw_days=7, result_days=1), Moment(1.8e9, 100.0, "boot")
    expire_old(spool, retention, start)
    assert ledger.receivers("20250101T000000Z-0000") == []
    deleted = Deleted()
    expire_old(spool, retention, Moment(1.8e9, 100.0 + 2 * _DAY_S, "boot"), deleted=deleted)
    assert deleted.copies_words() == "copies handed over to share stay there"
    assert not spool.path("outbox", _ONE).exists()
    assert ledger.receivers(_ONE) == ["share"]
    deleted = Deleted()
    purge_scans(spool, [_ONE], deleted)
    assert deleted.receivers == {"share"}


def test_receivers_are_known_from_what_a_restored_backup_replaced(spool: Spool) -> None:
    """Nobody was named who had received a result since the backup."""
    ledger, retention = Ledger(spool.folder), RetentionConfig(raw_days=7, result_days=1)
    ledger.finish(Waiting("share", _ONE))
    ledger.finish(Waiting("share", _TWO))
    for name in ("handover", "scans", "done"):
        (spool.folder / name).rename(spool.folder / f".{name}.before-restore-2")
    spool = Spool(spool.folder)
    ledger.finish(Waiting("orders", _ONE))
    expire_old(spool, retention, Moment(1.8e9, 100.0, "boot"))
    deleted = Deleted()
    expire_old(spool, retention, Moment(1.8e9, 100.0 + 2 * _DAY_S, "boot"), deleted=deleted)
    assert deleted.receivers == {"orders", "share"}
    # Of its bundle, which no retention period reaches there, it is still known.
    assert ledger.receivers(_ONE) == ["share"]
    for one in (_ONE, _TWO):
        deleted = Deleted()
        purge_scans(spool, [one], deleted)
        assert deleted.receivers == {"share"}
        assert not [path for path in spool.folder.rglob("*") if path.name.startswith(one)]


def test_thousands_of_scans_are_deleted_in_one_look(tmp_path: Path) -> None:
    """Each one looked through all folders: a thousand took twenty seconds."""
    spool = Spool(tmp_path)
    ids = [ScanId(f"scan-{n}") for n in range(1_000)]
    for scan_id in ids:
        spool.notes.write(ScanNote(scan_id, "failed", label="test"), durable=False)
    looks = 0
    listed = Path.iterdir

    def counted(folder: Path):  # type: ignore[no-untyped-def]
        nonlocal looks
        looks += folder == spool.notes.folder
        return listed(folder)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "iterdir", counted)
        purge_scans(spool, ids, Deleted())
    assert spool.notes.ids() == []
    assert looks < 5


def test_no_label_of_a_deleted_scan_stays_in_the_index(spool: Spool) -> None:
    """It stayed in the log of a database that the console had open."""
    index = ScanIndex(spool)
    index.hold()
    assert [scan.label for scan in index.find()] == ["Order 9", "Order 9"]
    purge_scans(spool, [_ONE, _THREE], Deleted())
    forget_labels(ScanIndex(spool))
    for path in spool.folder.glob("index.sqlite*"):
        assert b"Order 9" not in path.read_bytes(), path
        assert _ONE.encode() not in path.read_bytes(), path
    index.release()


@pytest.mark.parametrize(
    "content",
    ['{"counted_s": NaN', '{"counted_s": NaN, "last": {}, "seen_s": {}}', "[" * 100_000],
)
def test_damaged_ages_begin_anew(spool: Spool, content: str) -> None:
    (spool.folder / FILE).write_text(content)
    assert expire_old(spool, RetentionConfig()) == []
    purge_scans(spool, [_ONE], Deleted())


def test_ages_that_cannot_be_read_just_now_are_kept(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything began to age anew."""
    expire_old(spool, RetentionConfig())
    before = (spool.folder / FILE).read_bytes()

    def refused(*_: object) -> None:
        raise OSError(5, "it is broken")

    with monkeypatch.context() as patch:
        patch.setattr("station.booth.retention.read_bounded_json", refused)
        with pytest.raises(OSError, match="it is broken"):
            expire_old(spool, RetentionConfig())
        purge_scans(spool, [_ONE], Deleted())
    assert (spool.folder / FILE).read_bytes() == before


def test_leftovers_of_an_earlier_boot_are_removed(spool: Spool) -> None:
    """A process that has the number of their writer by now kept them for ever."""
    tmp = spool.folder / "tmp"
    mine = spool.temporary(_ONE)
    others = [tmp / f"{_TWO}.{os.getpid()}.{made_ns}" for made_ns in (1, 10**18)]
    old = spool.folder / ".retention.json.1234.tmp"
    for path in (mine, *others):
        path.mkdir()
    for path in (old, spool.folder / ".now.tmp"):
        path.write_text(_ONE)
    os.utime(old, (time.time() - _DAY_S,) * 2)
    spool.sweep()
    assert list(tmp.iterdir()) == [mine]
    assert not old.exists()
    assert (spool.folder / ".now.tmp").exists()


@pytest.mark.parametrize(
    "odd",
    [
        {"stage": "armed", "valid_until_s": float("nan")},
        {"stage": "delivered", "label": "\ud800"},
        {"stage": "delivering"},
        {"stage": "delivering", "result": "../done"},
    ],
)
def test_a_note_that_nobody_wrote_is_none(spool: Spool, odd: dict[str, object]) -> None:
    """Workers ended with it at every start, or published a folder of the spool as a result."""
    spool.notes.path(_ONE).write_text(json.dumps(odd))
    assert spool.notes.read(_ONE) is None
