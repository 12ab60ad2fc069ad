"""Targets that answer nonsense, and results that are damaged: the others are handed over."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from station.archive.records import ScanRecord
from station.booth.retention import Removed, purge_scans
from station.core.config import DeliverConfig
from station.core.config_file import load_config
from station.core.scans import ScanId, ScanNote
from station.core.spool import Spool
from station.handover.deliver_cli import HandOver
from station.handover.ledger import Ledger, Waiting
from station.handover.targets import HandOverError, make_target

_CAMERA = '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
_IDS = ("20261121T100000Z-0001", "20261121T100000Z-0002")


@pytest.fixture
def no_http() -> Iterator[int]:
    """The port of a program that does not speak HTTP."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            connection.recv(1 << 16)
            connection.sendall(b"220 mail.example ESMTP\r\n\r\n")
            connection.close()

        threading.Thread(target=answer, daemon=True).start()
        yield server.getsockname()[1]


def _result(folder: Path, **table: object) -> Path:
    folder.mkdir(parents=True)
    document = {"format": "booth-measurements", "version": 1, "pose": "as-scanned", **table}
    for name in ("measurements.json", "measurements-standard.json"):
        (folder / name).write_text(json.dumps(document))
    (folder / "result.json").write_text(json.dumps({"status": "ok", "label": "Order 1"}))
    return folder


def _scan() -> ScanRecord:
    return ScanRecord(_IDS[0], "delivered", "Order 1", "", "2026-11-21T10:00:00Z", "")


@pytest.mark.parametrize("place", ["127.0.0.1:{port}/", "127.0.0.1:eighty/", "127.0.0.1/a b"])
def test_what_is_no_webhook_is_tried_again(tmp_path: Path, no_http: int, place: str) -> None:
    """It ended the thread that hands results over, and none came any more."""
    (tmp_path / "secret").write_text("topsecret")
    url = "http://" + place.format(port=no_http)
    config = DeliverConfig(name="orders", url=url, secret_file=tmp_path / "secret")
    with pytest.raises(HandOverError, match=r"\A[^\n]*\Z"):
        make_target(config)(_scan(), _result(tmp_path / "result", measurements=[]))


def test_a_share_that_cannot_be_looked_at_is_tried_again(tmp_path: Path) -> None:
    """Nothing was counted as a try, and the status told no problem. A name that is too long is
    refused as a server that is down refuses."""
    config = DeliverConfig(name="share", folder=tmp_path / (300 * "x"))
    with pytest.raises(HandOverError, match="name too long"):
        make_target(config)(_scan(), _result(tmp_path / "result", measurements=[]))


def test_a_damaged_result_keeps_no_other_back(tmp_path: Path) -> None:
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    (tmp_path / "share").mkdir()
    outbox = Spool(tmp_path / "spool").folder / "outbox"
    _result(outbox / _IDS[0])
    _result(outbox / _IDS[1], measurements=[])
    handover = HandOver(load_config(config), logging.getLogger("deliver"))
    handover.look()
    handover.try_all("share", 1e9)
    (waiting,) = Ledger(tmp_path / "spool").waiting()
    assert (waiting.scan_id, waiting.tries) == (_IDS[0], 1)
    assert "measurements" in waiting.error
    assert (tmp_path / "share" / _IDS[1] / "measurements.csv").exists()


def test_a_scan_that_is_deleted_while_it_is_handed_over_waits_for_nobody(tmp_path: Path) -> None:
    """Status told of it until the next result came."""
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    spool = Spool(tmp_path / "spool")
    for name in _IDS:
        _result(spool.folder / "outbox" / name)
    handover = HandOver(load_config(config), logging.getLogger("deliver"))

    def deleted(scan: ScanRecord, result: Path) -> None:
        purge_scans(spool, [result.name], Removed())
        if scan.scan_id == _IDS[0]:
            raise HandOverError("it is gone")

    handover._targets["share"] = deleted
    handover.look()
    handover.try_all("share", 1e9)
    ledger = Ledger(spool.folder)
    assert ledger.waiting() == []
    assert [ledger.receivers(name) for name in _IDS] == [[], []]


def test_who_has_copies_is_known_after_a_result_was_taken_away(tmp_path: Path) -> None:
    """Deleting the scan named nobody then."""
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    (tmp_path / "share").mkdir()
    spool, scan_id = Spool(tmp_path / "spool"), ScanId(_IDS[0])
    for name in _IDS:
        _result(spool.folder / "outbox" / name, measurements=[])
    spool.notes.write(ScanNote(scan_id, "delivered"), durable=False)
    handover = HandOver(load_config(config), logging.getLogger("deliver"))
    handover.look()
    handover.try_all("share", 1e9)
    for name in _IDS:
        shutil.rmtree(spool.folder / "outbox" / name)
    handover.look()
    assert [Ledger(spool.folder).receivers(name) for name in _IDS] == [["share"], []]
    removed = Removed()
    purge_scans(spool, [scan_id], removed)
    assert removed.receivers == {"share"}


def test_the_name_of_a_deleted_folder_is_no_pattern(tmp_path: Path) -> None:
    """Everything would have been handed over again."""
    ledger = Ledger(tmp_path)
    ledger.finish(Waiting("share", _IDS[0]))
    ledger.keep(Waiting("orders", _IDS[0]))
    ledger.forget("*")
    assert ledger.receivers("2026*") == []
    assert (ledger.receivers(_IDS[0]), len(ledger.waiting())) == (["share"], 1)
