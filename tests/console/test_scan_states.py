"""States of scans that the API tells without a station."""

import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from station.archive.index import ScanIndex
from station.console.api import scans
from station.console.api.problems import ProblemError
from station.console.api.scans import _state
from station.console.live.control import NotRunningError
from station.core.config_file import load_config
from station.core.scans import ScanId, ScanNote
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting


def test_the_api_tells_of_a_scan_that_was_never_stored_without_a_station(
    spool: Spool, option: list[str]
) -> None:
    """It was said not to exist."""
    config = load_config(Path(option[1]))
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
    spool.notes.write(ScanNote(scan_id, "capturing"), durable=False)
    with pytest.raises(NotRunningError):
        _state(told, scan_id)
    spool.notes.write(ScanNote(scan_id, "failed", reason="the booth was stopped"), durable=False)
    scan = _state(told, scan_id)
    assert (scan.state, scan.reasons) == ("failed", ["the booth was stopped"])


def test_the_api_tells_of_a_scan_whose_result_was_taken_away(
    spool: Spool, option: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It did not exist while the station ran, and could not be deleted there."""
    config = load_config(Path(option[1]))
    audit = SimpleNamespace(note=lambda *words: noted.append(words[2:]))
    noted: list[Any] = []
    waiting = SimpleNamespace(status=lambda _: None, counting=dict)
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
