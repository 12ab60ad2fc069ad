"""Reconstruction workers: claim a scan, run it in a process of its own, deliver.

Input that cannot be used fails at once with its reason; a crash or a hang is tried again. The next
job's process warms up while the current one works.
"""

from __future__ import annotations

import json
import logging
import selectors
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import click

from station.core.config import BoothConfig, find_config, load_config
from station.core.files import private_folder
from station.core.service import notify, set_up_logs, stop_event
from station.core.spool import Claim, Spool

_POLL_S = 0.05
_RECOVERY_PERIOD_S = 2.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of a job's process."""

    delivered: bool
    final: bool
    """Whether another try would end in the same way."""
    reason: str


class JobProcess:
    """One warmed-up process for one job."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "workers.reconstruct.job_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def run(self, bundle: Path, out: Path, config: BoothConfig) -> Outcome:
        """Send the job and wait for its end; a job that takes too long is killed."""
        process = self._process
        assert process.stdin is not None
        order = {
            "bundle": str(bundle),
            "out": str(out),
            "method": config.workers.method,
            "volume": config.volume.model_dump(),
        }
        timeout_s = config.workers.timeout_s
        try:
            process.stdin.write((json.dumps(order) + "\n").encode())
            process.stdin.close()
        except BrokenPipeError:
            return Outcome(False, False, "the worker process died before it began")
        last = self._last_message(time.monotonic() + timeout_s)
        if last is None:
            self.kill()
            return Outcome(False, False, f"the job hung for {timeout_s:g} s")
        process.wait()
        if "error" in last:
            return Outcome(False, True, str(last["error"]))
        if "status" not in last or process.returncode != 0:
            return Outcome(False, False, f"the worker process died (code {process.returncode})")
        return Outcome(True, True, "")

    def _last_message(self, deadline_s: float) -> dict[str, object] | None:
        """Last message of the process before it ends; None at the deadline."""
        stdout = self._process.stdout
        assert stdout is not None
        last: dict[str, object] = {}
        pending = b""
        with selectors.DefaultSelector() as selector:
            selector.register(stdout, selectors.EVENT_READ)
            while True:
                if not selector.select(max(0.0, deadline_s - time.monotonic())):
                    return None
                piece = stdout.read1(65536)  # type: ignore[attr-defined]  # a BufferedReader
                if not piece:
                    return last
                *lines, pending = (pending + piece).split(b"\n")
                for line in lines:
                    last = json.loads(line)

    def kill(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()


def serve(config: BoothConfig, stop: threading.Event, log: logging.Logger) -> None:
    """Run the configured number of workers until told to stop."""
    spool = Spool(config.spool.folder)
    workers = [
        threading.Thread(target=_work, args=(config, spool, stop, log), name=f"worker {index}")
        for index in range(config.workers.count)
    ]
    for worker in workers:
        worker.start()
    notify("READY=1")
    while not stop.is_set():
        for scan_id in spool.recover(config.workers.retries):
            log.warning("scan %s is tried again: its worker died", scan_id)
        notify("WATCHDOG=1")
        stop.wait(_RECOVERY_PERIOD_S)
    for worker in workers:
        worker.join()


def _work(config: BoothConfig, spool: Spool, stop: threading.Event, log: logging.Logger) -> None:
    spare = JobProcess()
    try:
        while not stop.is_set():
            claim = spool.claim()
            if claim is None:
                stop.wait(_POLL_S)
                continue
            process, spare = spare, JobProcess()
            try:
                _do(config, spool, claim, process, log)
            finally:
                process.kill()
    finally:
        spare.kill()


def _do(
    config: BoothConfig, spool: Spool, claim: Claim, process: JobProcess, log: logging.Logger
) -> None:
    out = private_folder(spool.temporary(claim.scan_id))
    outcome = process.run(claim.bundle, out, config)
    if outcome.delivered:
        claim.deliver(out)
        log.info("scan %s delivered", claim.scan_id)
        return
    shutil.rmtree(out, ignore_errors=True)
    if outcome.final or claim.tries > config.workers.retries:
        claim.fail(outcome.reason)
        log.error("scan %s failed: %s", claim.scan_id, outcome.reason)
    else:
        claim.put_back()
        log.warning("scan %s is tried again: %s", claim.scan_id, outcome.reason)


@click.command()
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
def work(config_path: Path | None) -> None:
    """Reconstruct the scans in the spool's queue as they come.

    \b
    Examples:
      reconstruct work --config booth.toml
    """
    config = load_config(find_config(config_path))
    serve(config, stop_event(), set_up_logs("workers"))
