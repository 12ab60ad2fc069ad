"""The console beside a capturing booth: its load, and how soon the page shows what happened.

Everything is real: four replayed sensors at 30 Hz, the console's process, viewers over its sockets,
Debian's chromium. Times are taken in the page by its own clock, which is this machine's.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
from console_page import wait_for_value
from live_console import API, PASSWORD, LiveConsole
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright
from running_station import STATION
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from station.booth.health import booth_health

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"
VIEWERS = 3
_ARGUMENTS = ["--no-sandbox", "--disable-gpu"]
_DEAF_S = 60.0
_PAINTS, _SCANS, _KILLS = 10, 20, 5
_SETTLE_S = 3.0
_WAIT_MS = 60_000
_WHEN_PAINTED = """
const look = () => {
  if (!document.querySelector('#go')) { requestAnimationFrame(look); return; }
  // The frame after the one that holds the button has been painted.
  requestAnimationFrame(() => setTimeout(() => { window.paintedMs = performance.now(); }));
};
requestAnimationFrame(look);
"""
_WATCH_FOR = """(selector) => {
  window.seenAt = 0;
  const look = () => {
    const found = document.querySelector(selector);
    if (!window.seenAt && found && !found.hidden) window.seenAt = Date.now();
  };
  window.watching?.disconnect();
  window.watching = new MutationObserver(look);
  window.watching.observe(document.body, { subtree: true, childList: true, attributes: true });
  look();
}"""


@dataclass(slots=True)
class Table:
    """Bars with what was measured."""

    missed: int = 0

    def row(self, what: str, measured: str, bar: str, met: bool) -> None:
        self.missed += not met
        print(f"  {what:<52} {measured:<28} {bar:<12} {'met' if met else 'missed'}", flush=True)


@dataclass(slots=True)
class Viewers:
    """Viewers of the four pictures, each asking for the next when it has one."""

    console: LiveConsole
    pictures: list[int] = field(default_factory=lambda: [0] * VIEWERS)
    longest_s: float = 0.0
    _stop: threading.Event = field(default_factory=threading.Event)

    def view(self, index: int) -> None:
        with picture_socket(self.console) as pictures:
            last_s = time.monotonic()
            while not self._stop.is_set():
                pictures.send("next")
                pictures.recv(timeout=10.0)
                now_s = time.monotonic()
                self.longest_s = max(self.longest_s, now_s - last_s)
                self.pictures[index] += 1
                last_s = now_s

    @contextmanager
    def looking(self) -> Iterator[Viewers]:
        threads = [threading.Thread(target=self.view, args=(i,)) for i in range(VIEWERS)]
        for thread in threads:
            thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            for thread in threads:
                thread.join()


def picture_socket(console: LiveConsole) -> ClientConnection:
    """A socket of depth pictures."""
    address = f"ws://127.0.0.1:{console.port}{API}/pictures"
    token = {"Authorization": f"Bearer {console.tokens['read']}"}
    # A viewer that reads nothing keeps nothing: its socket is all that takes the pictures.
    return connect(
        address,
        additional_headers=token,
        max_size=1 << 22,
        max_queue=1,
        close_timeout=1.0,
        ping_interval=None,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each load")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        booth, folder = Path(name) / "booth", Path(name) / "console"
        folder.mkdir()
        options = ("--body", str(BODY), "--out", str(booth), "--frames", "30", "--passes", "60")
        subprocess.run([*STATION, "record-virtual", *options], check=True, capture_output=True)
        console = LiveConsole(booth, folder)
        try:
            console.start_sensors()
            console.scan("compiles")
            table = Table()
            measure_load(table, console, arguments.seconds)
            with tablet(console) as (browser, context):
                measure_paint(table, console, browser)
                measure_results(table, console, context)
                measure_lost_cameras(table, console, context)
        finally:
            console.close()
    print(f"{table.missed} missed")
    raise SystemExit(1 if table.missed else 0)


@contextmanager
def tablet(console: LiveConsole) -> Iterator[tuple[Browser, BrowserContext]]:
    """A browser that is logged in."""
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=_ARGUMENTS)
        yield browser, logged_in(console, browser)
        browser.close()


def logged_in(console: LiveConsole, browser: Browser) -> BrowserContext:
    """A new browser profile with a session and an empty cache."""
    context = browser.new_context(viewport={"width": 1024, "height": 768}, locale="en-GB")
    answer = context.request.post(
        f"{console.url}{API}/session",
        data={"password": PASSWORD},
        headers={"Origin": console.url},
    )
    assert answer.ok, answer.text()
    return context


def console_share(console: LiveConsole, seconds: float) -> float:
    """Processor time of the console's process over some seconds, in cores."""
    process = psutil.Process(console.station.pids("console")[0])

    def used_s() -> float:
        times = process.cpu_times()
        return float(times.user + times.system)

    before_s, began_s = used_s(), time.monotonic()
    time.sleep(seconds)
    return (used_s() - before_s) / (time.monotonic() - began_s)


def measure_load(table: Table, console: LiveConsole, seconds: float) -> None:
    """The console's processor time, alone, with viewers, with one that reads nothing."""
    time.sleep(_SETTLE_S)
    idle = console_share(console, seconds)
    print(f"  {'the console without a viewer':<52} {idle:.3f} core")
    before = sensed(console)
    with Viewers(console).looking() as viewers:
        time.sleep(_SETTLE_S)
        start = list(viewers.pictures)
        share = console_share(console, seconds)
        rates = [(now - then) / seconds for now, then in zip(viewers.pictures, start, strict=True)]
    after = sensed(console)
    what = f"four previews at {min(rates):.1f} Hz, {VIEWERS} viewers"
    table.row(what, f"{share:.3f} core", "< 0.4", share < 0.4)
    lost = sum(after["cameras"][n]["lost"] - before["cameras"][n]["lost"] for n in after["cameras"])
    table.row("frames lost meanwhile", str(lost), "0", lost == 0)
    p99_ms = 1e3 * after["latency_p99_s"]
    table.row("framesets' latency, 99th percentile", f"{p99_ms:.1f} ms", "< 40 ms", p99_ms < 40)
    measure_deaf(table, console, idle)


def measure_deaf(table: Table, console: LiveConsole, idle: float) -> None:
    """A viewer that asks for everything and reads nothing for a minute."""
    process = psutil.Process(console.station.pids("console")[0])
    with picture_socket(console) as deaf, events_socket(console):
        done = threading.Event()

        def ask() -> None:
            with suppress(ConnectionClosed, OSError):
                while not done.wait(0.05):
                    deaf.send("next")

        threading.Thread(target=ask, daemon=True).start()
        memory = process.memory_info().rss
        share = console_share(console, _DEAF_S)
        grown_mb = (process.memory_info().rss - memory) / 1e6
        with Viewers(console).looking() as viewers:
            time.sleep(_SETTLE_S)
        done.set()
    table.row(
        "a viewer that reads nothing for a minute",
        f"{share - idle:+.3f} core, {grown_mb:+.1f} MB",
        "< 0.02, < 20",
        share - idle < 0.02 and grown_mb < 20,
    )
    longest_ms = 1e3 * viewers.longest_s
    table.row(
        "others beside it wait for a picture", f"{longest_ms:.0f} ms", "< 500", longest_ms < 500
    )


@contextmanager
def events_socket(console: LiveConsole) -> Iterator[None]:
    """A program that asks for all events and reads none."""
    with socket.create_connection(("127.0.0.1", console.port)) as connection:
        connection.sendall(
            f"GET {API}/events HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            f"Authorization: Bearer {console.tokens['read']}\r\n\r\n".encode()
        )
        yield


def sensed(console: LiveConsole) -> dict[str, Any]:
    """Cameras and framesets, as sync tells."""
    return booth_health(console.config).sync


def measure_paint(table: Table, console: LiveConsole, browser: Browser) -> None:
    """The scan view with an empty cache: when its button is painted."""
    times_ms = []
    for _ in range(_PAINTS):
        context = logged_in(console, browser)
        page = context.new_page()
        page.add_init_script(_WHEN_PAINTED)
        page.goto(f"{console.url}/#/scan", wait_until="commit")
        times_ms.append(float(wait_for_value(page, "window.paintedMs")))
        context.close()
    slowest = max(times_ms)
    what = f"first view painted, slowest of {_PAINTS}"
    table.row(what, f"{slowest:.0f} ms", "< 1000 ms", slowest < 1000)


def since_ms(page: Page, began: float) -> float:
    """Time from ``began`` (s since 1970) to what the page watches for, milliseconds."""
    return float(wait_for_value(page, "window.seenAt")) - 1e3 * began


def measure_results(table: Table, console: LiveConsole, context: BrowserContext) -> None:
    """From a result's rename into the outbox to the verdict on the page."""
    page = context.new_page()
    page.goto(f"{console.url}/#/scan")
    times_ms = []
    for _ in range(_SCANS):
        page.reload()
        page.wait_for_selector("#go:enabled", timeout=_WAIT_MS)
        page.evaluate(_WATCH_FOR, "#verdict")
        known = set(outbox(console))
        page.click("#go")
        page.wait_for_selector("#verdict", timeout=_WAIT_MS)
        [delivered] = set(outbox(console)) - known
        # A rename is a change of the folder's inode.
        times_ms.append(since_ms(page, delivered.stat().st_ctime))
    page.close()
    times_ms.sort()
    middle, p95 = (times_ms[round(share * (len(times_ms) - 1))] for share in (0.5, 0.95))
    text = f"{middle:.0f}, p95 {p95:.0f}, worst {times_ms[-1]:.0f} ms"
    table.row(f"a result is on the page, {_SCANS} scans", text, "< 300 ms", times_ms[-1] < 300)


def outbox(console: LiveConsole) -> list[Path]:
    """Delivered results."""
    return list((console.config.spool.folder / "outbox").iterdir())


def measure_lost_cameras(table: Table, console: LiveConsole, context: BrowserContext) -> None:
    """From the end of a capture process to its remedy on the page."""
    page = context.new_page()
    page.goto(f"{console.url}/#/booth")
    card = "[data-camera=back-upper]"
    for name, number in (("hung", signal.SIGSTOP), ("killed", signal.SIGKILL)):
        times_ms = []
        for _ in range(_KILLS):
            page.wait_for_selector(f"{card}[data-state=streaming]", timeout=_WAIT_MS)
            time.sleep(_SETTLE_S)
            page.evaluate(_WATCH_FOR, f"{card} .remedy")
            victim = console.station.pids("capture", "back-upper")[0]
            began = time.time()
            os.kill(victim, number)
            times_ms.append(since_ms(page, began))
            with suppress(ProcessLookupError):
                os.kill(victim, signal.SIGCONT)
        worst = max(times_ms)
        table.row(
            f"a {name} camera's remedy is on the page",
            f"worst of {_KILLS}: {worst:.0f} ms",
            "< 2000 ms",
            worst < 2000,
        )
    page.close()


if __name__ == "__main__":
    main()
