import errno
import multiprocessing
import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from waiting import wait_until

from station.core.errors import SpoolError
from station.core.scans import ScanId, ScanNote, failure_reason
from station.core.spool import MAX_DEATHS, Spool


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
    wait_until((folder / "ready").exists, "a claim")
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()


def test_a_killed_worker_costs_neither_a_try_nor_the_scan(tmp_path: Path) -> None:
    """Three restarts of the station used to end in "failed", however sound the scan was."""
    spool = Spool(tmp_path)
    _submit(spool, "a")
    for _ in range(2):
        _kill_a_worker(tmp_path, "claimed")
        assert spool.recover(retries=0) == ["a"]
    claim = spool.claim()
    assert claim is not None
    assert (claim.tries, claim.note.deaths) == (0, 2)
    claim.deliver(_result(spool, "a"))
    assert spool.recover(retries=2) == []


def _given_up_at_the_next_end(spool: Spool) -> None:
    claim = spool.claim()
    assert claim is not None
    claim.close()
    assert spool.recover(retries=2) == []
    assert spool.where("a") == "failed"


def test_a_scan_that_ends_every_worker_is_given_up(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    for _ in range(MAX_DEATHS):
        claim = spool.claim()
        assert claim is not None
        claim.close()
        assert spool.recover(retries=2) == ["a"]
    _given_up_at_the_next_end(spool)
    assert "the station ended" in failure_reason(spool.path("failed", "a"))


def test_a_disk_that_refuses_is_no_end_of_the_station(tmp_path: Path) -> None:
    """A scan that the station had ended on ten times was given up for one of these."""
    spool = Spool(tmp_path)
    _submit(spool, "a")
    spool.notes.write(ScanNote(ScanId("a"), "accepted", deaths=MAX_DEATHS), durable=False)
    claim = spool.claim()
    assert claim is not None
    claim.release()
    assert spool.recover(retries=2) == ["a"]
    _given_up_at_the_next_end(spool)


def test_a_scan_whose_jobs_crash_is_given_up_with_the_last_reason(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    claim.count_try("the job ended unexpectedly, by SIGSEGV")
    claim.close()
    assert spool.recover(retries=0) == []
    assert "by SIGSEGV" in failure_reason(spool.path("failed", "a"))
    spool.retry(ScanId("a"))
    again = spool.claim()
    assert again is not None
    assert again.tries == 0
    with pytest.raises(SpoolError, match="not among the failed"):
        spool.retry(ScanId("a"))


def test_a_result_that_was_moved_away_is_not_delivered_again(tmp_path: Path) -> None:
    """A pool killed between the result's new name and putting the bundle away did it twice."""
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    result = _result(spool, "a")
    claim._write("delivering", result=result.name, verdict="ok", reason="")
    result.rename(tmp_path / "fitting-room")
    claim.close()
    assert spool.recover(retries=2) == []
    assert spool.where("a") is None
    assert spool.path("done", "a").exists()
    _submit(spool, "a")
    assert spool.waiting() == []


def test_a_delivery_that_was_cut_short_is_finished_without_another_fit(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    claim._write("delivering", result=_result(spool, "a").name, verdict="rescan", reason="moved")
    claim.close()
    spool.sweep()
    assert spool.recover(retries=2) == []
    assert spool.where("a") == "outbox"
    note = spool.notes.read(ScanId("a"))
    assert note is not None
    assert (note.stage, note.verdict, note.reason) == ("delivered", "rescan", "moved")


def test_no_name_of_a_delivered_scan_stays_in_the_locks(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    claim.deliver(_result(spool, "a"))
    assert not list((tmp_path / "locks").iterdir())


@pytest.mark.parametrize("name", ["x" * 231, "../escape", "a b", "", "ä", "a\n"])
def test_only_a_scan_id_is_accepted(tmp_path: Path, name: str) -> None:
    """An id of 231 letters stopped all workers after each restart: its lock had too long a name."""
    spool = Spool(tmp_path / "spool")
    folder = tmp_path / "spool/tmp/x"
    folder.mkdir()
    with pytest.raises(SpoolError, match="not a valid scan id"):
        spool.submit(folder, name)


def test_what_is_no_bundle_in_the_queue_stops_nobody(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    (tmp_path / "queue" / ("0" * 231)).mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "queue/0-link").symlink_to(tmp_path / "elsewhere")
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    assert claim.scan_id == "a"


def test_the_same_scan_in_queue_and_work_is_one(tmp_path: Path) -> None:
    """Their rename kept failing, and the worker's thread died of it."""
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    claim.close()
    (tmp_path / "queue/a").mkdir()
    (tmp_path / "queue/a/bundle.json").write_text("{}")
    assert spool.claim() is None
    assert spool.recover(retries=2) == ["a"]
    again = spool.claim()
    assert again is not None
    assert spool.waiting() == []


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


def test_a_disk_that_refuses_while_a_scan_is_cancelled_leaves_nothing_stuck(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    with monkeypatch.context() as disk:
        disk.setattr("station.core.spool.Claim._move", _refuse)
        with pytest.raises(OSError, match="Input/output"):
            spool.withdraw("a", "cancelled by the operator")
    # The note says that it failed: another process brings that to its end.
    assert Spool(tmp_path).recover(2) == []
    assert spool.where("a") == "failed"
    assert failure_reason(spool.path("failed", "a")) == "cancelled by the operator"


def test_a_lock_file_that_could_not_be_removed_is_removed_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    lock = spool.lock(ScanId("a"))
    assert lock is not None
    with monkeypatch.context() as disk:
        disk.setattr(Path, "unlink", _refuse)
        spool.unlock(ScanId("a"), lock)
    held = spool.lock(ScanId("b"))
    assert held is not None
    assert len(list((tmp_path / "locks").iterdir())) == 2
    Spool(tmp_path).recover(2)
    assert [path.stem for path in (tmp_path / "locks").iterdir()] == ["b"]
    spool.unlock(ScanId("b"), held)


def test_a_note_that_cannot_be_read_leaves_the_scan_unlocked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process that recovers lives on: a lock that it kept would hold the scan for as long."""
    spool = Spool(tmp_path)
    _submit(spool, "a")
    claim = spool.claim()
    assert claim is not None
    claim.release()
    with monkeypatch.context() as broken:
        broken.setattr(spool, "note", _refuse)
        assert spool.recover(retries=2) == []
    assert spool.recover(retries=2) == ["a"]
    assert spool.waiting() == ["a"]


def test_an_interrupted_deletion_leaves_no_part_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    _submit(spool, "a")
    with monkeypatch.context() as interrupted:
        interrupted.setattr("station.core.scans.shutil.rmtree", _refuse)
        with pytest.raises(OSError):
            spool.remove(spool.path("queue", "a"))
    assert spool.where("a") is None
    assert spool.claim() is None


def test_a_note_that_was_cut_short_does_not_stay(tmp_path: Path) -> None:
    """Its label outlived the scan, for no retention period applied to it."""
    spool = Spool(tmp_path / "spool")
    old, fresh = (spool.notes.folder / f".{name}.json.0a1b2c3d.tmp" for name in ("a", "b"))
    for path in (old, fresh):
        path.write_text('{"label": "Order 1"}')
    os.utime(old, (1.8e9, 1.7e9))
    spool.notes.write(ScanNote(ScanId("c"), "armed"), durable=False)
    spool.sweep()
    assert {path.name for path in spool.notes.folder.iterdir()} == {fresh.name, "c.json"}


def test_a_spool_in_two_file_systems_is_refused_before_a_scan(tmp_path: Path) -> None:
    elsewhere = Path("/dev/shm") / f"booth-test-{os.getpid()}"
    elsewhere.mkdir()
    try:
        (tmp_path / "queue").symlink_to(elsewhere)
        with pytest.raises(SpoolError, match="queue lies in another file system"):
            Spool(tmp_path).check_space(0.0)
    finally:
        elsewhere.rmdir()


def test_a_file_system_that_takes_no_more_files_is_refused_before_a_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path)
    spool.check_space(0.0)
    full = SimpleNamespace(f_files=1000, f_favail=7)
    monkeypatch.setattr("station.core.scans.os.statvfs", lambda _: full)
    monkeypatch.setattr(
        "station.core.scans.shutil.disk_usage", lambda _: SimpleNamespace(free=1e12)
    )
    with pytest.raises(SpoolError, match="room for 7 more files, 200 are needed"):
        spool.check_space(0.0)


def _refuse(*_: object, **__: object) -> None:
    raise OSError(errno.EIO, os.strerror(errno.EIO))
