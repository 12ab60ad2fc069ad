"""Processes of `station run` that cannot be started at once, and its log."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from ctrl_c import heard
from running_station import STATION
from waiting import wait_until

from station.booth.retention import expire_old
from station.booth.supervisor import Service, supervise
from station.core.config_file import load_config
from station.core.errors import BoothError
from station.core.files import held
from station.core.spool import Spool


def test_a_process_that_cannot_be_started_ends_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A machine that was out of processes for a moment ended the whole booth."""
    stop, tries, start = threading.Event(), list[str](), subprocess.Popen

    def scarce(command: tuple[str, ...], **options: Any) -> subprocess.Popen[bytes]:
        tries.append(command[-3])
        if tries.count("late") in (1, 2) and command[-3] == "late":
            raise BlockingIOError(11, "Resource temporarily unavailable")
        if tries.count("late") == 3:
            stop.set()
        return start([sys.executable, "-c", "import time; time.sleep(60)"], **options)

    monkeypatch.setattr(subprocess, "Popen", scarce)
    table = [Service("late", ("late",)), Service("sound", ("sound",))]
    supervise(table, tmp_path / "booth.toml", tmp_path, stop)
    assert (tries.count("late"), tries.count("sound")) == (3, 1)
    told = "late cannot be started (Resource temporarily unavailable); restarting it"
    assert told in caplog.text


def test_every_line_of_the_log_has_one_form(tmp_path: Path) -> None:
    """Those of the supervisor, of a process that cannot go on and of the purge had no time."""
    config = tmp_path / "booth.toml"
    config.write_text(
        '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
        "[workers]\ncount = 0\n[console]\nenabled = false\n[retention]\nresult_days = 0\n"
    )
    loaded = load_config(config)
    old = Spool(loaded.spool.folder).path("failed", "20261121T100000Z-7f3a")
    old.mkdir()
    expire_old(Spool(loaded.spool.folder), loaded.retention)
    assert old.exists()
    busy = held(loaded.runtime.folder / "sync.lock", BoothError("busy"))
    with busy, (tmp_path / "log").open("w+") as log:
        run = [*STATION, "run", "--config", str(config)]
        with subprocess.Popen(run, stderr=log, preexec_fn=heard) as running:
            words = ("removed ", "sync ended with code 1", "a sync process is already running")
            wait_until(lambda: all(word in (tmp_path / "log").read_text() for word in words))
            assert running.poll() is None
            running.send_signal(signal.SIGINT)
        lines = (tmp_path / "log").read_text().splitlines()
    form = re.compile(r"\d\d:\d\d:\d\d [a-z ]+: (INFO|WARNING|ERROR) ")
    assert [line for line in lines if not form.match(line)] == []
