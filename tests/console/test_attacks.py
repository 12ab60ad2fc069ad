"""Attacks that come in crowds or repeat themselves: each refused, everybody else served."""

from __future__ import annotations

import hashlib
import json
import socket
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import Any
from xml.etree import ElementTree

import httpx
import pytest
from click.testing import CliRunner
from live_console import API, PASSWORD, LiveConsole
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from station.booth.operator.scan_cli import scan
from station.console.api.console import key_of
from station.console.api.models import NewScan
from station.console.security.throttle import AT_ONCE, FREE_TRIES
from station.console.security.vault import Vault

_CROWD = 150
_GUESSES = 40


def _from(console: LiveConsole, address: str) -> httpx.Client:
    """A client at another address of this machine."""
    transport = httpx.HTTPTransport(local_address=address)
    return httpx.Client(base_url=console.url + API, transport=transport, timeout=60.0)


def test_one_address_keeps_nobody_else_out(console: LiveConsole) -> None:
    with ExitStack() as stack, _from(console, "127.0.0.2") as other:
        crowd = []
        for _ in range(_CROWD):
            one = socket.create_connection(
                ("127.0.0.1", console.port), timeout=30.0, source_address=("127.0.0.3", 0)
            )
            crowd.append(stack.enter_context(one))
        assert other.get("/session").status_code == 200
        # Those beyond the limit are closed at once, the last one as well.
        with suppress(ConnectionResetError):
            assert crowd[-1].recv(100) == b""
        assert other.get("/session").status_code == 200


def test_websockets_that_end_are_counted_off(console: LiveConsole) -> None:
    """Each left its address one connection fewer, until the address was shut out."""
    url = f"ws://127.0.0.1:{console.port}{API}/pictures"
    for _ in range(_CROWD):
        with suppress(InvalidStatus), connect(url, origin=Origin("http://example.com")):
            pass
    with console.client() as client:
        assert client.get("/session").status_code == 200


def test_guesses_that_are_sent_all_at_once_count_one_by_one(console: LiveConsole) -> None:
    with _from(console, "127.0.0.4") as client:

        def guess(number: int) -> int:
            return client.post("/session", json={"password": f"wrong {number}"}).status_code

        with ThreadPoolExecutor(_GUESSES) as pool:
            statuses = list(pool.map(guess, range(_GUESSES)))
    assert set(statuses) <= {401, 429}
    assert statuses.count(401) < FREE_TRIES + AT_ONCE
    with _from(console, "127.0.0.5") as client:
        assert client.post("/session", json={"password": PASSWORD}).status_code == 200


def test_the_same_key_at_the_same_time_is_one_scan(console: LiveConsole) -> None:
    with console.sensors(), console.client("scan") as client:

        def take(_: int) -> str:
            answer = client.post(
                "/scans",
                json={"label": "race", "countdown_s": 20},
                headers={"Idempotency-Key": "race"},
            )
            assert answer.status_code == 202, answer.text
            return str(answer.json()["scan_id"])

        with ThreadPoolExecutor(20) as pool:
            found = set(pool.map(take, range(20)))
        assert len(found) == 1
        client.post(f"/scans/{found.pop()}/cancel").raise_for_status()


def test_a_key_whose_scan_was_deleted_begins_no_other(console: LiveConsole) -> None:
    body = NewScan(label="long ago").model_dump_json()
    vault = Vault(console.config.console.folder)
    asked = hashlib.sha256(body.encode()).hexdigest()
    vault.remember(key_of("scan", "old"), asked, "20200101T000000Z-aaaa")
    vault.close()
    with console.client("scan") as client:
        again = client.post(
            "/scans", json={"label": "long ago"}, headers={"Idempotency-Key": "old"}
        )
        assert again.status_code == 404
        assert client.get("/scans", params={"label": "long ago"}).json()["scans"] == []


def test_a_refused_request_may_be_sent_again(console: LiveConsole) -> None:
    request = {"json": {"label": "again", "countdown_s": 20}, "headers": {"Idempotency-Key": "off"}}
    with console.client() as client:
        refused = client.post("/scans", **request)  # type: ignore[arg-type]
        assert refused.status_code == 409
        # Programs were told a command.
        remedy = "switch them on with POST /api/v1/booth/start"
        for told in (refused, client.post("/scans", json={"label": "at once"})):
            assert told.json()["detail"] == f"the sensors are stopped; {remedy}"
        option = ["--config", str(console.station.config)]
        typed = str(CliRunner().invoke(scan, option).exception)
        assert typed == "the sensors are stopped; run station start first"
        with console.sensors():
            taken = client.post("/scans", **request)  # type: ignore[arg-type]
            assert taken.status_code == 202
            client.post(f"/scans/{taken.json()['scan_id']}/cancel").raise_for_status()


@pytest.mark.parametrize("junk", ["x", "-1", "0-0", "9" * 60, "²-²", "00000000-", "a-1; b"])
def test_a_strange_last_event_id_begins_anew(console: LiveConsole, junk: str) -> None:
    with console.client("read") as client:
        answer = client.get(
            "/events", params={"follow": "false"}, headers=[(b"Last-Event-ID", junk.encode())]
        )
        assert answer.status_code == 200
        assert "event: reset" in answer.text


def test_an_event_that_is_not_there_yet_is_not_waited_for(console: LiveConsole) -> None:
    with console.client("read") as client:
        first = client.get(
            "/events", params={"follow": "false"}, headers={"Last-Event-ID": "x"}
        ).text
        start = first.split("id: ")[1].split("-")[0]
        future = client.get(
            "/events",
            params={"follow": "false"},
            headers={"Last-Event-ID": f"{start}-999999999999999999"},
        )
        assert "event: reset" in future.text


@pytest.mark.parametrize(
    "wanted",
    ["bytes=", "bytes=-", "bytes=5-1", "bytes=-0", "bytes=a-b", "lines=0-5",
     "bytes=" + "0-0," * 500,
     "bytes=" + ",".join(f"{i}-{i}" for i in range(1500)), "bytes=0-" + "9" * 400],
)  # fmt: skip
def test_strange_ranges(console: LiveConsole, scans: list[dict[str, Any]], wanted: str) -> None:
    path = f"/scans/{scans[0]['scan_id']}/files/result.json"
    with console.client("read") as client:
        whole = client.get(path)
        answer = client.get(path, headers={"Range": wanted})
        assert answer.status_code in (200, 206, 400, 416, 431), answer.text
        if answer.status_code == 200:
            assert answer.content == whole.content
        # However many ranges: never much more than the file.
        assert len(answer.content) < 100 * len(whole.content)


def test_entity_tags(console: LiveConsole, scans: list[dict[str, Any]]) -> None:
    path = f"/scans/{scans[0]['scan_id']}/files/result.json"
    with console.client("read") as client:
        whole = client.get(path)
        tag = whole.headers["etag"]
        for known in (tag, f"W/{tag}", f'"other", {tag}', "*"):
            assert client.get(path, headers={"If-None-Match": known}).status_code == 304, known
        for other in ('"other"', tag.strip('"'), "", '"'):
            assert client.get(path, headers={"If-None-Match": other}).status_code == 200, other
        stale = client.get(path, headers={"Range": "bytes=0-9", "If-Range": '"other"'})
        assert (stale.status_code, stale.content) == (200, whole.content)


def test_a_strange_label_reaches_every_export(console: LiveConsole) -> None:
    label = "=cmd|' /C calc'!A1 <img src=x onerror=alert(1)> \u202e4321 \ufffe 𝔸 ]]>"
    done = console.scan(label)
    path = f"/scans/{done['scan_id']}"
    with console.client() as client:
        assert client.get(path).json()["label"] == label
        ElementTree.fromstring(client.get(f"{path}/individual.smis").content)
        for name in ("measurements.csv", "sheet.pdf", "result.zip"):
            assert client.get(f"{path}/{name}").status_code == 200, name
        client.delete(path).raise_for_status()


@pytest.mark.parametrize("body", ['{"label": "\\ud800"}', '{"label": "\\u0000"}', "[" * 60_000])
def test_strange_bodies_are_refused(console: LiveConsole, body: str) -> None:
    with console.client("scan") as client:
        answer = client.post("/scans", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code == 422, answer.text
        assert json.loads(answer.content)["type"] == "/problems/invalid"
