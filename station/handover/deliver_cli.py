"""`station deliver`: hands results over to the programs of [[deliver]], for as long as it takes."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import click

from station.archive.index import ScanIndex
from station.archive.records import ScanRecord
from station.core.config import BoothConfig, find_config, load_config
from station.core.errors import BoothError
from station.core.service import notify, set_up_logs, stop_event
from station.core.spool import Spool
from station.handover.ledger import Ledger, Waiting
from station.handover.targets import make_target

_POLL_S = 0.2
_RESULTS = 100_000


class HandOver:
    """Every target by itself: one that is slow or gone holds nobody else up."""

    def __init__(self, config: BoothConfig, log: logging.Logger) -> None:
        self._config, self._log = config, log
        self._spool = Spool(config.spool.folder)
        self._ledger = Ledger(config.spool.folder)
        self._index = ScanIndex(self._spool)
        self._targets = {section.name: make_target(section) for section in config.deliver}

    def run(self, stop: threading.Event) -> None:
        """Until told to stop."""
        threads = [
            threading.Thread(target=self._serve, args=(name, stop), daemon=True)
            for name in self._targets
        ]
        for thread in threads:
            thread.start()
        notify("READY=1")
        changed_ns = -1
        while not stop.wait(_POLL_S):
            notify("WATCHDOG=1")
            now_ns = (self._spool.folder / "outbox").stat().st_mtime_ns
            if now_ns == changed_ns and time.time_ns() - now_ns > 1_000_000_000:
                continue
            changed_ns = now_ns
            self.look()

    def look(self) -> None:
        """Note what is new in the outbox."""
        found = self._index.find(states=["delivered", "rescan"], limit=_RESULTS)
        for section in self._config.deliver:
            wanted = [s.scan_id for s in found if s.state == "delivered" or section.rescans]
            self._ledger.follow(section.name, wanted)

    def _serve(self, name: str, stop: threading.Event) -> None:
        while not stop.wait(_POLL_S):
            try:
                self.try_all(name, time.time())
            except (BoothError, OSError) as error:
                self._log.warning("%s: %s", name, error)

    def try_all(self, name: str, now_s: float) -> None:
        """Hand over what is due to one target."""
        for entry in self._ledger.waiting():
            if entry.target == name and entry.next_s <= now_s:
                self._try(entry, now_s)

    def _try(self, entry: Waiting, now_s: float) -> None:
        scan: ScanRecord | None = self._index.get(entry.scan_id)
        if scan is None:
            return
        try:
            self._targets[entry.target](scan, self._spool.path("outbox", entry.scan_id))
        except BoothError as error:
            after = entry.failed(str(error), now_s)
            self._ledger.keep(after)
            self._log.warning(
                "%s not handed over to %s (%s); again in %.0f s",
                entry.scan_id, entry.target, error, after.next_s - now_s,
            )  # fmt: skip
            return
        self._ledger.finish(entry)
        self._log.info("%s handed over to %s", entry.scan_id, entry.target)


@click.command()
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="booth.toml")
def deliver(config_path: Path | None) -> None:
    """Hand results over to the programs of [[deliver]]; `station run` starts it.

    \b
    Examples:
      station deliver --config booth.toml
    """
    config = load_config(find_config(config_path))
    if not config.deliver:
        raise BoothError("booth.toml has no [[deliver]]: there is nobody to hand results over to")
    HandOver(config, set_up_logs("deliver")).run(stop_event())
