"""One station with a console for all tests of this folder; it ends with the last of them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from live_console import LiveConsole


@pytest.fixture(scope="package")
def console(booth: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A station with a console, running, sensors off."""
    live = LiveConsole(booth, tmp_path_factory.mktemp("console"))
    yield live
    live.close()


@pytest.fixture(scope="module")
def sensors(console: LiveConsole) -> Iterator[None]:
    """The console's sensors run."""
    with console.sensors():
        yield


@pytest.fixture(scope="package")
def scans(console: LiveConsole) -> list[dict[str, Any]]:
    """Two delivered scans of the console's station."""
    with console.sensors():
        found = [console.scan("Order 1234"), console.scan("<script>alert(1)</script>")]
    assert all(scan["state"] in ("delivered", "rescan") for scan in found), found
    return found


@pytest.fixture
def in_shanghai(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The machine's clock is set to the time of Shanghai, UTC+8."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Asia/Shanghai")
        time.tzset()
        yield
    time.tzset()
