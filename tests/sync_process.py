"""The process that matches frames, in the process of a test."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from station.booth.sync import SyncProcess
from station.core.config import BoothConfig


@contextmanager
def sync_of(config: BoothConfig) -> Iterator[SyncProcess]:
    """A booth's sync process, whose parts a test calls one by one."""
    sync = SyncProcess(config, logging.getLogger("sync"))
    try:
        yield sync
    finally:
        sync._writer.close()
        sync._context.destroy(linger=0)
