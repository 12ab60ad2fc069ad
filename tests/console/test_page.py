"""The page in Debian's chromium, in short: an operator logs in, looks, scans and reads the result.

page_in_browser.py has every other view and what goes wrong; `make test-console` runs it.
"""

from __future__ import annotations

import os
import signal

import pytest
from console_page import LONG_MS, four_pictures_move, log_in, open_view
from live_console import LiveConsole
from playwright.sync_api import Page, Route, expect

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


def test_an_operator_looks_scans_and_reads_the_result(fresh: Page, console: LiveConsole) -> None:
    errors: list[str] = []
    fresh.on("pageerror", lambda error: errors.append(str(error)))
    log_in(fresh, console)
    four_pictures_move(fresh, console)
    open_view(fresh, console, "scan")
    fresh.fill("#label", "Order 5")
    fresh.evaluate(_NOTE_WORDS)
    fresh.click("#go")
    expect(fresh.locator("#stage .word")).to_have_text(_IN_ORDER[-1], timeout=5 * LONG_MS)
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
    compiled = fresh.locator("#stage").get_by_text("being compiled, once on this computer")
    fresh.click("#go")
    expect(compiled).to_be_visible(timeout=5 * LONG_MS)
    expect(fresh.locator("#stage .word")).to_have_text("Measuring the body")
    expect(fresh.locator("#verdict")).to_be_visible(timeout=5 * LONG_MS)
    expect(compiled).to_have_count(0)


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

    def longer(route: Route) -> None:
        route.fulfill(json={**route.fetch().json(), "countdown_s": 30})

    fresh.route("**/api/v1/session", longer)
    log_in(fresh, console)
    person = fresh.context.new_page()
    person.goto(f"{console.url}/person")
    expect(person.locator("svg")).to_be_visible(timeout=LONG_MS)
    open_view(fresh, console, "scan")
    fresh.click("#go", timeout=LONG_MS)
    expect(person.locator("body")).to_have_attribute("data-screen", "countdown", timeout=LONG_MS)
    for pid in console.station.pids("console"):
        os.kill(pid, signal.SIGKILL)
    verdict = fresh.locator("#verdict")
    expect(verdict).to_contain_text("The console was restarted before", timeout=LONG_MS)
    expect(fresh.locator("#again")).to_be_enabled(timeout=LONG_MS)
    expect(person.locator("body")).to_have_attribute("data-screen", "guide", timeout=LONG_MS)
    console.station.wait_until(console.answers, "the console answers")
