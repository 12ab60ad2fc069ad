import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from station.core.errors import SpoolError
from station.core.spool import REASON, Spool


def _submit(spool: Spool, scan_id: str) -> None:
    temporary = spool.temporary(scan_id)
    temporary.mkdir()
    (temporary / "bundle.json").write_text("{}")
    spool.submit(temporary, scan_id)


def _result(spool: Spool, scan_id: str) -> Path:
    folder = spool.temporary(scan_id)
    folder.mkdir()
    (folder / "result.json").write_text("{}")
    return folder


def test_one_claim_one_delivery(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    assert spool.claim() is None
    assert spool.where("a") == "work"
    claim.deliver(_result(spool, "a"))
    assert spool.where("a") == "outbox"
    assert spool.path("done", "a").exists()


def test_the_same_scan_twice_is_one(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    _submit(spool, "a")
    assert spool.waiting() == ["a"]
    assert not list((tmp_path / "tmp").iterdir())


def _claim_and_hang(folder: Path, step: str) -> None:
    spool = Spool(folder)
    claim = spool.claim()
    assert claim is not None
    if step == "delivered":
        from station.core.files import publish_folder

        publish_folder(_result(spool, claim.scan_id), spool.path("outbox", claim.scan_id))
    (folder / "ready").touch()
    time.sleep(60)


def _kill_a_worker(folder: Path, step: str) -> None:
    (folder / "ready").unlink(missing_ok=True)
    worker = multiprocessing.get_context("spawn").Process(
        target=_claim_and_hang, args=(folder, step)
    )
    worker.start()
    while not (folder / "ready").exists():
        time.sleep(0.01)
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()


def test_a_killed_worker_costs_a_try_and_no_scan(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    _kill_a_worker(tmp_path, "claimed")
    assert spool.recover(retries=2) == ["a"]
    claim = spool.claim()
    assert claim is not None
    assert claim.tries == 2
    claim.deliver(_result(spool, "a"))
    assert spool.recover(retries=2) == []


def test_a_poisoned_scan_ends_in_failed_with_its_reason(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    for _ in range(2):
        _kill_a_worker(tmp_path, "claimed")
        spool.recover(retries=1)
    assert spool.where("a") == "failed"
    reason = json.loads((spool.path("failed", "a") / REASON).read_text())
    assert "died 2 times" in reason["reason"]


def test_a_crash_after_delivery_delivers_once(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    _kill_a_worker(tmp_path, "delivered")
    assert spool.recover(retries=2) == []
    assert spool.where("a") == "outbox"
    assert spool.path("done", "a").exists()
    assert spool.claim() is None


def test_a_living_workers_claim_is_left_alone(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    assert spool.claim() is not None
    assert Spool(tmp_path).recover(retries=0) == []
    assert spool.where("a") == "work"


def test_a_full_disk_is_said_before_the_scan(tmp_path: Path) -> None:
    with pytest.raises(SpoolError, match="MB free"):
        Spool(tmp_path).check_space(1e12)
