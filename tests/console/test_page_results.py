"""The page's history and results."""

from __future__ import annotations

from typing import Any

import pytest
from console_page import LONG_MS, open_view
from live_console import LiveConsole
from playwright.sync_api import Page, Route, expect

from station.handover.ledger import Ledger, Waiting

pytestmark = pytest.mark.usefixtures("sensors")


def test_copies_that_stay_are_told_before_a_scan_is_deleted(
    page: Page, console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    """The page said that it was deleted, and programs that it was handed over to had it still."""
    scan_id = scans[0]["scan_id"]
    ledger = Ledger(console.config.spool.folder)
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
    page: Page, console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    """Centimetres stood under "in", and the lines of one pose beside the numbers of another."""
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


@pytest.mark.parametrize(
    ("state", "words"), [("delivered", "Remarks: "), ("rescan", "Scan again: ")]
)
def test_what_is_said_of_a_result_covers_no_button(
    page: Page, console: LiveConsole, scans: list[dict[str, Any]], state: str, words: str
) -> None:
    """A remark pushed the buttons below the body out of a tablet's screen, and reasons to scan
    again were told as remarks."""
    scan = {**scans[0], "state": state, "reasons": ["the person leans by 9 degrees: stand upright"]}
    page.route(f"**/scans/{scan['scan_id']}", lambda route: route.fulfill(json=scan))
    open_view(page, console, f"result/{scan['scan_id']}")
    expect(page.locator(".banner")).to_have_text(f"{words}{scan['reasons'][0]}", timeout=LONG_MS)
    expect(page.get_by_role("button", name="Front")).to_be_in_viewport(ratio=1.0, timeout=LONG_MS)
