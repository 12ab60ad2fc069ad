"""Scans are found by label and time, from the folders alone."""

import errno
import json
import os
import re
import shutil
import sqlite3
import threading
from contextlib import closing
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from station.archive.index import FILE, IndexBusyError, ScanIndex
from station.archive.records import ScanRecord
from station.booth.deletion import labelled, purge
from station.cli import station
from station.console.api import scans
from station.console.api.problems import ProblemError
from station.console.api.scans import _state
from station.core.config_file import load_config
from station.core.files import write_json
from station.core.scans import CANCELLED, REASON, ScanId, ScanNote
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    spool = Spool(tmp_path / "spool")
    for number, (place, label) in enumerate(
        [
            ("queue", "Order 7"),
            ("outbox", "Order 1234"),
            ("failed", "ÅNGSTRÖM"),
            ("outbox", "訂單 9"),
        ]
    ):
        folder = spool.path(place, f"2026112{number}T100000Z-000{number}")
        folder.mkdir()
        document: dict[str, object] = {
            "label": label,
            "created": f"2026-11-2{number}T10:00:00Z",
            "booth": "b",
        }
        if place == "outbox":
            document |= {"status": "ok" if number == 1 else "rescan", "reasons": ["arm"]}
            write_json(folder / "result.json", document)
        else:
            write_json(folder / "bundle.json", document)
        if place == "failed":
            write_json(folder / REASON, {"reason": "nobody there"})
    return spool


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


_ODD = {
    "half of a pair": r'{"label": "\ud800", "reasons": ["\udfff"]}',
    "deep": 100_000 * "[",
    "no list": '{"reasons": null, "seconds": []}',
    "no number": '{"reasons": 7, "seconds": {"fit": "long"}}',
}


@pytest.mark.parametrize("place", ["outbox", "failed"])
@pytest.mark.parametrize("odd", _ODD)
def test_one_damaged_scan_does_not_hide_the_others(spool: Spool, place: str, odd: str) -> None:
    """Neither a list nor the page showed any scan, and no result was handed over."""
    folder = spool.path(place, "20261125T100000Z-0005")
    folder.mkdir()
    for name in ("bundle.json", "result.json", REASON):
        (folder / name).write_text(_ODD[odd])
    option = _booth(spool)
    listed = CliRunner().invoke(station, ["list", *option])
    assert (listed.exit_code, len(listed.output.splitlines())) == (0, 5)


def test_all_scans_of_a_label_are_known(spool: Spool) -> None:
    """Deleting by label left what lay beyond the thousandth scan, without a word."""
    for number in range(1100):
        spool.path("failed", f"20261125T100000Z-{number:04d}").mkdir()
    assert len(labelled(spool, "")) == 1100
    assert labelled(spool, "Order 1234") == ["20261121T100000Z-0001"]


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


def _booth(spool: Spool) -> list[str]:
    config = spool.folder.parent / "booth.toml"
    config.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    return ["--config", str(config)]


def test_list_and_find_on_the_command_line(spool: Spool) -> None:
    option = _booth(spool)
    listed = CliRunner().invoke(station, ["list", *option])
    assert listed.output.splitlines()[0].startswith("20261123T100000Z-0003")
    assert "scan again" in listed.output
    found = CliRunner().invoke(station, ["find", "order 1234", "--json", *option])
    assert [scan["scan_id"] for scan in json.loads(found.output)] == ["20261121T100000Z-0001"]
    assert "no scan matches 'x'" in CliRunner().invoke(station, ["find", "x", *option]).output


def test_a_scan_that_was_never_stored_is_found_by_its_id(spool: Spool) -> None:
    """The operator was told to look for an interrupted scan, and nothing matched."""
    option = _booth(spool)
    scan_id = ScanId("20261125T100000Z-7f3a")
    note = ScanNote(scan_id, "failed", label="Order 8", reason="the booth was stopped")
    spool.notes.write(note, durable=False)
    shown = CliRunner().invoke(station, ["find", scan_id, *option]).output
    assert shown.startswith(scan_id)
    assert shown.endswith("failed         Order 8  the booth was stopped\n")
    told = CliRunner().invoke(station, ["find", scan_id, "--json", *option]).output
    assert json.loads(told)[0]["created"] == "2026-11-25T10:00:00Z"
    assert scan_id not in CliRunner().invoke(station, ["list", *option]).output
    spool.notes.write(ScanNote(scan_id, "delivered", verdict="rescan"), durable=False)
    assert "scan again" in CliRunner().invoke(station, ["find", scan_id, *option]).output
    spool.notes.write(ScanNote(scan_id, "capturing"), durable=False)
    assert "has no outcome yet" in CliRunner().invoke(station, ["find", scan_id, *option]).output


def test_the_api_tells_of_a_scan_that_was_never_stored_without_a_station(spool: Spool) -> None:
    """It was said not to exist."""
    _booth(spool)
    config = load_config(spool.folder.parent / "booth.toml")
    waiting = SimpleNamespace(status=lambda _: None)
    told: Any = SimpleNamespace(
        spool=spool,
        index=ScanIndex(spool),
        ledger=Ledger(spool.folder),
        countdown=waiting,
        config=config,
    )
    scan_id = ScanId("20261125T100000Z-7f3a")
    with pytest.raises(ProblemError, match="there is no scan"):
        _state(told, scan_id)
    spool.notes.write(ScanNote(scan_id, "failed", reason="the booth was stopped"), durable=False)
    scan = _state(told, scan_id)
    assert (scan.state, scan.reasons) == ("failed", ["the booth was stopped"])


def test_the_api_tells_of_a_scan_whose_result_was_taken_away(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It did not exist while the station ran, and could not be deleted there."""
    _booth(spool)
    config = load_config(spool.folder.parent / "booth.toml")
    audit = SimpleNamespace(note=lambda *words: noted.append(words[2:]))
    noted: list[Any] = []
    waiting = SimpleNamespace(status=lambda _: None)
    told: Any = SimpleNamespace(
        spool=spool, index=ScanIndex(spool), ledger=Ledger(spool.folder), countdown=waiting,
        config=config, audit=audit,
    )  # fmt: skip
    scan_id = ScanId("20261121T100000Z-0001")
    spool.notes.write(ScanNote(scan_id, "delivered", label="Order 1234"), durable=False)
    told.ledger.finish(Waiting("orders", scan_id))
    shutil.rmtree(spool.path("outbox", scan_id))
    answer = {"scan_id": scan_id, "state": "delivered", "label": "Order 1234", "reason": "",
              "framesets": 0, "wanted": 0}  # fmt: skip
    monkeypatch.setattr(scans, "command", lambda *_: answer)
    assert _state(told, scan_id).handed_over == ["orders"]
    manager: Any = SimpleNamespace(name="shop", address="here")
    assert scans.delete_label("Order 1234", told, manager).handed_over == ["orders"]
    assert noted == [("delete", scan_id)]
    for call in (partial(scans.delete, scan_id), partial(scans.delete_label, "Order 1234")):
        with pytest.raises(ProblemError, match="there is no scan"):
            call(told, manager)


def test_a_scan_that_was_taken_after_all_is_not_said_to_have_failed(spool: Spool) -> None:
    """Control answered the countdown too late, and took the scan."""
    refused = {"state": "failed", "label": "Order 7", "reason": "control did not answer within 5 s",
               "framesets": 0, "wanted": 0}  # fmt: skip
    waiting = SimpleNamespace(status=lambda scan_id: {**refused, "scan_id": scan_id})
    told: Any = SimpleNamespace(
        index=ScanIndex(spool), ledger=Ledger(spool.folder), countdown=waiting
    )
    assert _state(told, "20261120T100000Z-0000").state == "accepted"
    assert _state(told, "20261125T100000Z-7f3a").state == "failed"


def test_a_cancelled_scan_is_listed_as_such(spool: Spool) -> None:
    """It was said to have failed, as if something had gone wrong."""
    scan_id = "20261120T100000Z-0000"
    assert spool.withdraw(scan_id, CANCELLED)
    option = _booth(spool)
    (line,) = CliRunner().invoke(station, ["find", scan_id, *option]).output.splitlines()
    assert "cancelled" in line
    assert "failed" not in line
    found = json.loads(CliRunner().invoke(station, ["find", scan_id, "--json", *option]).output)
    assert (found[0]["state"], found[0]["reasons"]) == ("failed", [CANCELLED])


@pytest.mark.usefixtures("in_shanghai")
def test_people_read_local_time_and_programs_utc(spool: Spool) -> None:
    """The table showed UTC without saying so."""
    option = _booth(spool)

    def listed(*words: str) -> str:
        return CliRunner().invoke(station, ["list", *words, *option]).output

    newest = listed().splitlines()[0]
    assert newest.startswith("20261123T100000Z-0003    2026-11-23 18:00:00  scan again")
    assert json.loads(listed("--json"))[0]["created"] == "2026-11-23T10:00:00Z"
    assert listed("--since", "2026-11-23T17:59").splitlines() == [newest]
    assert listed("--since", "2026-11-23T18:01") == "no scans since 2026-11-23 18:01:00\n"
    assert listed("--since", "2026-11-23T09:59Z").splitlines() == [newest]


def test_a_long_label_is_cut_short_in_the_table_alone(spool: Spool) -> None:
    """It broke the table."""
    folder = spool.path("outbox", "20261125T100000Z-0005")
    folder.mkdir()
    write_json(folder / "result.json", {"label": 300 * "x", "status": "ok"})
    option = _booth(spool)
    (line,) = CliRunner().invoke(station, ["find", "xxx", *option]).output.splitlines()
    assert line.endswith(f" {39 * 'x'}…")
    found = json.loads(CliRunner().invoke(station, ["find", "xxx", "--json", *option]).output)
    assert found[0]["label"] == 300 * "x"


def test_a_list_since_what_is_no_day_is_refused(spool: Spool) -> None:
    """It said that there were no scans."""
    option = _booth(spool)

    def listed(since: str) -> str:
        return CliRunner().invoke(station, ["list", "--since", since, *option]).output

    assert "gestern is no day or time: write 2026-11-21" in listed("gestern")
    assert "is no day or time" in listed("0001-01-01T00:00+05:00")
    assert listed("0999-01-01") == listed("")
    assert listed("2099-01-01") == "no scans since 2099-01-01 00:00:00\n"
    assert listed("20261123").count("\n") == listed("2026-11-23T00:00+00:00").count("\n") > 0


def test_purge_by_label(spool: Spool) -> None:
    option = _booth(spool)
    done = CliRunner().invoke(purge, ["--label", "Order 1234", *option])
    assert done.exit_code == 0, done.output
    assert not spool.path("outbox", "20261121T100000Z-0001").exists()
    assert len(ScanIndex(spool).find()) == 3
    assert CliRunner().invoke(purge, ["--label", "Order", *option]).exit_code == 1
    assert CliRunner().invoke(purge, ["x", "--old", *option]).exit_code == 2


def test_copies_that_were_handed_over_are_told_by_purge(spool: Spool) -> None:
    option, ledger = _booth(spool), Ledger(spool.folder)
    scan_id = "20261121T100000Z-0001"
    ledger.finish(Waiting("orders", scan_id))
    ledger.keep(Waiting("share", scan_id))
    done = CliRunner().invoke(purge, ["--label", "Order 1234", *option])
    assert done.output.endswith("copies handed over to orders stay there\n")
    assert (ledger.receivers(scan_id), ledger.waiting()) == ([], [])
    [other, *_] = [scan.scan_id for scan in ScanIndex(spool).find()]
    assert "copies handed" not in CliRunner().invoke(purge, [other, *option]).output


def test_scans_of_a_label_are_deleted_all_or_none(spool: Spool) -> None:
    """Half of them were gone when one that was being reconstructed was refused."""
    option, ledger = _booth(spool), Ledger(spool.folder)
    first, second = "20261121T100000Z-0001", ScanId("20261126T100000Z-0006")
    spool.path("outbox", second).mkdir()
    write_json(
        spool.path("outbox", second) / "result.json", {"label": "Order 1234", "status": "ok"}
    )
    for name in (first, second):
        ledger.finish(Waiting(f"to-{name[-1]}", name))
    lock = spool.lock(second)
    assert lock is not None
    done = CliRunner().invoke(purge, ["--label", "Order 1234", *option])
    spool.unlock(second, lock)
    assert "is being reconstructed" in str(done.exception)
    assert done.output == ""
    assert spool.path("outbox", first).exists()
    assert (ledger.receivers(first), ledger.receivers(second)) == (["to-1"], ["to-6"])
    done = CliRunner().invoke(purge, ["--label", "Order 1234", *option])
    assert done.output.endswith("copies handed over to to-1, to-6 stay there\n")


def test_copies_are_told_where_the_disk_refuses_to_delete_the_rest(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else knows of them any more."""
    option, ledger = _booth(spool), Ledger(spool.folder)
    first, second = ScanId("20260101T000000Z-0001"), ScanId("20260101T000000Z-0002")
    for name in (first, second):
        spool.path("outbox", name).mkdir()
        write_json(spool.path("outbox", name) / "result.json", {"label": "7", "status": "ok"})
        ledger.finish(Waiting(f"to-{name[-1]}", name))
    remove, removed = Spool.remove, set[str]()

    def refused(self: Spool, path: Path) -> None:
        if removed and path.name not in removed:
            raise OSError(errno.EIO, "it is broken")
        removed.add(path.name)
        remove(self, path)

    monkeypatch.setattr(Spool, "remove", refused)
    done = CliRunner().invoke(purge, ["--label", "7", *option])
    [gone] = removed
    assert done.output.startswith(f"removed {spool.path('outbox', ScanId(gone))}\n")
    assert done.output.endswith("copies handed over to to-1, to-2 stay there\n")
    [left] = {first, second} - removed
    assert ledger.receivers(left) == [f"to-{left[-1]}"]


def test_what_is_removed_of_a_scan_that_was_never_stored_is_told(spool: Spool) -> None:
    """It was said that nothing was past its retention period."""
    option = _booth(spool)
    scan_id = ScanId("20261125T100000Z-7f3a")
    spool.notes.write(ScanNote(scan_id, "failed", reason="the booth was stopped"), durable=False)
    done = CliRunner().invoke(purge, [scan_id, *option])
    assert done.output == f"removed {spool.notes.path(scan_id)}\n"
    assert "there is no scan" in str(CliRunner().invoke(purge, [scan_id, *option]).exception)
    assert "nothing is past" in CliRunner().invoke(purge, ["--old", *option]).output


def test_a_waiting_scan_is_withdrawn_once(spool: Spool) -> None:
    assert spool.withdraw("20261120T100000Z-0000", "cancelled")
    assert not spool.withdraw("20261120T100000Z-0000", "cancelled")
    assert _got(ScanIndex(spool), "20261120T100000Z-0000").reasons == ("cancelled",)
    assert spool.claim() is None
