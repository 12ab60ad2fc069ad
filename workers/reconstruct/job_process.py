"""Process that warms up, does one job and ends, so that nothing it holds or leaks outlives the job.

Speaks JSON lines: it says {"ready": true}, reads one {"bundle", "out", "method", "volume"}, reports
{"step", "share"} and ends with {"status", "reasons"} or {"error"}.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

from station.core.config import Volume
from station.core.errors import BoothError
from station.core.service import die_with_parent


def _say(channel: int, message: dict[str, Any]) -> None:
    os.write(channel, (json.dumps(message) + "\n").encode())


def main() -> None:
    die_with_parent()
    # Ctrl-C on a terminal reaches the whole group; the pool decides when this process ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries print to stdout; only this process may write to the pipe to the pool.
    channel = os.dup(1)
    os.dup2(2, 1)
    from workers.reconstruct.job import reconstruct_bundle, warm_up

    model = warm_up()
    _say(channel, {"ready": True})
    line = sys.stdin.readline()
    if not line:
        return
    order = json.loads(line)
    try:
        summary = reconstruct_bundle(
            Path(order["bundle"]),
            Path(order["out"]),
            method=order["method"],
            volume=Volume.model_validate(order["volume"]),
            model=model,
            progress=lambda step, share: _say(channel, {"step": step, "share": share}),
        )
    except BoothError as error:
        _say(channel, {"error": str(error)})
        return
    _say(channel, {"status": summary.status, "reasons": list(summary.reasons)})


if __name__ == "__main__":
    main()
