"""`station deliver`: hands results over to the programs of [[deliver]], with unlimited retries."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from station.archive.index import ScanIndex
from station.archive.records import ScanRecord
from station.core.commands import config_option
from station.core.config import BoothConfig
from station.core.config_file import find_config, load_config
from station.core.errors import BoothError, SpoolError
from station.core.scans import ScanId
from station.core.service import (
    NOTHING_RUNS,
    Heartbeat,
    anything_runs,
    only_process,
    stop_event,
)
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting
from station.handover.targets import make_target

_POLL_S = 0.2
_SETTLED_NS = 1_000_000_000
"""Age below which a folder is read again: changes within one tick of the file system's clock look
like one."""
_REFUSED_S = 30.0
_RESULTS = 100_000
_HANGS_S = 60.0
"""A try takes at most ten seconds at a webhook; a folder's may wait indefinitely for a lost
server."""


class HandOver:
    """Serves each target separately: a slow or missing one does not delay the others."""

    def __init__(self, config: BoothConfig, log: logging.Logger) -> None:
        self._config, self._log = config, log
        self._spool = Spool(config.spool.folder)
        self._ledger = Ledger(config.spool.folder)
        self._index = ScanIndex(self._spool)
        self._targets = {section.name: make_target(section) for section in config.deliver}
        self._without_rescans = {s.name for s in config.deliver if not s.rescans}
        self._round_s = dict.fromkeys(self._targets, time.monotonic())
        """Moment of each target's last progress, monotonic seconds."""
        self._refused: dict[str, str] = {}
        """Targets that wait for the spool's disk, and in which words."""
        self._heart = Heartbeat(config.runtime.folder, "deliver")

    def run(self, stop: threading.Event) -> None:
        """Run until told to stop."""
        threads = [
            threading.Thread(target=self._serve, args=(name, stop), daemon=True)
            for name in self._targets
        ]
        for thread in threads:
            thread.start()
        self._heart.ready()
        changed_ns = -1
        problem = ""
        while not stop.wait(_POLL_S):
            try:
                now_ns = (self._spool.folder / "outbox").stat().st_mtime_ns
                if now_ns != changed_ns or time.time_ns() - now_ns <= _SETTLED_NS:
                    self.look()
                    changed_ns = now_ns
                problem = ""
            except (OSError, SpoolError) as error:
                problem = f"deliver: the spool cannot be read ({error}); check its disk"
            self._heart.beat()
            if self._heart.due:
                self._heart.report(self.health(problem))

    def health(self, problem: str = "") -> dict[str, Any]:
        """Health report: the number of results that wait for each target, and problems."""
        waiting = self._ledger.waiting()
        problems = [problem] if problem else []
        problems += self._refused.values()
        counts = {}
        now_s = time.monotonic()
        for name in self._targets:
            mine = [entry for entry in waiting if entry.target == name]
            counts[name] = len(mine)
            errors = [entry.error for entry in mine if entry.error]
            if now_s - self._round_s[name] > _HANGS_S:
                problems.append(
                    f"deliver {name}: the target has not responded for "
                    f"{now_s - self._round_s[name]:.0f} s; check the network and the other machine"
                )
            elif errors:
                problems.append(
                    f"deliver {name}: {len(errors)} not handed over ({errors[0]}); "
                    "it will be retried (at once: station deliver --now)"
                )
        return {"waiting": counts, "problems": problems}

    def look(self) -> None:
        """Record new results in the outbox."""
        found = self._index.find(states=["delivered", "rescan"], limit=_RESULTS)
        noted = self._spool.notes.ids()
        for section in self._config.deliver:
            # What cannot be read has its verdict when it can.
            wanted = [
                scan.scan_id
                for scan in found
                if scan.state == "delivered" or section.rescans or scan.unreadable
            ]
            for entry in self._ledger.follow(section.name, wanted, noted):
                # Whoever took it, or deleted it, may not know who has not received it.
                if not self._spool.path("outbox", entry.scan_id).exists():
                    words = "scan %s left the outbox before it was handed over to %s"
                    about = {"scan": entry.scan_id}
                    self._log.warning(words, entry.scan_id, entry.target, extra=about)

    def _serve(self, name: str, stop: threading.Event) -> None:
        while not stop.wait(_POLL_S):
            self._round_s[name] = time.monotonic()
            try:
                self.try_all(name, time.time())
                self._refused.pop(name, None)
            except BoothError as error:
                self._log.warning("%s: %s", name, error)
            except OSError as error:
                self._refused[name] = (
                    f"deliver {name}: it cannot be recorded what is handed over ({error}); "
                    "check the spool's disk"
                )
                self._log.warning("%s", self._refused[name])
                # At once, the target would receive the same result several times a second.
                stop.wait(_REFUSED_S)

    def try_all(self, name: str, now_s: float) -> None:
        """Hand over the results that are due to one target."""
        mine = [entry for entry in self._ledger.waiting() if entry.target == name]
        due = [entry for entry in mine if entry.due(now_s)]
        received, ahead_s = False, now_s - time.monotonic()
        for entry in due:
            self._round_s[name] = time.monotonic()
            received |= self._try(entry, ahead_s)
            self._settle(entry)
        if received:
            # The others need not wait as long as after their own failures.
            for entry in mine:
                if entry not in due:
                    self._ledger.keep(replace(entry, next_s=0.0))

    def _settle(self, entry: Waiting) -> None:
        """Wait for no result that is gone: what became of a try was recorded after that."""
        if self._spool.path("outbox", entry.scan_id).exists():
            return
        self._ledger.drop(entry)
        if self._spool.notes.path(ScanId(entry.scan_id)).exists():
            return
        if entry.target in self._ledger.receivers(entry.scan_id):
            words = "scan %s was deleted while it was handed over to %s, which has a copy"
            self._log.warning(words, entry.scan_id, entry.target, extra={"scan": entry.scan_id})
        self._ledger.forget(entry.scan_id)

    def _try(self, entry: Waiting, ahead_s: float) -> bool:
        """Hand one result over; whether the target has received it.

        Args:
            ahead_s: what the times of tries are ahead of the monotonic clock.
        """
        scan: ScanRecord | None = self._index.get(entry.scan_id)
        if scan is None:
            return False
        if scan.unreadable:
            # Its verdict may be another, and who has received it does not get it again.
            self._postpone(entry, scan.reasons[0], ahead_s)
            return False
        if scan.state == "rescan" and entry.target in self._without_rescans:
            self._ledger.drop(entry)
            return False
        try:
            self._targets[entry.target](scan, self._spool.path("outbox", entry.scan_id))
        except BoothError as error:
            self._postpone(entry, str(error), ahead_s)
            return False
        except Exception as error:
            # One result that is damaged must not keep the others from being handed over.
            self._log.exception("handing over %s", entry.scan_id, extra={"scan": entry.scan_id})
            self._postpone(entry, f"{type(error).__name__}: {error}", ahead_s)
            return False
        self._ledger.finish(entry)
        self._log.info(
            "%s handed over to %s", entry.scan_id, entry.target, extra={"scan": entry.scan_id}
        )
        return True

    def _postpone(self, entry: Waiting, reason: str, ahead_s: float) -> None:
        # From the end of the try: a slow receiver would get the next one without a pause.
        ended_s = time.monotonic() + ahead_s
        after = entry.failed(reason, ended_s)
        self._ledger.keep(after)
        self._log.warning(
            "%s not handed over to %s (%s); retrying in %.0f s",
            entry.scan_id, entry.target, reason, after.next_s - ended_s,
            extra={"scan": entry.scan_id},
        )  # fmt: skip


@click.command()
@config_option
@click.option("--now", is_flag=True, help="let the booth try at once what failed before, and end")
def deliver(config_path: Path | None, now: bool) -> None:
    """Hand results over to the programs of [[deliver]]; `station run` starts it.

    \b
    Examples:
      station deliver --now                  the share is back: do not wait for the next try
      station deliver --config booth.toml
    """
    config = load_config(find_config(config_path))
    if not config.deliver:
        raise BoothError("booth.toml has no [[deliver]]: there is nobody to hand results over to")
    if now:
        names = [section.name for section in config.deliver]
        waiting = Counter(entry.target for entry in Ledger(config.spool.folder).try_now(names))
        for name in names:
            click.echo(f"deliver {name}: {waiting[name] or 'nothing'} to hand over")
        if waiting:
            runs = anything_runs(config.runtime.folder)
            click.echo("being tried; station status shows what fails" if runs else NOTHING_RUNS)
        return
    with only_process(config.runtime.folder, "deliver") as log:
        HandOver(config, log).run(stop_event())
