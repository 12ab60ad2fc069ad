"""Removal of old scans by a process of its own, beside control."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from station.booth.retention import Tidying
from station.core.spool import Spool


def test_a_removal_that_fails_is_told_and_begun_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tidying = Tidying(Spool(tmp_path / "spool"), tmp_path / "no.toml", logging.getLogger())
    for count, now_s in ((1, 1000.0), (2, 1601.0)):
        tidying.look(now_s)
        purge = tidying._purge
        assert purge is not None
        assert purge.wait(60.0) == 1
        tidying.look(now_s + 599.0)
        assert caplog.text.count("could not be removed: the purge ended with 1") == count
