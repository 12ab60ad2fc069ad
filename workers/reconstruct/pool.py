"""Reconstruction workers: claim a scan, run it in a process of its own, deliver.

Input that cannot be used fails at once with its reason; a job that crashes or hangs is retried a
limited number of times; an end that the job did not cause (the station stopped, the disk refused,
no process can be started) does not count as a try. The next job's process warms up while the
current one works. A disk error does not end a worker: it continues when the disk works again.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from station.core.commands import config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.files import private_folder, write_json
from station.core.scans import ScanId
from station.core.service import Heartbeat, return_freed_memory, set_up_logs, stop_event
from station.core.spool import MAX_DEATHS, Claim, Spool
from workers.reconstruct.job_handle import WARM_UP_S, JobProcess, Outcome

CAMERAS = "cameras"
"""Folder of the spool that gathers what scans say of the cameras, nameless and out of order."""
_KEPT = 60
"""Scans of which it is kept."""
_POLL_S = 0.05
_ROUND_S = 0.25
_RECOVERY_PERIOD_S = 2.0
_DISK_PAUSE_S = 1.0
_SLACK_S = 60.0
"""Beyond the time limits of a job and its warm-up, before a worker counts as hanging."""
_STUCK_S = 60.0
"""Beyond a job's time limit, before its scan counts as stuck."""

Claimed = tuple[ScanId, int]
"""A scan in work, and the change of its folder by the rename that claimed it."""


class _NoStartError(Exception):
    """No process for a job can be started; the scan waits."""


class Worker:
    """One thread that processes the queue."""

    def __init__(
        self, config: BoothConfig, spool: Spool, stop: threading.Event, log: logging.Logger
    ) -> None:
        self._config, self._spool, self._stop, self._log = config, spool, stop, log
        self._spare: JobProcess | None = None
        self._busy: JobProcess | None = None
        self.scan_id: ScanId | None = None
        self.problem = ""
        self.delivered = self.failed = 0
        self.progress_s = time.monotonic()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self.progress_s = time.monotonic()
                try:
                    worked = self._round()
                    self.problem = ""
                except OSError as error:
                    self._trouble(f"the disk cannot be used ({error})")
                    continue
                except _NoStartError as error:
                    self._trouble(str(error))
                    continue
                except Exception as error:
                    self._log.exception("a worker continues after an unexpected error")
                    self._trouble(f"{type(error).__name__}: {error}")
                    continue
                if not worked:
                    self._stop.wait(_POLL_S)
        finally:
            if self._spare is not None:
                self._spare.kill()

    def _trouble(self, problem: str) -> None:
        if problem != self.problem:
            self._log.warning("%s; trying again", problem)
        self.problem = problem
        self._stop.wait(_DISK_PAUSE_S)

    def _round(self) -> bool:
        """Do the next scan; False if none waits."""
        if self._spare is None:
            try:
                self._spare = JobProcess()
            except OSError as error:
                raise _NoStartError(f"no job can be started ({error})") from None
        claim = self._spool.claim()
        if claim is None:
            return False
        self.scan_id = claim.scan_id
        process, self._spare = self._spare, None
        self._busy = process
        try:
            self._do(claim, process)
        except OSError:
            claim.release()
            raise
        finally:
            self.scan_id = self._busy = None
            process.kill()
            claim.close()
        return True

    def _do(self, claim: Claim, process: JobProcess) -> None:
        out = private_folder(self._spool.temporary(claim.scan_id))
        try:
            self._work(claim, process, out)
        except BaseException:
            # While this process lives no sweep removes it; a delivery that was begun needs it.
            with suppress(OSError):
                if self._spool.note(claim.scan_id).result != out.name:
                    shutil.rmtree(out)
            raise

    def _work(self, claim: Claim, process: JobProcess, out: Path) -> None:
        process.send(claim.bundle, out, self._config)
        outcome = process.outcome(self._config.workers.timeout_s, self._stop, self._warm_another)
        if outcome.status:
            claim.deliver(out, outcome.status, outcome.reason)
            self.delivered += 1
            # Not before: a scan that is done again would count as two people's.
            if outcome.evidence is not None:
                keep_evidence(outcome.evidence, self._spool.folder / CAMERAS)
            self._log.info("scan %s delivered", claim.scan_id, extra={"scan": claim.scan_id})
            return
        shutil.rmtree(out, ignore_errors=True)
        self._settle(claim, outcome)

    @property
    def compiling(self) -> bool:
        """Whether its scan waits until what a job needs is compiled."""
        busy = self._busy  # its thread may end the job meanwhile
        return busy is not None and busy.compiling

    def _warm_another(self) -> None:
        """The next job's process warms up while this one works."""
        with suppress(OSError):  # no memory: the next round tries again, this job goes on
            self._spare = JobProcess()

    def _settle(self, claim: Claim, outcome: Outcome) -> None:
        """Settle a scan that ended without a result."""
        if outcome.blame == "nobody":
            claim.put_back()
            return
        if outcome.blame == "disk":
            claim.put_back()
            raise OSError(outcome.reason)
        if outcome.blame == "start":
            claim.put_back()
            raise _NoStartError(outcome.reason)
        if outcome.blame == "station":
            claim.count_death()
            given_up = claim.note.deaths > MAX_DEATHS
        else:
            claim.count_try(outcome.reason)
            given_up = claim.tries > self._config.workers.retries
        about = {"scan": claim.scan_id}
        if given_up or outcome.blame == "scan":
            claim.fail(outcome.reason)
            self.failed += 1
            self._log.error("scan %s failed: %s", claim.scan_id, outcome.reason, extra=about)
        else:
            claim.put_back()
            words = "scan %s is tried again: %s"
            self._log.warning(words, claim.scan_id, outcome.reason, extra=about)


def keep_evidence(document: Mapping[str, Any], folder: Path) -> None:
    """Put what a scan says of its cameras to that of other scans, under a name that tells neither
    the scan nor its time; the oldest beyond _KEPT go.

    Losing it loses nothing else, also where the disk refuses.
    """
    try:
        write_json(private_folder(folder) / f"{uuid.uuid4().hex}.json", document)
        kept = sorted(folder.glob("*.json"), key=lambda entry: entry.stat().st_mtime)
        for old in kept[:-_KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return


def serve(config: BoothConfig, stop: threading.Event, log: logging.Logger) -> None:
    """Run the configured number of workers until told to stop."""
    spool = Spool(config.spool.folder)
    heart = Heartbeat(config.runtime.folder, "workers")
    workers = [Worker(config, spool, stop, log) for _ in range(config.workers.count)]
    heart.ready()
    recovered_s, problem = -_RECOVERY_PERIOD_S, ""
    claimed_s: dict[Claimed, float] = {}
    while not stop.is_set():
        now_s = time.monotonic()
        if now_s - recovered_s >= _RECOVERY_PERIOD_S:
            recovered_s = now_s
            problem = _recover(config, spool, log)
            with suppress(OSError):
                claimed_s = since(claimed_s, claimed(spool), now_s)
        limit_s = WARM_UP_S + config.workers.timeout_s + _SLACK_S
        hanging = [w for w in workers if not w.thread.is_alive() or now_s - w.progress_s > limit_s]
        if not hanging:
            heart.beat()
        if heart.due:
            heart.report(
                {
                    "busy": [w.scan_id for w in workers if w.scan_id],
                    "compiling": any(w.compiling for w in workers),
                    "stuck": [
                        scan_id
                        for (scan_id, _), begun_s in claimed_s.items()
                        if now_s - begun_s > config.workers.timeout_s + _STUCK_S
                    ],
                    "threads": sum(w.thread.is_alive() for w in workers),
                    "delivered": sum(w.delivered for w in workers),
                    "failed": sum(w.failed for w in workers),
                    "problems": sorted(
                        {f"workers: {p}" for p in (problem, *(w.problem for w in workers)) if p}
                    ),
                }
            )
        stop.wait(_ROUND_S)
    for worker in workers:
        worker.thread.join()


def claimed(spool: Spool) -> list[Claimed]:
    """Scans in work. One that was put back and claimed again between two looks is another one."""
    found = []
    for scan_id in spool.scans_in("work"):
        with suppress(FileNotFoundError):
            found.append((scan_id, spool.path("work", scan_id).stat().st_ctime_ns))
    return found


def since(
    before: Mapping[Claimed, float], claims: Iterable[Claimed], now_s: float
) -> dict[Claimed, float]:
    """Moments at which each of the claims was first seen (pure)."""
    return {claim: before.get(claim, now_s) for claim in claims}


def _recover(config: BoothConfig, spool: Spool, log: logging.Logger) -> str:
    """Recover scans whose worker died; returns a description of any obstacle."""
    try:
        for scan_id in spool.recover(config.workers.retries):
            words = "scan %s is put back: work on it was interrupted"
            log.warning(words, scan_id, extra={"scan": scan_id})
    except OSError as error:
        return f"the spool cannot be looked through ({error}); check its disk"
    return ""


@click.command()
@config_option
def work(config_path: Path | None) -> None:
    """Reconstruct the scans in the spool's queue as they come.

    \b
    Examples:
      reconstruct work --config booth.toml
    """
    config = load_config(find_config(config_path))
    return_freed_memory()
    serve(config, stop_event(), set_up_logs("workers"))
