"""A process that warms up, does one job and ends: what it holds or leaks ends with it.

Communicates by JSON lines: it says {"compiling": true} if code has to be compiled, {"ready": true},
reads one {"bundle", "out", "method", "volume"}, reports {"step", "share"} and ends with {"status",
"reasons", "evidence"}, {"error"} (the scan cannot be used), {"disk"} (the disk refused, not the
fault of the scan) or {"died"}. Its first argument is the process to end with.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import traceback
from pathlib import Path
from typing import Any

from station.core.config import Volume
from station.core.errors import BoothError, DiskReadError
from station.core.service import die_with_parent, set_up_caches

MEMORY_BYTES = 2 << 30
"""Memory that a job may allocate; a usual one takes a third of it."""


def _say(channel: int, message: dict[str, Any]) -> None:
    left = (json.dumps(message) + "\n").encode()
    while left:
        left = left[os.write(channel, left) :]


def main() -> None:
    if len(sys.argv) > 1:
        die_with_parent(int(sys.argv[1]))
    set_up_caches()
    # Ctrl-C on a terminal, or its end, reaches the whole group; the pool decides when to end.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Libraries print to stdout; the pipe to the pool must carry only messages of this process.
    channel = os.dup(1)
    os.dup2(2, 1)
    from workers.reconstruct.compiling import compilation_told
    from workers.reconstruct.job import reconstruct_bundle, warm_up

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    with compilation_told(lambda: _say(channel, {"compiling": True})):
        model = warm_up()
    _say(channel, {"ready": True})
    line = sys.stdin.readline()
    if not line:
        return
    order = json.loads(line)
    bundle = Path(order["bundle"])
    try:
        summary = reconstruct_bundle(
            bundle,
            Path(order["out"]),
            method=order["method"],
            volume=Volume.model_validate(order["volume"]),
            model=model,
            progress=lambda step, share: _say(channel, {"step": step, "share": share}),
        )
    except DiskReadError as error:
        # Tried again like a job that died: waiting for the disk, all other scans would wait for
        # one bad sector.
        _say(channel, {"died": str(error)})
        return
    except BoothError as error:
        _say(channel, {"error": str(error)})
        return
    except OSError as error:
        # Of the bundle's own folders only: as above.
        here = Path(str(error.filename)).is_relative_to(bundle)
        _say(channel, {"died" if here else "disk": str(error)})
        return
    except MemoryError:
        _say(channel, {"died": f"the job needed more than {MEMORY_BYTES >> 20} MB of memory"})
        return
    except Exception as error:
        traceback.print_exc()
        _say(channel, {"died": f"the job ended unexpectedly ({type(error).__name__}: {error})"})
        return
    _say(
        channel,
        {
            "status": summary.status,
            "reasons": list(summary.reasons),
            "evidence": summary.evidence,
        },
    )


if __name__ == "__main__":
    main()
