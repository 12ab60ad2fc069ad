"""The console's page in Debian's chromium, as a test drives it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from live_console import PASSWORD, LiveConsole
from playwright.sync_api import (
    Browser,
    BrowserContext,
    Locator,
    Page,
    TimeoutError,
    expect,
    sync_playwright,
)

LONG_MS = 120_000
"""Patience with a machine that does much else; no test is about speed."""
_SIZE = {"width": 1024, "height": 768}
_ARGUMENTS = [
    "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
]  # fmt: skip
_MOVING = """async () => {
  const canvas = document.querySelector('[data-camera] canvas');
  const pixels = () => canvas.getContext('2d').getImageData(0, 0, 320, 240).data;
  const before = pixels();
  for (let tries = 0; tries < 50; tries += 1) {
    await new Promise((resolve) => setTimeout(resolve, 200));
    if (pixels().some((value, i) => value !== before[i])) return true;
  }
  return false;
}"""

_EVENTS = """
window.EventSource = class extends EventTarget {
  constructor() { super(); this.readyState = 0; window.source = this; }
  close() {}
};
"""


@contextmanager
def browser() -> Iterator[Browser]:
    """Debian's chromium without a display."""
    chromium = shutil.which("chromium")
    assert chromium, "chromium is missing; make test installs it where it may: apt install chromium"
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=_ARGUMENTS)
        yield started
        started.close()


def tablet(started: Browser) -> BrowserContext:
    """A tablet that nobody is logged in at."""
    return started.new_context(viewport=_SIZE, has_touch=True, locale="en-GB")  # type: ignore[arg-type]


def log_in(page: Page, console: LiveConsole) -> None:
    """Type the password at the console's first page."""
    page.goto(console.url)
    page.fill("#password", PASSWORD)
    page.click("#login")
    expect(page.locator("#rail")).to_be_visible(timeout=LONG_MS)


def open_view(page: Page, console: LiveConsole, view: str) -> None:
    page.goto(f"{console.url}/#/{view}")


def give_up_a_scan(page: Page) -> None:
    """Begin a scan and cancel it; again where a busy machine's station did not begin one."""
    for _ in range(5):
        expect(page.locator("#go")).to_be_enabled(timeout=LONG_MS)
        page.click("#go")
        with suppress(TimeoutError):
            page.click("#give-up", timeout=10_000)
            return
    raise AssertionError("no scan was begun")


def events_by_hand(page: Page, console: LiveConsole) -> None:
    """Load the page so that it hears only what `tell` tells it."""
    page.add_init_script(_EVENTS)
    page.goto(console.url)
    wait_for_value(page, "window.source !== undefined")


def tell(page: Page, kind: str, **data: Any) -> None:
    """Tell the page of an event."""
    event = "new MessageEvent(kind, { data: JSON.stringify(data) })"
    page.evaluate(f"([kind, data]) => window.source.dispatchEvent({event})", [kind, data])


def wait_for_value(page: Page, expression: str) -> Any:
    """Value of an expression once it is true; the page's policy forbids Playwright's own way."""
    deadline_s = time.monotonic() + 1e-3 * LONG_MS
    while not (value := page.evaluate(expression)):
        assert time.monotonic() < deadline_s, f"never true: {expression}"
        time.sleep(0.02)
    return value


def more_frames(card: Locator, count: int) -> None:
    """Wait for so many more pictures of a camera."""
    wanted = int(card.get_attribute("data-frames") or 0) + count
    deadline_s = time.monotonic() + 1e-3 * LONG_MS
    while int(card.get_attribute("data-frames") or 0) < wanted:
        assert time.monotonic() < deadline_s, "no new pictures"
        time.sleep(0.1)


def four_pictures_move(page: Page, console: LiveConsole) -> None:
    """The booth's view: every camera streams, gives pictures, and they change."""
    open_view(page, console, "booth")
    cards = page.locator("[data-camera]")
    expect(cards).to_have_count(4, timeout=LONG_MS)
    for index in range(4):
        expect(cards.nth(index)).to_have_attribute("data-state", "streaming", timeout=LONG_MS)
    for index in range(4):
        more_frames(cards.nth(index), 5)
    assert page.evaluate(_MOVING)
