"""The page in Debian's chromium, in short: an operator logs in, looks, scans and reads the result.

page_in_browser.py has every other view and what goes wrong; `make test-console` runs it.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
from typing import Any

import pytest
from console_page import (
    LONG_MS,
    browser,
    four_pictures_move,
    give_up_a_scan,
    log_in,
    open_view,
    tablet,
)
from live_console import LiveConsole
from playwright.sync_api import Page, Route, expect

from station.calibration.guide.session import Session
from station.calibration.guide.store import UNFINISHED
from station.core.rig import Rig
from station.handover.ledger import Ledger, Waiting

pytestmark = pytest.mark.usefixtures("sensors")

_NOTE_WORDS = """() => {
  window.told = [];
  new MutationObserver(() => {
    const word = document.querySelector('#stage .word');
    if (word && word.textContent !== window.told.at(-1)) window.told.push(word.textContent);
  }).observe(document.getElementById('stage'),
    {childList: true, subtree: true, characterData: true});
}"""
"""Keeps what the scan's ring says, one after the other."""
_IN_ORDER = ["Hold still", "Storing", "In the queue", "Measuring the body"]
"""It went back to "Hold still" after the pictures were taken, and to "In the queue" where the
body was measured already."""


def test_an_operator_looks_scans_and_reads_the_result(console: LiveConsole) -> None:
    errors: list[str] = []
    with browser() as started:
        page = tablet(started).new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        log_in(page, console)
        four_pictures_move(page, console)
        open_view(page, console, "scan")
        page.fill("#label", "Order 5")
        page.evaluate(_NOTE_WORDS)
        page.click("#go")
        expect(page.locator("#stage .word")).to_have_text(_IN_ORDER[-1], timeout=5 * LONG_MS)
        # A job that dies is done again, of which the operator needs to know nothing.
        for pid in console.station.pids("workers.reconstruct.job_process"):
            os.kill(pid, signal.SIGKILL)
        verdict = page.locator("#verdict")
        expect(verdict).to_be_visible(timeout=5 * LONG_MS)
        told = [word for word in page.evaluate("window.told") if word in _IN_ORDER]
        assert told == [word for word in _IN_ORDER if word in told], told
        assert verdict.get_attribute("data-verdict") in ("ok", "rescan"), verdict.inner_text()
        page.click("#open")
        expect(page.locator("h1")).to_have_text("Order 5", timeout=LONG_MS)
        expect(page.locator("canvas[data-ready=yes]")).to_be_visible(timeout=LONG_MS)
        page.click("tr[data-name=waist_girth]")
        expect(page.locator("#line-name")).to_contain_text("Waist girth")
    assert errors == []


def test_a_scan_that_waits_for_the_compiler_says_so(console: LiveConsole) -> None:
    """The first one took a minute longer than any other, and nobody knew why."""

    def first(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "compiling": True})

    with browser() as started:
        page = tablet(started).new_page()
        page.route("**/api/v1/booth", first)
        log_in(page, console)
        open_view(page, console, "scan")
        compiled = page.locator("#stage").get_by_text("being compiled, once on this computer")
        page.click("#go")
        expect(compiled).to_be_visible(timeout=5 * LONG_MS)
        expect(page.locator("#stage .word")).to_have_text("Measuring the body")
        expect(page.locator("#verdict")).to_be_visible(timeout=5 * LONG_MS)
        expect(compiled).to_have_count(0)


def test_a_person_whose_scan_is_cancelled_is_not_asked_for_another(console: LiveConsole) -> None:
    """The screen in the booth said to stand on the mark again."""
    with browser() as started, console.client("scan") as client:
        page = tablet(started).new_page()
        log_in(page, console)
        page.goto(f"{console.url}/person")
        screen = page.locator("body")
        expect(screen).to_have_attribute("data-screen", "guide", timeout=LONG_MS)
        scan = client.post("/scans", json={"label": "gone", "countdown_s": 20}).json()
        expect(screen).to_have_attribute("data-screen", "countdown", timeout=LONG_MS)
        client.post(f"/scans/{scan['scan_id']}/cancel").raise_for_status()
        expect(screen).not_to_have_attribute("data-screen", "countdown", timeout=LONG_MS)
        expect(screen).to_have_attribute("data-screen", "guide")


def test_a_countdown_that_ended_with_its_console_is_told(console: LiveConsole) -> None:
    """The page and the person's screen said "Get ready" until somebody gave the scan up."""

    def longer(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "countdown_s": 30})

    with browser() as started:
        context = tablet(started)
        page = context.new_page()
        page.route("**/api/v1/session", longer)
        log_in(page, console)
        person = context.new_page()
        person.goto(f"{console.url}/person")
        expect(person.locator("svg")).to_be_visible(timeout=LONG_MS)
        open_view(page, console, "scan")
        page.click("#go", timeout=LONG_MS)
        expect(person.locator("body")).to_have_attribute(
            "data-screen", "countdown", timeout=LONG_MS
        )
        for pid in console.station.pids("console"):
            os.kill(pid, signal.SIGKILL)
        verdict = page.locator("#verdict")
        expect(verdict).to_contain_text("The console was restarted before", timeout=LONG_MS)
        expect(page.locator("#again")).to_be_enabled(timeout=LONG_MS)
        expect(person.locator("body")).to_have_attribute("data-screen", "guide", timeout=LONG_MS)
    console.station.wait_until(console.answers, "the console answers")


def test_a_view_that_is_slow_says_so(console: LiveConsole) -> None:
    """The one before it stood there for seconds, with buttons that did nothing."""
    held: list[Route] = []
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        expect(page.locator("h1")).to_have_text("Scan", timeout=LONG_MS)
        page.route("**/api/v1/calibrations", lambda route: held.append(route), times=1)
        open_view(page, console, "calibration")
        expect(page.locator("main [role=status]")).to_have_text("One moment …", timeout=LONG_MS)
        held[0].continue_()
        expect(page.locator("h1")).to_have_text("Calibration", timeout=LONG_MS)


def test_a_narrow_screen_cuts_nothing_off(
    console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    """Names of downloads were outside a telephone's screen, and so were dates and verdicts."""
    with browser() as started:
        page = tablet(started).new_page()
        page.set_viewport_size({"width": 390, "height": 780})
        log_in(page, console)
        open_view(page, console, "booth")
        _inside(page, ".camera .chip", ".camera")
        open_view(page, console, "history")
        _inside(page, "[data-scan] .chip, [data-scan] .danger", ".history")
        open_view(page, console, "scan")
        give_up_a_scan(page)
        _inside(page, "#verdict h2", "#stage")
        open_view(page, console, f"result/{scans[0]['scan_id']}")
        page.click("#download", timeout=LONG_MS)
        _inside(page, "#downloads a", "#main")
        page.keyboard.press("Escape")
        expect(page.locator("#downloads")).to_be_hidden()
        expect(page.locator("#download")).to_be_focused()


def _inside(page: Page, parts: str, whole: str) -> None:
    """No part is beyond the left or right of the whole that it is in."""
    expect(page.locator(parts).first).to_be_visible(timeout=LONG_MS)
    beyond = page.locator(parts).evaluate_all(
        """(parts, whole) => parts.filter((part) => {
          const [own, all] = [part, part.closest(whole)].map((one) => one.getBoundingClientRect());
          return own.left < all.left || own.right > all.right;
        }).map((part) => part.textContent)""",
        whole,
    )
    assert beyond == []


def test_a_command_in_a_message_is_named_as_its_button(console: LiveConsole) -> None:
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        open_view(page, console, "calibration")
        page.click("button[data-step=solve]")
        expect(page.locator("#task-error")).to_have_text(
            "no calibration has been started; “All remaining steps” goes through all steps",
            timeout=LONG_MS,
        )


def test_a_booth_that_takes_no_scans_says_so(console: LiveConsole) -> None:
    """It looked healthy, and every scan was refused."""
    calibration = console.config.calibration
    away = calibration.with_suffix(".away")
    with browser() as started, console.client("read") as client:
        page = tablet(started).new_page()
        log_in(page, console)
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


def test_copies_that_stay_are_told_before_a_scan_is_deleted(
    console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    """The page said that it was deleted, and programs that it was handed over to had it still."""
    scan_id = scans[0]["scan_id"]
    ledger = Ledger(console.config.spool.folder)
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        open_view(page, console, "history")
        erase = page.locator(f"[data-scan='{scan_id}'] .danger")
        dialog = page.get_by_role("dialog")
        try:
            for receivers in ([], ["orders", "share"]):
                for name in receivers:
                    ledger.finish(Waiting(name, scan_id))
                erase.click()
                copies = expect(dialog.get_by_text("Copies handed over to orders, share stay"))
                copies.to_have_count(1 if receivers else 0, timeout=LONG_MS)
                dialog.get_by_role("button", name="Cancel").click()
        finally:
            ledger.forget(scan_id)
        # Handed over while the question was open: the answer to the deletion names them.
        deleted = {"scans": [scan_id], "handed_over": ["orders"]}
        erase.click()
        expect(dialog).to_be_visible(timeout=LONG_MS)
        page.route(f"**/scans/{scan_id}", lambda route: route.fulfill(json=deleted))
        page.click("#affirm")
        expect(page.locator(".notice")).to_contain_text("Copies handed over to orders stay there")


def test_a_table_that_does_not_come_moves_no_switch(
    console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    """Centimetres stood under "in", and the lines of one pose beside the numbers of another."""
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        open_view(page, console, f"result/{scans[0]['scan_id']}")
        inches = page.get_by_role("button", name="in", exact=True)
        standard = page.get_by_role("button", name="Standard pose")
        waist = page.locator("tr[data-name=waist_girth] b")
        expect(inches).to_have_attribute("aria-pressed", "false", timeout=LONG_MS)
        before = waist.inner_text()
        page.route("**/measurements?*", lambda route: route.abort())
        for switch in (inches, standard):
            switch.click()
            notice = page.locator(".notice.bad").first
            expect(notice).to_be_visible(timeout=LONG_MS)
            notice.evaluate("shown => shown.remove()")
            expect(switch).to_have_attribute("aria-pressed", "false")
        expect(waist).to_have_text(before)
        assert page.evaluate("localStorage.length") == 0
        page.unroute("**/measurements?*")
        # The answer to the first tap comes after the second tap's.
        held: list[Route] = []
        page.route("**/measurements?*unit=in*", lambda route: held.append(route), times=1)
        inches.click()
        standard.click()
        expect(standard).to_have_attribute("aria-pressed", "true", timeout=LONG_MS)
        expect(inches).to_have_attribute("aria-pressed", "true")
        with page.expect_response("**/measurements?*pose=as-scanned*unit=in*"):
            held[0].continue_()
        expect(standard).to_have_attribute("aria-pressed", "true")
        page.get_by_role("button", name="As scanned").click()
        expect(standard).to_have_attribute("aria-pressed", "false", timeout=LONG_MS)
        assert float(waist.inner_text()) == pytest.approx(float(before) / 2.54, abs=0.03)


def test_another_language_says_the_same(console: LiveConsole) -> None:
    """The outcome of a scan was gone."""
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        open_view(page, console, "scan")
        give_up_a_scan(page)
        ended = page.locator("#verdict h2")
        expect(ended).to_have_text("The scan was cancelled", timeout=LONG_MS)
        page.select_option("#language", "zh")
        expect(ended).to_have_text("扫描已取消", timeout=LONG_MS)
        expect(page.locator("html")).to_have_attribute("lang", "zh-CN")
        # The second time before the first one is drawn.
        for language in ("en", "zh", "en"):
            page.select_option("#language", language)
        expect(ended).to_have_text("The scan was cancelled", timeout=LONG_MS)
        open_view(page, console, "history")
        expect(page.locator("#search")).to_be_visible(timeout=LONG_MS)
        # What was left is not taken up again.
        for language, words in (("zh", "记录"), ("en", "History")):
            page.select_option("#language", language)
            expect(page.locator("h1")).to_have_text(words, timeout=LONG_MS)
        open_view(page, console, "scan")
        expect(page.locator("#label")).to_be_visible(timeout=LONG_MS)


def test_a_language_that_does_not_come_is_told(console: LiveConsole) -> None:
    """The list said 中文, and nothing else happened."""
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        open_view(page, console, "history")
        expect(page.locator("h1")).to_have_text("History", timeout=LONG_MS)
        page.route("**/phrases.json", lambda route: route.abort())
        page.select_option("#language", "zh")
        expect(page.locator(".notice.bad")).to_contain_text("cannot be reached", timeout=LONG_MS)
        assert page.locator("#language").input_value() == "en"
        assert page.evaluate("localStorage.getItem('booth.language')") == "en"
        expect(page.locator("h1")).to_have_text("History")
        page.unroute("**/phrases.json")
        page.select_option("#language", "zh")
        expect(page.locator("h1")).to_have_text("记录", timeout=LONG_MS)


def test_a_log_out_that_does_not_arrive_is_told(console: LiveConsole) -> None:
    """The page was loaded anew, and whoever had logged out was logged in."""
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        page.route("**/session", lambda route: route.abort())
        page.click("#logout")
        expect(page.locator(".notice.bad")).to_contain_text("cannot be reached", timeout=LONG_MS)
        page.unroute("**/session")
        page.click("#logout")
        expect(page.locator("#password")).to_be_visible(timeout=LONG_MS)


def test_nobody_is_said_to_be_absent_whom_no_camera_sees(console: LiveConsole) -> None:
    with browser() as started, console.client() as client:
        page = tablet(started).new_page()
        log_in(page, console)
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


def test_a_check_is_told_while_it_runs(console: LiveConsole) -> None:
    """The next frameset put the last result in its place."""
    with browser() as started:
        page = tablet(started).new_page()
        log_in(page, console)
        open_view(page, console, "booth")
        told = page.locator("section:has(#check) p").first
        words = set()
        with page.expect_response("**/booth/check"):
            page.click("#check")
        with console.client("read") as client:
            while client.get("/task").json()["running"]:
                word = told.inner_text()
                # It may have ended before the page was looked at.
                if client.get("/task").json()["running"]:
                    words.add(word)
                time.sleep(0.2)
        expect(page.locator("#check")).to_be_enabled(timeout=LONG_MS)
        expect(told).not_to_have_text("Checking …")
    assert words == {"Checking …"}


def test_a_calibration_that_was_begun_is_shown_and_not_lost_by_a_touch(
    console: LiveConsole,
) -> None:
    unfinished = console.config.calibrate.folder / UNFINISHED
    with browser() as started, console.client() as client:
        page = tablet(started).new_page()
        log_in(page, console)
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
