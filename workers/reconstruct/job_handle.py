"""Handle of a job that runs in a process of its own: start it, wait for it, and learn how it
ended."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from station.core.config import BoothConfig

_LOOK_S = 0.2
WARM_UP_S = 120.0
"""Time until a process can do a job. The first one compiles the reconstruction, which takes most of
a minute, or more on a busy machine."""
_ENDED_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM)

Blame = Literal["scan", "job", "station", "disk", "start", "nobody"]
"""Cause of a failure: the scan cannot be used; the job crashed or hung; something outside ended
the process; the disk refused; the process ended before it had seen the scan; the station is being
stopped."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of a job."""

    status: str = ""
    """Verdict of the result ("ok" or "rescan"); empty if there is none."""
    reason: str = ""
    """Reason to scan again, or reason why there is no result."""
    blame: Blame = "nobody"
    evidence: Mapping[str, Any] | None = None
    """Document of format "booth-camera-evidence"; None if the scan says nothing of its cameras."""


class JobProcess:
    """One warmed-up process for one job."""

    def __init__(self, module: str = "workers.reconstruct.job_process") -> None:
        self.compiling = False
        """Code that a job needs is being compiled, as it is once after an installation."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def send(self, bundle: Path, out: Path, config: BoothConfig) -> None:
        """Send it the job. A process that died before it began is detected by `outcome`."""
        order = {
            "bundle": str(bundle),
            "out": str(out),
            "method": config.workers.method,
            "volume": config.volume.model_dump(),
        }
        stdin = self._process.stdin
        assert stdin is not None
        try:
            stdin.write((json.dumps(order) + "\n").encode())
            stdin.close()
        except BrokenPipeError:
            return

    def outcome(
        self, timeout_s: float, stop: threading.Event, begun: Callable[[], None]
    ) -> Outcome:
        """Wait for the job's end; it is killed when it takes too long or the station stops.

        Args:
            timeout_s: time for the job alone; before that the process may warm up.
            begun: called once, when the process is warm and does its job.
        """
        process = self._process
        last, warm = self._last_message(timeout_s, stop, begun)
        if last is None:
            self.kill()
            if stop.is_set():
                return Outcome(reason="the station was stopped")
            if not warm:
                reason = f"the process for the job was not ready after {WARM_UP_S:g} s"
                return Outcome(reason=reason, blame="station")
            return Outcome(
                reason=f"the job was not done after {timeout_s:g} s and was stopped", blame="job"
            )
        process.wait()
        if "error" in last:
            return Outcome(reason=str(last["error"]), blame="scan")
        if "disk" in last:
            return Outcome(reason=str(last["disk"]), blame="disk")
        if "died" in last:
            return Outcome(reason=str(last["died"]), blame="job")
        if "status" in last and process.returncode == 0:
            reasons = last.get("reasons")
            words = "; ".join(map(str, reasons)) if isinstance(reasons, list) else ""
            evidence = last.get("evidence")
            return Outcome(
                status=str(last["status"]),
                reason=words,
                evidence=evidence if isinstance(evidence, dict) else None,
            )
        return _died(process.returncode) if warm else _not_started(process.returncode)

    def _last_message(
        self, timeout_s: float, stop: threading.Event, begun: Callable[[], None]
    ) -> tuple[dict[str, object] | None, bool]:
        """The last line that the process writes before it ends, None when it takes too long and at
        the stop; and whether the process was ready for the job."""
        stdout = self._process.stdout
        assert stdout is not None
        last: dict[str, object] = {}
        pending, ready, at_work = b"", False, False
        deadline_s = time.monotonic() + WARM_UP_S
        with selectors.DefaultSelector() as selector:
            selector.register(stdout, selectors.EVENT_READ)
            while True:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0.0 or stop.is_set():
                    return None, ready
                if not selector.select(min(left_s, _LOOK_S)):
                    continue
                piece = stdout.read1(65536)  # type: ignore[attr-defined]  # a BufferedReader
                if not piece:
                    return last, ready
                *lines, pending = (pending + piece).split(b"\n")
                for line in lines:
                    last = json.loads(line)
                    self.compiling = "compiling" in last
                    if "ready" in last:
                        ready, deadline_s = True, time.monotonic() + timeout_s
                if not at_work and "step" in last:
                    at_work = True
                    begun()

    def kill(self) -> None:
        """End it, whatever it does."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()


def _died(code: int) -> Outcome:
    if code in _ENDED_FROM_OUTSIDE:
        return Outcome(reason=f"the job was ended by {_signal(code)}", blame="station")
    return Outcome(reason=f"the job ended unexpectedly, {_how(code)}", blame="job")


def _not_started(code: int) -> Outcome:
    """A model that is missing, or memory: no scan is at fault for it."""
    reason = f"no job can be started, its process ended {_how(code)}; see the workers' log"
    return Outcome(reason=reason, blame="start")


def _how(code: int) -> str:
    return f"by {_signal(code)}" if code < 0 else f"with code {code}"


def _signal(code: int) -> str:
    return signal.Signals(-code).name
