"""The page's views of the booth and its calibration."""

from __future__ import annotations

import os
import shutil
import signal
import time

import numpy as np
import pytest
from console_page import LONG_MS, open_view
from live_console import LiveConsole
from playwright.sync_api import Page, Route, expect

from station.calibration.drift.last_check import keep_check
from station.calibration.guide.session import Session
from station.calibration.guide.store import UNFINISHED
from station.calibration.moves.motion import CameraMove
from station.core.rig import Rig

pytestmark = pytest.mark.usefixtures("sensors")


def test_a_command_in_a_message_is_named_as_its_button(page: Page, console: LiveConsole) -> None:
    open_view(page, console, "calibration")
    page.click("button[data-step=solve]")
    expect(page.locator("#task-error")).to_have_text(
        "no calibration has been started; “All remaining steps” goes through all steps",
        timeout=LONG_MS,
    )


def test_a_calibration_from_elsewhere_is_told(page: Page, console: LiveConsole) -> None:
    """The page said that no calibration was stored yet, while scans were taken with one."""
    open_view(page, console, "calibration")
    told = page.get_by_text("came from elsewhere")
    expect(told).to_be_visible(timeout=LONG_MS)
    expect(told).to_contain_text("2026")
    expect(page.get_by_text("No calibration is stored yet.")).to_have_count(0)


def test_a_booth_that_takes_no_scans_says_so(page: Page, console: LiveConsole) -> None:
    """It looked healthy, and every scan was refused."""
    calibration = console.config.calibration
    away = calibration.with_suffix(".away")
    with console.client("read") as client:
        open_view(page, console, "scan")
        troubles = page.locator("#troubles")
        expect(page.locator("#go")).to_be_enabled(timeout=LONG_MS)
        calibration.rename(away)
        try:
            expect(troubles).to_contain_text("is not calibrated", timeout=LONG_MS)
            expect(page.locator("#go")).to_be_disabled(timeout=LONG_MS)
            told = client.get("/booth").json()
            assert not told["can_scan"]
            assert any("is not calibrated" in problem for problem in told["problems"])
            open_view(page, console, "booth")
            expect(troubles).to_contain_text("is not calibrated", timeout=LONG_MS)
            page.evaluate("localStorage.setItem('booth.language', 'zh')")
            page.reload()
            expect(troubles).to_contain_text("扫描室尚未校准，不能扫描", timeout=LONG_MS)
        finally:
            away.rename(calibration)
        expect(troubles).not_to_contain_text("扫描室尚未校准", timeout=LONG_MS)
        open_view(page, console, "scan")
        expect(page.locator("#go")).to_be_enabled(timeout=LONG_MS)


def test_nobody_is_said_to_be_absent_whom_no_camera_sees(page: Page, console: LiveConsole) -> None:
    with console.client() as client:
        open_view(page, console, "scan")
        presence = page.locator("main [role=status]")
        expect(presence).to_have_text("Somebody is in the booth", timeout=LONG_MS)
        fronts = [console.station.pids("capture", f"front-{end}")[0] for end in ("lower", "upper")]
        for pid in fronts:
            os.kill(pid, signal.SIGSTOP)
        unseen = "The cameras cannot see whether somebody is in the booth."
        expect(presence).to_have_text(unseen, timeout=LONG_MS)
        # What hangs is killed and started again.
        expect(presence).to_have_text("Somebody is in the booth", timeout=LONG_MS)
        client.post("/booth/stop").raise_for_status()
        try:
            expect(presence).to_have_text("The sensors are off.", timeout=LONG_MS)
        finally:
            console.start_sensors()


def test_what_waits_to_be_handed_over_can_be_tried_at_once(
    page: Page, console: LiveConsole
) -> None:
    waits = {"target": "share", "scan_id": "20260101T000000Z-dead", "tries": 6, "next_try": "",
             "error": "/mnt/x does not exist; is the share mounted?"}  # fmt: skip

    def waiting(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "waiting_deliveries": [waits]})

    page.route("**/api/v1/booth", waiting)
    open_view(page, console, "booth")
    with page.expect_response("**/booth/hand-over", timeout=LONG_MS) as answer:
        page.click("#try-now", timeout=LONG_MS)
    assert answer.value.status == 200


def test_a_check_is_told_while_it_runs(page: Page, console: LiveConsole) -> None:
    """The next frameset put the last result in its place."""
    open_view(page, console, "booth")
    told = page.locator("section:has(#check) p").first
    words = set()
    with page.expect_response("**/booth/check"):
        page.click("#check")
    with console.client("read") as client:
        deadline_s = time.monotonic() + 1e-3 * LONG_MS
        while client.get("/task").json()["running"]:
            assert time.monotonic() < deadline_s
            word = told.inner_text()
            # It may have ended before the page was looked at.
            if client.get("/task").json()["running"]:
                words.add(word)
            time.sleep(0.2)
    expect(page.locator("#check")).to_be_enabled(timeout=LONG_MS)
    expect(told).not_to_have_text("Checking …")
    assert words == {"Checking …"}


def test_a_calibration_that_was_begun_is_shown_and_not_lost_by_a_touch(
    page: Page, console: LiveConsole
) -> None:
    unfinished = console.config.calibrate.folder / UNFINISHED
    with console.client() as client:
        assert client.get("/calibration").json() == {"started": "", "done": []}
        cameras = Rig.load(console.config.calibration).cameras
        try:
            Session.begin(unfinished, "2026-11-21T10:00:00Z", 0.1, cameras).record_empty({}, [])
            open_view(page, console, "calibration")
            expect(page.locator("[data-done=floor]")).to_be_visible(timeout=LONG_MS)
            expect(page.locator("[data-done=ball]")).to_be_hidden()
            page.click("#anew")
            dialog = page.get_by_role("dialog")
            expect(dialog).to_contain_text("Put aside the calibration", timeout=LONG_MS)
            dialog.get_by_role("button", name="Cancel").click()
            assert client.get("/calibration").json()["done"] == ["floor"]
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)


def test_a_check_says_how_a_camera_moved(page: Page, console: LiveConsole) -> None:
    """A camera with a coat before it was told as moved, and of no move it was said how far."""
    sure, pushed = 1e-8 * np.eye(6), np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0])
    keep_check(
        console.config.console.folder,
        [CameraMove("a", pushed, sure, 1.0), CameraMove("b", np.zeros(6), sure, 0.05)],
    )
    open_view(page, console, "booth")
    told = page.locator("section", has=page.locator("#check"))
    expect(told).to_contain_text("20 mm (mostly to the right)", timeout=LONG_MS)
    expect(told).to_contain_text("something stands in its way")
    page.select_option("#language", "zh")
    expect(told).to_contain_text("约 20 毫米（主要向右）", timeout=LONG_MS)
    expect(told).to_contain_text("有东西挡住了它")
