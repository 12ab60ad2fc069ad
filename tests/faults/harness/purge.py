"""A purged scan leaves no file and no name."""

from __future__ import annotations

import os
import secrets
import signal
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

from booth import Booth, Scans, running_booth
from table import Row

_ROUNDS = 4


def purge_rows() -> list[Row]:
    """Purge scans by id and by label: delivered, failed, cancelled, and of killed processes."""
    with (
        tempfile.TemporaryDirectory() as name,
        running_booth(Path(name), job="quick") as (booth, scans),
    ):
        labels = [_leave_behind(booth, scans) for _ in range(_ROUNDS)]
        everything = list(scans.told)
        scans.settle()
        booth.command("list")
        # What a killed process was writing is swept when control and sync start again.
        for process in ("control", "sync"):
            [pid] = booth.pids(process)
            os.kill(pid, signal.SIGKILL)
            booth.wait(partial(booth.replaced, process, pid), f"{process} is back")
        for label in labels:
            booth.command("purge", "--label", label)
        for scan_id in everything:
            booth.command("purge", scan_id)
        left = [
            path
            for word in (*everything, *labels)
            for path in booth.spool.rglob("*")
            if word in path.name or (path.is_file() and word.encode() in path.read_bytes())
        ]
        spoken = sum(label in booth.station.log.read_text() for label in labels)
    for path in left:
        print(f"        left: {path}", flush=True)
    return [
        Row(
            "purge by id and by label",
            "0 files, 0 names; no label in a log",
            f"{len(everything)} scans, {len(left)} traces under the spool, {spoken} labels in logs",
            not left and not spoken,
        )
    ]


def _leave_behind(booth: Booth, scans: Scans) -> str:
    """Scans that end in every way; returns their label."""
    label = f"Order {secrets.token_hex(6)}"
    scans.take("--label", label)
    camera = booth.cameras[0]
    booth.order_sensor(camera, "silent")
    time.sleep(1.5)
    scans.take("--label", label)
    booth.order_sensor(camera, "")
    booth.wait(booth.well, "the booth is whole after a silent sensor")
    for process, after_s in (("sync", 0.7), ("workers", 1.2)):
        taking = threading.Thread(target=scans.take, args=("--label", label))
        taking.start()
        time.sleep(after_s)
        for pid in booth.pids(process):
            os.kill(pid, signal.SIGKILL)
        taking.join()
        booth.wait(booth.well, f"the booth is whole after the end of {process}")
    return label
