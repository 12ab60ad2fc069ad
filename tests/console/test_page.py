"""The page in Debian's chromium, in short: an operator logs in, looks, scans and reads the result.

page_in_browser.py has every other view and what goes wrong; `make test-console` runs it.
"""

from __future__ import annotations

import os
import re
import signal

import pytest
from console_page import (
    LONG_MS,
    events_by_hand,
    four_pictures_move,
    log_in,
    open_view,
    tell,
    wait_for_value,
)
from live_console import LiveConsole
from playwright.sync_api import Page, Route, expect

pytestmark = pytest.mark.usefixtures("sensors")

_NOTE_WORDS = """(of) => {
  window.told = [];
  new MutationObserver(() => {
    for (const found of document.querySelectorAll(`#stage ${of}`)) {
      if (found.textContent !== window.told.at(-1)) window.told.push(found.textContent);
    }
  }).observe(document.getElementById('stage'),
    {attributes: true, childList: true, subtree: true, characterData: true});
}"""
"""Keeps what the card of a scan says, one after the other: it may say so for a moment only."""
_IN_ORDER = ["Hold still", "Storing", "In the queue", "Measuring the body"]
"""It went back to "Hold still" after the pictures were taken, and to "In the queue" where the
body was measured already."""


def _count_longer(route: Route) -> None:
    route.fulfill(json={**route.fetch().json(), "countdown_s": 30})


def test_an_operator_looks_scans_and_reads_the_result(fresh: Page, console: LiveConsole) -> None:
    errors: list[str] = []
    fresh.on("pageerror", lambda error: errors.append(str(error)))
    log_in(fresh, console)
    four_pictures_move(fresh, console)
    open_view(fresh, console, "scan")
    fresh.fill("#label", "Order 5")
    fresh.evaluate(_NOTE_WORDS, ".word")
    fresh.click("#go")
    wait_for_value(fresh, f"window.told.includes('{_IN_ORDER[-1]}')")
    # A job that dies is done again, of which the operator needs to know nothing.
    for pid in console.station.pids("workers.reconstruct.job_process"):
        os.kill(pid, signal.SIGKILL)
    verdict = fresh.locator("#verdict")
    expect(verdict).to_be_visible(timeout=5 * LONG_MS)
    told = [word for word in fresh.evaluate("window.told") if word in _IN_ORDER]
    assert told == [word for word in _IN_ORDER if word in told], told
    assert verdict.get_attribute("data-verdict") in ("ok", "rescan"), verdict.inner_text()
    fresh.click("#open")
    expect(fresh.locator("h1")).to_have_text("Order 5", timeout=LONG_MS)
    expect(fresh.locator("canvas[data-ready=yes]")).to_be_visible(timeout=LONG_MS)
    fresh.click("tr[data-name=waist_girth]")
    expect(fresh.locator("#line-name")).to_contain_text("Waist girth")
    assert errors == []


def test_a_scan_that_waits_for_the_compiler_says_so(fresh: Page, console: LiveConsole) -> None:
    """The first one took a minute longer than any other, and nobody knew why."""

    def first(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "compiling": True})

    fresh.route("**/api/v1/booth", first)
    log_in(fresh, console)
    open_view(fresh, console, "scan")
    expect(fresh.locator("#go")).to_be_enabled(timeout=LONG_MS)
    fresh.evaluate(_NOTE_WORDS, "p:not([hidden])")
    fresh.click("#go")
    expect(fresh.locator("#verdict")).to_be_visible(timeout=5 * LONG_MS)
    told = fresh.evaluate("window.told")
    assert any("being compiled, once on this computer" in words for words in told), told
    expect(fresh.locator("#stage")).not_to_contain_text("being compiled")


def test_a_scan_is_followed_though_its_view_was_left(fresh: Page, console: LiveConsole) -> None:
    """The view that was opened again asked whose scan to take, while it was taken."""
    held: list[Route] = []
    fresh.route("**/api/v1/scans", lambda route: held.append(route), times=1)
    fresh.route("**/api/v1/session", _count_longer)
    log_in(fresh, console)
    open_view(fresh, console, "scan")
    fresh.fill("#label", "left")
    fresh.click("#go", timeout=LONG_MS)
    for asks in (True, False):
        open_view(fresh, console, "history")
        expect(fresh.locator("#search")).to_be_visible(timeout=LONG_MS)
        open_view(fresh, console, "scan")
        if asks:
            # The booth has not answered yet: a second press would be refused.
            expect(fresh.locator("#go")).to_be_disabled(timeout=LONG_MS)
            held[0].continue_()
        expect(fresh.locator("#stage h2")).to_have_text("left", timeout=LONG_MS)
    fresh.click("#give-up")
    expect(fresh.locator("#verdict h2")).to_have_text("The scan was cancelled", timeout=LONG_MS)


def test_a_scan_is_followed_by_a_page_that_is_loaded_anew(
    fresh: Page, console: LiveConsole
) -> None:
    """The page asked whose scan to take, and no button ended the countdown."""
    fresh.route("**/api/v1/session", _count_longer)
    log_in(fresh, console)
    open_view(fresh, console, "scan")
    fresh.fill("#label", "anew")
    fresh.click("#go", timeout=LONG_MS)
    expect(fresh.locator("#stage h2")).to_have_text("anew", timeout=LONG_MS)
    # A station that does not answer just then is asked again.
    late = {"type": "/problems/station-not-running", "detail": "the station does not answer"}
    fresh.route("**/scans/*", lambda route: route.fulfill(status=503, json=late), times=1)
    fresh.reload()
    expect(fresh.locator("#label")).to_be_visible(timeout=LONG_MS)
    fresh.reload()
    expect(fresh.locator("#stage h2")).to_have_text("anew", timeout=LONG_MS)
    expect(fresh.locator(".ring .number")).to_have_text(re.compile(r"\d"), timeout=LONG_MS)
    # Another window of the browser is another operator's.
    other = fresh.context.new_page()
    open_view(other, console, "scan")
    expect(other.locator("#label")).to_be_visible(timeout=LONG_MS)
    other.close()
    fresh.click("#give-up")
    expect(fresh.locator("#verdict h2")).to_have_text("The scan was cancelled", timeout=LONG_MS)
    fresh.reload()
    expect(fresh.locator("#label")).to_be_visible(timeout=LONG_MS)


def test_a_scan_that_was_deleted_while_its_view_was_left_is_not_followed(
    fresh: Page, console: LiveConsole
) -> None:
    """The view told of a scan that was being taken until the page was loaded anew."""
    gone = {"scan_id": "20260101T000000Z-dead", "label": "gone", "state": "capturing",
            "reasons": [], "framesets": 1, "wanted": 10}  # fmt: skip
    fresh.route("**/api/v1/scans", lambda route: route.fulfill(json=gone), times=1)
    log_in(fresh, console)
    open_view(fresh, console, "scan")
    fresh.click("#go", timeout=LONG_MS)
    expect(fresh.locator("#stage h2")).to_have_text("gone", timeout=LONG_MS)
    open_view(fresh, console, "history")
    expect(fresh.locator("#search")).to_be_visible(timeout=LONG_MS)
    open_view(fresh, console, "scan")
    expect(fresh.locator("#notices")).to_contain_text("This scan was deleted", timeout=LONG_MS)
    expect(fresh.locator("#go")).to_be_enabled(timeout=LONG_MS)


def test_a_scan_that_was_taken_and_deleted_while_its_view_was_left_is_told_as_deleted(
    page: Page, console: LiveConsole
) -> None:
    """It was left during the countdown, and told that the console had been restarted."""
    scan = {"scan_id": "20260101T000000Z-dead", "label": "gone", "state": "countdown",
            "reasons": [], "framesets": 0, "wanted": 0}  # fmt: skip
    events_by_hand(page, console)
    for place in ("**/api/v1/scans", f"**/scans/{scan['scan_id']}"):
        page.route(place, lambda route: route.fulfill(json=scan))
    open_view(page, console, "scan")
    page.click("#go", timeout=LONG_MS)
    expect(page.locator("#stage h2")).to_have_text("gone", timeout=LONG_MS)
    open_view(page, console, "history")
    expect(page.locator("#search")).to_be_visible(timeout=LONG_MS)
    page.unroute_all()
    for state in ("capturing", "failed"):
        tell(page, "scan", scan_id=scan["scan_id"], state=state)
    open_view(page, console, "scan")
    expect(page.locator("#notices")).to_contain_text("This scan was deleted", timeout=LONG_MS)
    expect(page.locator("#go")).to_be_enabled(timeout=LONG_MS)


def test_a_person_whose_scan_is_cancelled_is_not_asked_for_another(
    page: Page, console: LiveConsole
) -> None:
    """The screen in the booth said to stand on the mark again."""
    with console.client("scan") as client:
        page.goto(f"{console.url}/person")
        screen = page.locator("body")
        expect(screen).to_have_attribute("data-screen", "guide", timeout=LONG_MS)
        scan = client.post("/scans", json={"label": "gone", "countdown_s": 20}).json()
        expect(screen).to_have_attribute("data-screen", "countdown", timeout=LONG_MS)
        client.post(f"/scans/{scan['scan_id']}/cancel").raise_for_status()
        expect(screen).not_to_have_attribute("data-screen", "countdown", timeout=LONG_MS)
        expect(screen).to_have_attribute("data-screen", "guide")


def test_a_countdown_that_ended_with_its_console_is_told(fresh: Page, console: LiveConsole) -> None:
    """The page and the person's screen said "Get ready" until somebody gave the scan up."""

    fresh.route("**/api/v1/session", _count_longer)
    log_in(fresh, console)
    person = fresh.context.new_page()
    person.goto(f"{console.url}/person")
    expect(person.locator("svg")).to_be_visible(timeout=LONG_MS)
    open_view(fresh, console, "scan")
    fresh.click("#go", timeout=LONG_MS)
    expect(person.locator("body")).to_have_attribute("data-screen", "countdown", timeout=LONG_MS)
    # The person's screen may know of the scan before the page is answered.
    expect(fresh.locator("#give-up")).to_be_visible(timeout=LONG_MS)
    for pid in console.station.pids("console"):
        os.kill(pid, signal.SIGKILL)
    verdict = fresh.locator("#verdict")
    expect(verdict).to_contain_text("The console was restarted before", timeout=LONG_MS)
    expect(fresh.locator("#again")).to_be_enabled(timeout=LONG_MS)
    expect(person.locator("body")).to_have_attribute("data-screen", "guide", timeout=LONG_MS)
    console.station.wait_until(console.answers, "the console answers")
