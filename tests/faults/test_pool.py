"""Workers that hang or meet a bad bundle: the scan ends in failed/ with its reason."""

import errno
import json
import logging
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from station.booth.deletion import purge_scans
from station.booth.retention import FILE, Deleted, Moment, expire_old
from station.core.config import RetentionConfig
from station.core.config_file import load_config
from station.core.errors import SpoolError
from station.core.files import held
from station.core.scans import REASON, ScanId, ScanNote
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting
from workers.reconstruct import pool
from workers.reconstruct.job_handle import WARM_UP_S, Outcome
from workers.reconstruct.pool import Worker

_DAY_S = 86_400.0
_CAMERA = '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'


def _serve_until_failed(folder: Path, scan_id: str, workers: str) -> str:
    """Run `reconstruct work` until the scan has failed; returns the reason."""
    (folder / "booth.toml").write_text(f"{_CAMERA}[workers]\n{workers}\n")
    process = subprocess.Popen(
        [sys.executable, "-m", "workers.cli", "work", "--config", str(folder / "booth.toml")]
    )
    reason = folder / "spool/failed" / scan_id / REASON
    try:
        deadline_s = time.monotonic() + 60.0 + 2 * WARM_UP_S
        while not reason.exists():
            assert time.monotonic() < deadline_s
            assert process.poll() is None
            time.sleep(0.1)
    finally:
        process.terminate()
        process.wait(timeout=20)
    return str(json.loads(reason.read_text())["reason"])


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "spool")


def test_a_hung_job_is_killed_and_tried_again(spool: Spool, bundle: Path, tmp_path: Path) -> None:
    temporary = spool.temporary("slow")
    shutil.copytree(bundle, temporary)
    spool.submit(temporary, "slow")
    reason = _serve_until_failed(tmp_path, "slow", "timeout_s = 0.02\nretries = 1")
    assert "was stopped" in reason
    assert not list((tmp_path / "spool/outbox").iterdir())


def test_a_bad_bundle_fails_once_with_its_reason(
    spool: Spool, bundle: Path, tmp_path: Path
) -> None:
    temporary = spool.temporary("torn")
    shutil.copytree(bundle, temporary)
    (temporary / "depth/front-lower/000.png").write_bytes(b"\x89PNG")
    spool.submit(temporary, "torn")
    reason = _serve_until_failed(tmp_path, "torn", "retries = 2")
    assert "000.png is torn" in reason
    assert (tmp_path / "spool/failed/torn/bundle.json").exists()


def _idle_worker(spool: Spool, folder: Path) -> Worker:
    """A worker whose thread was told to stop before it began."""
    (folder / "booth.toml").write_text(_CAMERA)
    stop = threading.Event()
    stop.set()
    worker = Worker(load_config(folder / "booth.toml"), spool, stop, logging.getLogger())
    worker.thread.join()
    return worker


def _refuse(*_: object) -> None:
    raise OSError(errno.ENOMEM, "Cannot allocate memory")


def test_no_memory_for_the_next_process_ends_no_job(
    spool: Spool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The job that ran was killed, again and again, and the disk was blamed."""
    worker = _idle_worker(spool, tmp_path)
    monkeypatch.setattr(pool, "JobProcess", _refuse)
    worker._warm_another()
    with pytest.raises(pool._NoStartError, match=r"no job can be started .*Cannot allocate"):
        worker._round()


def test_nothing_of_an_interrupted_job_stays(spool: Spool, tmp_path: Path) -> None:
    """Its folder was kept for as long as the workers ran."""
    worker = _idle_worker(spool, tmp_path)
    (temporary := spool.temporary("a")).mkdir()
    spool.submit(temporary, "a")
    claim = spool.claim()
    assert claim is not None
    process: Any = SimpleNamespace(send=lambda *_: None, outcome=_refuse)
    with pytest.raises(OSError, match="Cannot allocate"):
        worker._do(claim, process)
    assert not list((spool.folder / "tmp").iterdir())
    claim.close()


def test_a_scan_that_is_done_again_counts_once_for_the_cameras(
    spool: Spool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that refused the delivery made one person two."""
    worker = _idle_worker(spool, tmp_path)
    (temporary := spool.temporary("a")).mkdir()
    spool.submit(temporary, "a")
    claim = spool.claim()
    assert claim is not None
    done = Outcome(status="ok", evidence={"format": "booth-camera-evidence"})
    process: Any = SimpleNamespace(send=lambda *_: None, outcome=lambda *_: done)
    with monkeypatch.context() as full:
        full.setattr(claim, "deliver", _refuse)
        with pytest.raises(OSError, match="Cannot allocate"):
            worker._do(claim, process)
    worker._do(claim, process)
    assert spool.where("a") == "outbox"
    assert len(list((spool.folder / "cameras").iterdir())) == 1


def test_a_job_that_ends_while_it_is_asked_about_ends_no_workers(
    spool: Spool, tmp_path: Path
) -> None:
    """Two looks at it, and its end between them, would have stopped all workers."""

    class Ending(Worker):
        looks = 0

        @property
        def _busy(self) -> Any:
            self.looks += 1
            return SimpleNamespace(compiling=True) if self.looks == 1 else None

        @_busy.setter
        def _busy(self, _: object) -> None:
            """Nothing is kept."""

    stop = threading.Event()
    stop.set()
    (tmp_path / "booth.toml").write_text(_CAMERA)
    worker = Ending(load_config(tmp_path / "booth.toml"), spool, stop, logging.getLogger())
    worker.thread.join()
    assert worker.compiling
    assert not worker.compiling


def test_old_scans_are_removed_and_new_ones_kept(spool: Spool) -> None:
    for state in ("done", "outbox", "queue"):
        spool.path(state, "a").mkdir()
    # A target that booth.toml no longer names.
    ledger = Ledger(spool.folder)
    ledger.finish(Waiting("gone", "a"))
    retention = RetentionConfig(raw_days=2, result_days=9)
    start = Moment(1.8e9, 100.0, "boot")
    assert expire_old(spool, retention, start) == []
    later = replace(start, since_boot_s=100.0 + 3 * _DAY_S)
    assert expire_old(spool, retention, later) == [spool.path("done", "a")]
    later = replace(start, since_boot_s=100.0 + 10 * _DAY_S)
    assert ledger.receivers("a") == ["gone"]
    assert expire_old(spool, retention, later) == [spool.path("outbox", "a")]
    assert ledger.receivers("a") == []
    assert spool.path("queue", "a").exists()


def test_one_scan_that_stays_keeps_no_other(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that came after it was kept for ever."""
    for name in ("a", "b", "c", "d"):
        spool.path("done", name).mkdir()
    spool.path("done", "c").rmdir()
    spool.path("done", "c").write_text("no folder")
    start = Moment(1.8e9, 100.0, "boot")
    expire_old(spool, RetentionConfig(raw_days=2), start)
    remove = Spool.remove

    def refuse(spool: Spool, folder: Path) -> None:
        if folder.name == "a":
            raise PermissionError(13, "Permission denied", str(folder))
        if folder.name == "b":
            folder.rmdir()  # somebody takes it away at this moment
        remove(spool, folder)

    monkeypatch.setattr(Spool, "remove", refuse)
    later = replace(start, since_boot_s=100.0 + 3 * _DAY_S)
    with pytest.raises(PermissionError):
        expire_old(spool, RetentionConfig(raw_days=2), later)
    assert [path.name for path in (spool.folder / "done").iterdir()] == ["a"]
    monkeypatch.undo()
    assert expire_old(spool, RetentionConfig(raw_days=2), later) == [spool.path("done", "a")]
    assert not list((spool.folder / "tmp").iterdir())


def test_a_scan_that_is_put_back_is_claimed_anew(spool: Spool) -> None:
    """One whose job had hung and was tried again at once was said to be stuck during the second
    try: it had been in work at every look."""
    spool.path("queue", "a").mkdir()
    claim = spool.claim()
    assert claim is not None
    begun = pool.since({}, pool.claimed(spool), 5.0)
    assert list(pool.since(begun, pool.claimed(spool), 9.0).values()) == [5.0]
    time.sleep(0.1)  # the file system's clock ticks
    claim.put_back()
    claim.close()
    again = spool.claim()
    assert again is not None
    assert list(pool.since(begun, pool.claimed(spool), 9.0).values()) == [9.0]
    again.close()


@pytest.mark.parametrize("jump_days", [40.0, -40.0, -20000.0])
def test_a_wall_clock_that_jumps_deletes_nothing(spool: Spool, jump_days: float) -> None:
    """A clock 40 days ahead, or a dead battery, deleted what had been scanned that day."""
    for state in ("done", "outbox"):
        spool.path(state, "a").mkdir()
    start = Moment(1.8e9, 100.0, "boot")
    jumped = 1.8e9 + jump_days * _DAY_S
    for moment in (
        start,
        Moment(jumped, 200.0, "boot"),
        Moment(jumped, 50.0, "another boot"),
        Moment(1.8e9, 60.0, "a third one"),
    ):
        assert expire_old(spool, RetentionConfig(raw_days=5), moment) == []


@pytest.mark.parametrize("boots", [("", "boot"), ("boot", ""), ("", "")])
def test_the_time_since_an_unknown_boot_counts_once(spool: Spool, boots: tuple[str, str]) -> None:
    """An upgrade after a month without a restart deleted the results of a month."""
    spool.path("done", "a").mkdir()
    moments = [Moment(1.8e9, 30 * _DAY_S + n, boot) for n, boot in enumerate(boots)]
    assert [expire_old(spool, RetentionConfig(raw_days=5), moment) for moment in moments] == [
        [],
        [],
    ]


def test_a_station_that_was_off_for_the_night_counts_it(spool: Spool) -> None:
    spool.path("done", "a").mkdir()
    for day in range(4):
        moment = Moment(1.8e9 + day * _DAY_S, 3600.0, f"boot {day}")
        removed = expire_old(spool, RetentionConfig(raw_days=2.5), moment)
    assert removed == [spool.path("done", "a")]


def test_nothing_of_a_purged_scan_stays(spool: Spool) -> None:
    scan_id = ScanId("20260101T000000Z-0001")
    for state in ("done", "outbox", "debug"):
        (spool.folder / state / scan_id).mkdir(parents=True)
    (spool.folder / "tmp" / f"{scan_id}.99.1").mkdir()
    (spool.folder / "tmp" / f"{scan_id}.99.1/000.png").write_bytes(b"a body")
    (spool.folder / "tmp" / f"{scan_id}5.99.1").mkdir()
    spool.notes.write(ScanNote(scan_id, "delivered", label="Order 1"), durable=True)
    expire_old(spool, RetentionConfig())
    purge_scans(spool, [scan_id], Deleted())
    left = [path for path in spool.folder.rglob("*") if scan_id in path.name]
    assert [path.name for path in left] == [f"{scan_id}5.99.1"]
    assert scan_id not in (spool.folder / FILE).read_text()


def test_a_scan_is_purged_while_old_ones_are_removed(spool: Spool) -> None:
    """It was, and the command ended with an error that promised to retry."""
    spool.path("outbox", "a").mkdir()
    with held(spool.folder / "retention.lock", SpoolError("busy")):
        deleted = Deleted()
        purge_scans(spool, ["a"], deleted)
        assert deleted.paths == [spool.path("outbox", "a")]


def test_a_file_among_what_dead_writers_left_is_removed(spool: Spool) -> None:
    (spool.folder / "tmp/removed.0.1").write_text("no folder")
    (spool.folder / "tmp/link.0.1").symlink_to("/nowhere")
    spool.sweep()
    assert not list((spool.folder / "tmp").iterdir())
