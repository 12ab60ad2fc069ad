"""Common matters of all views of the page: waiting, narrow screens, both languages, the log-out."""

from __future__ import annotations

from typing import Any

import pytest
from console_page import LONG_MS, give_up_a_scan, open_view
from live_console import LiveConsole
from playwright.sync_api import Page, Route, expect

pytestmark = pytest.mark.usefixtures("sensors")


def test_a_view_that_is_slow_says_so(page: Page, console: LiveConsole) -> None:
    """The one before it stood there for seconds, with buttons that did nothing."""
    held: list[Route] = []
    expect(page.locator("h1")).to_have_text("Scan", timeout=LONG_MS)
    page.route("**/api/v1/calibrations", lambda route: held.append(route), times=1)
    open_view(page, console, "calibration")
    expect(page.locator("main [role=status]")).to_have_text("One moment …", timeout=LONG_MS)
    held[0].continue_()
    expect(page.locator("h1")).to_have_text("Calibration", timeout=LONG_MS)


def test_a_narrow_screen_cuts_nothing_off(
    page: Page, console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    """Names of downloads were outside a telephone's screen, and so were dates and verdicts,
    intervals, and how much two scans differ. What a step of the calibration says was above it."""
    page.set_viewport_size({"width": 390, "height": 780})
    open_view(page, console, "booth")
    _inside(page, ".camera .chip", ".camera")
    open_view(page, console, "calibration")
    page.click("[data-step=solve]", timeout=LONG_MS)
    expect(page.locator("#now h2")).to_be_in_viewport(timeout=LONG_MS)
    open_view(page, console, "history")
    _inside(page, "[data-scan] .chip, [data-scan] .danger", ".history")
    open_view(page, console, "scan")
    give_up_a_scan(page)
    _inside(page, "#verdict h2", "#stage")
    compared = "/".join(scan["scan_id"] for scan in scans)
    open_view(page, console, f"compare/{compared}")
    _inside(page, "#compared td", ".table-scroll")
    page.locator("#main").evaluate("main => main.scrollTo(0, 9999)")
    open_view(page, console, f"result/{scans[0]['scan_id']}")
    _inside(page, "#rows td", ".table-scroll")
    assert page.locator("#main").evaluate("main => main.scrollTop") == 0
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


def test_another_language_says_the_same(page: Page, console: LiveConsole) -> None:
    """The outcome of a scan was gone."""
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


def test_a_language_that_does_not_come_is_told(page: Page, console: LiveConsole) -> None:
    """The list said 中文, and nothing else happened."""
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


def test_a_log_out_that_does_not_arrive_is_told(page: Page) -> None:
    """The page was loaded anew, and whoever had logged out was logged in."""
    page.route("**/session", lambda route: route.abort())
    page.click("#logout")
    expect(page.locator(".notice.bad")).to_contain_text("cannot be reached", timeout=LONG_MS)
    page.unroute("**/session")
    page.click("#logout")
    expect(page.locator("#password")).to_be_visible(timeout=LONG_MS)


def test_who_skips_the_rail_stays_in_the_view(page: Page, console: LiveConsole) -> None:
    """The link led to the view of scans, from every other one."""
    open_view(page, console, "history")
    expect(page.locator("#search")).to_be_visible(timeout=LONG_MS)
    page.focus("#skip")
    page.keyboard.press("Enter")
    expect(page.locator("#main")).to_be_focused()
    page.keyboard.press("Tab")
    expect(page.locator("#search")).to_be_focused()
    assert page.url.endswith("#/history")
