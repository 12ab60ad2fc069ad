"""Jobs that crash, hang, starve or compute nonsense, in a running station."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from booth import Booth, Scans, running_booth, until
from table import Row

from station.core.scans import REASON

_WORDS = {
    "segfault": "SIGSEGV",
    "loop": "not done after",
    "memory": "2048 MB",
    "nan": "",
}
_SETTINGS = """
[spool]
min_free_mb = 50
[workers]
timeout_s = 15
retries = 2
[console]
enabled = false
"""


def job_rows() -> list[Row]:
    """Each fault until the scan is given up, then once; the next scan is delivered each time."""
    with (
        tempfile.TemporaryDirectory() as name,
        running_booth(Path(name), settings=_SETTINGS) as (booth, scans),
    ):
        return [_always(booth, scans, order) for order in _WORDS] + [_once(booth, scans)]


def _always(booth: Booth, scans: Scans, order: str) -> Row:
    booth.order_job(order)
    scan_id = scans.take_until_accepted()
    reason = booth.spool / "failed" / scan_id / REASON
    until(reason.exists)
    booth.order_job("")
    told: dict[str, Any] = {"reason": "", "tries": 0}
    if reason.exists():
        told = json.loads(reason.read_text())
    after = scans.take_until_accepted()
    scans.settle()
    came = scans.delivered()[after]
    return Row(
        f"jobs: {order}",
        "failed with the reason, the next one comes",
        f"{told['tries']} tries: {told['reason'][:90]}; the next came {came} times",
        bool(told["reason"]) and _WORDS[order] in told["reason"] and came == 1,
    )


def _once(booth: Booth, scans: Scans) -> Row:
    booth.order_job("segfault")
    scan_id = scans.take_until_accepted()
    note = booth.spool / "scans" / f"{scan_id}.json"
    until(lambda: json.loads(note.read_text())["tries"] > 0)
    booth.order_job("")
    scans.settle()
    came = scans.delivered()[scan_id]
    return Row("a job that crashes once", "delivered once", f"came {came} times", came == 1)
