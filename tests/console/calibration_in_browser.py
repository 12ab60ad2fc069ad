"""A whole calibration through the page, from recordings of the procedure; `make test-console`."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from console_page import LONG_MS, browser, log_in, open_view, tablet
from live_console import LiveConsole
from playwright.sync_api import expect
from running_station import STATION

from station.core.geometry import invert
from station.core.rig import Rig
from station.simulation.record_cli import PROCEDURE, TRUTH

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"
_FARTHEST_M = 0.01
"""From a camera to its true place, after a short waving; accuracy is the benchmark's subject."""


@pytest.fixture(scope="module")
def uncalibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A booth whose cameras nobody has told the station of, and the procedure's recordings."""
    folder = tmp_path_factory.mktemp("uncalibrated")
    options = ("--body", str(BODY), "--out", str(folder), "--frames", "1", "--driver", "recorded")
    command = [*STATION, "record-virtual", *options, "--calibration", "16"]
    subprocess.run(command, check=True, capture_output=True)
    return folder


def test_a_calibration_through_the_page(uncalibrated: Path, tmp_path: Path) -> None:
    console = LiveConsole(uncalibrated, tmp_path, uncalibrated / PROCEDURE)
    try:
        with browser() as started:
            page = tablet(started).new_page()
            log_in(page, console)
            open_view(page, console, "calibration")
            page.click("#calibrate")
            expect(page.locator("#halt")).to_be_visible(timeout=LONG_MS)
            used = page.locator("[data-calibration] .chip.good")
            expect(used).to_be_visible(timeout=10 * LONG_MS)
            expect(page.locator("#task-error")).to_have_count(0)
            open_view(page, console, "booth")
            expect(page.get_by_text("none", exact=True)).to_have_count(0)
    finally:
        console.close()
    found, truth = Rig.load(uncalibrated / "calibration.json"), Rig.load(uncalibrated / TRUTH)
    for name in truth.cameras:
        ours, true = (
            invert(rig.cameras[truth.reference].world_from_camera)
            @ rig.cameras[name].world_from_camera
            for rig in (found, truth)
        )
        assert np.linalg.norm((invert(true) @ ours)[:3, 3]) < _FARTHEST_M, name
