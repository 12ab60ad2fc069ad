"""Processes of `station run` that cannot be started at once."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from station.booth.supervisor import Service, supervise


def test_a_process_that_cannot_be_started_ends_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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
    told = capsys.readouterr().err
    assert "late cannot be started (Resource temporarily unavailable); restarting it" in told
