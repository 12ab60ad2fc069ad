"""Jobs that crash, hang, starve or compute nonsense: who is to blame, and what is said."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from waiting import wait_until

from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.scans import ScanId
from station.core.spool import Spool
from station.sensors.recorded import RecordedCamera
from workers.reconstruct import pool
from workers.reconstruct.job_handle import JobProcess, Outcome

_MODULE = """
import os, signal
from pathlib import Path
import numpy as np
import workers.reconstruct.job as job
from station.core.errors import DiskReadError
from workers.reconstruct.job_process import main

def reconstruct(bundle, out, progress, **_):
    progress("loading", 0.0)
    {act}
    return job.JobSummary("ok", ())

job.warm_up = lambda: None
job.reconstruct_bundle = reconstruct
main()
"""


_COMPILES = """
def warm_up():
    import numba, time
    numba.njit(lambda: 1)()
    while not os.path.exists("{done}"):
        time.sleep(0.01)

job.warm_up = warm_up
"""


def _outcome(folder: Path, monkeypatch: pytest.MonkeyPatch, act: str) -> Outcome:
    (folder / "spoilt_job.py").write_text(_MODULE.format(act=act))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    camera = RecordedCamera(name="a", recording=Path("a"))
    process = JobProcess("spoilt_job")
    begun = threading.Event()
    process.send(folder, folder, BoothConfig(cameras=(camera,)))
    timeout_s = 5.0 if "while" in act else 100.0
    outcome = process.outcome(timeout_s, threading.Event(), begun.set)
    process.kill()
    return outcome


def test_a_job_that_is_compiled_first_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = tmp_path / "compiled"
    *module, end = _MODULE.format(act="pass").splitlines()
    lines = [*module, _COMPILES.format(done=compiled), end]
    (tmp_path / "first_job.py").write_text("\n".join(lines))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    process = JobProcess("first_job")
    config = BoothConfig(cameras=(RecordedCamera(name="a", recording=Path("a")),))
    process.send(tmp_path, tmp_path, config)
    with ThreadPoolExecutor(1) as beside:
        ending = beside.submit(process.outcome, 100.0, threading.Event(), lambda: None)
        wait_until(lambda: process.compiling or ending.done(), "compiling")
        compiled.touch()
        assert ending.result() == Outcome(status="ok")
    assert not process.compiling


@pytest.mark.parametrize(
    ("act", "blame", "words"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", "job", "by SIGSEGV"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "station", "by SIGKILL"),
        ("os._exit(7)", "job", "with code 7"),
        ("while True: pass", "job", "not done after 5 s"),
        ("np.ones(10 << 27)", "job", "more than 2048 MB"),
        ("raise OSError(28, 'No space left on device')", "disk", "No space left"),
        ("raise OSError(5, 'Input/output error', str(bundle / 'depth'))", "job", "Input/output"),
        ("raise ValueError('Out of range float values: nan')", "job", "ValueError"),
        ("raise DiskReadError('000.png cannot be read; scan again')", "job", "000.png"),
    ],
)
def test_an_end_without_a_result_has_a_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: str, blame: str, words: str
) -> None:
    outcome = _outcome(tmp_path, monkeypatch, act)
    assert (outcome.blame, outcome.status) == (blame, "")
    assert words in outcome.reason


def test_a_process_that_cannot_start_costs_no_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing model sent every waiting scan to failed/, three tries each."""
    (tmp_path / "no_job.py").write_text("raise SystemExit('the model is missing')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(pool, "JobProcess", lambda: JobProcess("no_job"))
    monkeypatch.setattr(pool, "_DISK_PAUSE_S", 0.01)
    (tmp_path / "booth.toml").write_text(
        '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
    )
    config = load_config(tmp_path / "booth.toml")
    spool = Spool(config.spool.folder)
    bundle = spool.temporary("a")
    bundle.mkdir()
    spool.submit(bundle, "a")
    starts = 0

    def started(problem: str) -> None:
        nonlocal starts
        starts += problem != ""

    stop = threading.Event()
    worker = pool.Worker(config, spool, stop, logging.getLogger("workers"))
    monkeypatch.setattr(worker, "_trouble", started)
    wait_until(lambda: starts >= config.workers.retries + 2, "tries")
    stop.set()
    worker.thread.join()
    assert (spool.waiting(), spool.scans_in("failed")) == (["a"], [])
    assert spool.note(ScanId("a")).tries == spool.note(ScanId("a")).deaths == 0


def test_a_sound_job_has_its_verdict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert _outcome(tmp_path, monkeypatch, "pass") == Outcome(status="ok")
