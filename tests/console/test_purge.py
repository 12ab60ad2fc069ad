"""Deletion of scans by commands and the API, and the words on what it leaves."""

import asyncio
import errno
import logging
from pathlib import Path
from typing import Any

import httpx
import pytest
from click.testing import CliRunner
from live_console import API

from station.archive import records
from station.archive.index import ScanIndex
from station.archive.phrases import in_language
from station.booth.deletion import labelled, purge
from station.booth.session import MAX_LABEL_LENGTH
from station.console.api.console import Console
from station.console.app import create_app
from station.core.config_file import load_config
from station.core.files import read_bounded_json, write_json
from station.core.scans import ScanId, ScanNote
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting


def test_all_scans_of_a_label_are_known(spool: Spool) -> None:
    """Deleting by label left what lay beyond the thousandth scan, without a word."""
    for number in range(1100):
        spool.path("failed", f"20261125T100000Z-{number:04d}").mkdir()
    assert len(labelled(spool, "")) == 1100
    assert labelled(spool, "Order 1234") == ["20261121T100000Z-0001"]


def test_purge_by_label(spool: Spool, option: list[str]) -> None:
    done = CliRunner().invoke(purge, ["--label", "Order 1234", *option])
    assert done.exit_code == 0, done.output
    assert not spool.path("outbox", "20261121T100000Z-0001").exists()
    assert len(ScanIndex(spool).find()) == 3
    assert CliRunner().invoke(purge, ["--label", "Order", *option]).exit_code == 1
    assert CliRunner().invoke(purge, ["x", "--old", *option]).exit_code == 2


def test_purge_by_label_leaves_no_scan_that_may_have_it_without_a_word(
    spool: Spool, option: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever deleted a person's scans was told that all were gone."""
    kept = "20261121T100000Z-0001"

    def refused(path: Path, most_bytes: int) -> Any:
        if path.parent.name == kept:
            raise OSError(errno.EIO, "Input/output error")
        return read_bounded_json(path, most_bytes)

    monkeypatch.setattr(records, "read_bounded_json", refused)
    words = ["--label", "Order 1234", *option]
    spool.notes.write(ScanNote(ScanId(kept), "delivered", "Order 9"), durable=False)
    assert "there is no scan with the label" in str(CliRunner().invoke(purge, words).exception)
    spool.notes.remove(ScanId(kept))
    told = str(CliRunner().invoke(purge, words).exception)
    assert told.startswith(f"scan {kept} may have this label, and its files cannot be read; check")
    assert in_language(told, "zh").endswith("或按编号删除它")
    assert CliRunner().invoke(purge, [kept, *option]).exit_code == 0


def test_copies_that_were_handed_over_are_told_by_purge(spool: Spool, option: list[str]) -> None:
    ledger = Ledger(spool.folder)
    scan_id = "20261121T100000Z-0001"
    ledger.finish(Waiting("orders", scan_id))
    ledger.keep(Waiting("share", scan_id))
    done = CliRunner().invoke(purge, ["--label", "Order 1234", *option])
    assert done.output.endswith("copies handed over to orders stay there\n")
    assert (ledger.receivers(scan_id), ledger.waiting()) == ([], [])
    [other, *_] = [scan.scan_id for scan in ScanIndex(spool).find()]
    assert "copies handed" not in CliRunner().invoke(purge, [other, *option]).output


@pytest.mark.parametrize("label", ["", " "])
def test_a_blank_label_deletes_nothing(spool: Spool, option: list[str], label: str) -> None:
    """It deleted every scan without a label: a script's variable was empty."""
    spool.notes.write(ScanNote(ScanId("nameless"), "failed"), durable=False)
    assert CliRunner().invoke(purge, ["--label", label, *option]).exit_code == 2
    assert labelled(spool, label) == ["nameless"]


@pytest.mark.parametrize("label", [" ", MAX_LABEL_LENGTH * "e\u0301"], ids=["blank", "longest"])
def test_a_label_of_no_scan_deletes_nothing_by_the_api(tmp_path: Path, label: str) -> None:
    path = tmp_path / "booth.toml"
    path.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    console = Console(load_config(path), path, logging.getLogger())
    console.spool.notes.write(ScanNote(ScanId("a"), "failed"), durable=False)

    async def answer() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(console))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.delete(f"{API}/scans", params={"label": label})

    assert asyncio.run(answer()).status_code == 404
    assert console.spool.notes.ids() == ["a"]
    console.vault.close()
    console.audit.close()


def test_scans_of_a_label_are_deleted_all_or_none(spool: Spool, option: list[str]) -> None:
    """Half of them were gone when one that was being reconstructed was refused."""
    ledger = Ledger(spool.folder)
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
    spool: Spool, option: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else knows of them any more."""
    ledger = Ledger(spool.folder)
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


def test_what_is_removed_of_a_scan_that_was_never_stored_is_told(
    spool: Spool, option: list[str]
) -> None:
    """It was said that nothing was past its retention period."""
    scan_id = ScanId("20261125T100000Z-7f3a")
    spool.notes.write(ScanNote(scan_id, "failed", reason="the booth was stopped"), durable=False)
    done = CliRunner().invoke(purge, [scan_id, *option])
    assert done.output == f"removed {spool.notes.path(scan_id)}\n"
    assert "there is no scan" in str(CliRunner().invoke(purge, [scan_id, *option]).exception)
    assert "nothing is past" in CliRunner().invoke(purge, ["--old", *option]).output
