"""One station with a console for all tests of this folder, which ends with the last of them; and
a spool without a station."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from console_page import browser, log_in, tablet
from live_console import LiveConsole
from playwright.sync_api import Page

from station.core.files import write_json
from station.core.scans import REASON
from station.core.spool import Spool


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
def fresh() -> Iterator[Page]:
    """An empty page of a tablet that nobody is logged in at."""
    with browser() as started:
        yield tablet(started).new_page()


@pytest.fixture
def page(fresh: Page, console: LiveConsole) -> Page:
    """The console's page after the log-in."""
    log_in(fresh, console)
    return fresh


@pytest.fixture
def in_shanghai(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The machine's clock is set to the time of Shanghai, UTC+8."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Asia/Shanghai")
        time.tzset()
        yield
    time.tzset()


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    """Spool of four scans: one waits, one has failed, two are delivered."""
    spool = Spool(tmp_path / "spool")
    for number, (place, label) in enumerate(
        [
            ("queue", "Order 7"),
            ("outbox", "Order 1234"),
            ("failed", "ÅNGSTRÖM"),
            ("outbox", "訂單 9"),
        ]
    ):
        folder = spool.path(place, f"2026112{number}T100000Z-000{number}")
        folder.mkdir()
        document: dict[str, object] = {
            "label": label,
            "created": f"2026-11-2{number}T10:00:00Z",
            "booth": "b",
        }
        if place == "outbox":
            document |= {"status": "ok" if number == 1 else "rescan", "reasons": ["arm"]}
            write_json(folder / "result.json", document)
        else:
            write_json(folder / "bundle.json", document)
        if place == "failed":
            write_json(folder / REASON, {"reason": "nobody there"})
    return spool


@pytest.fixture
def option(spool: Spool) -> list[str]:
    """Option that names the configuration of a booth with this spool."""
    config = spool.folder.parent / "booth.toml"
    config.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    return ["--config", str(config)]
