"""Refusals: other hosts, origins and sites, wrong tokens and scopes; a login's cookie."""

from __future__ import annotations

import asyncio
from typing import Any

import httpx
import pytest
import websockets
from live_console import API, PASSWORD, LiveConsole, problem_status

from station.console.security.origin import host_allowed, own_names, same_origin
from station.console.security.throttle import FREE_TRIES, LoginThrottle, pause_s


def test_a_program_gets_sixty_seconds_for_each_guess() -> None:
    throttle, now_s = LoginThrottle(), 0.0
    for _ in range(FREE_TRIES):
        assert throttle.wait_s("a", now_s) == 0.0
        throttle.failed("a", now_s)
    assert throttle.wait_s("a", now_s) == 1.0
    for _ in range(100):
        now_s += throttle.wait_s("a", now_s)
        throttle.failed("a", now_s)
    assert throttle.wait_s("a", now_s) == 60.0 == pause_s(10_000)
    assert throttle.wait_s("b", now_s) == 0.0
    throttle.succeeded("a")
    assert throttle.wait_s("a", now_s) == 0.0


@pytest.mark.parametrize(
    ("host", "allowed"),
    [
        ("127.0.0.1:8420", True), ("localhost", True), ("[::1]:8420", True), ("192.168.1.9", True),
        ("evil.example", False), ("127.0.0.1.evil.example", False), ("", False),
        ("a@localhost", False), ("localhost:port", False), ("shop.local", True),
    ],
)  # fmt: skip
def test_hosts(host: str, allowed: bool) -> None:
    """A name that somebody pointed at this address must not be served (DNS rebinding)."""
    assert host_allowed(host, own_names(["shop.local"])) is allowed


def test_origins() -> None:
    assert same_origin("http://localhost:8420", "localhost:8420", "http")
    assert not same_origin("http://localhost:8421", "localhost:8420", "http")
    assert not same_origin("https://localhost:8420", "localhost:8420", "http")
    assert not same_origin("null", "localhost:8420", "http")
    assert not same_origin("http://[", "localhost", "http")


def test_scopes(console: LiveConsole) -> None:
    with console.anonymous() as client:
        for path in ("/booth", "/scans", "/events", "/task", "/calibrations"):
            assert problem_status(client.get(path)) == 401
        wrong = {"Authorization": "Bearer booth_nothing"}
        assert problem_status(client.get("/booth", headers=wrong)) == 401
        assert client.get("/session").json()["logged_in"] is False
    with console.client("read") as client:
        assert client.get("/booth").status_code == 200
        assert problem_status(client.post("/scans", json={})) == 403
        assert problem_status(client.delete("/scans/x")) == 403
    with console.client("scan") as client:
        assert problem_status(client.post("/calibration", json={})) == 403


def test_other_sites_are_refused(console: LiveConsole) -> None:
    with console.client() as client:
        for origin in ("http://evil.example", "null", f"https://127.0.0.1:{console.port}"):
            refused = client.post("/booth/stop", headers={"Origin": origin})
            assert problem_status(refused) == 403
        own = {"Origin": console.url}
        assert client.post("/booth/stop", headers=own).status_code == 200
        cross = client.get("/booth", headers={"Sec-Fetch-Site": "cross-site"})
        assert problem_status(cross) == 403
        renamed = client.get("/booth", headers={"Host": "evil.example"})
        assert problem_status(renamed) == 421


def test_a_wrong_origin_opens_no_websocket(console: LiveConsole) -> None:
    url = f"ws://127.0.0.1:{console.port}{API}/pictures"
    token = {"Authorization": f"Bearer {console.tokens['read']}"}

    async def rejected(**options: Any) -> bool:
        try:
            async with websockets.connect(url, **options) as socket_:
                await socket_.send("next")
                await asyncio.wait_for(socket_.recv(), 5)
            return False
        except (websockets.InvalidStatus, websockets.ConnectionClosed):
            return True

    async def all_of_them() -> list[bool]:
        return [
            await rejected(origin="http://evil.example", additional_headers=token),
            await rejected(origin=console.url),
            await rejected(),
            await rejected(origin=console.url, additional_headers=token),
        ]

    assert asyncio.run(all_of_them()) == [True, True, True, False]


def test_the_page_runs_no_script_but_its_own(console: LiveConsole) -> None:
    for path in ("/", "/person", f"{API}/docs"):
        answer = httpx.get(console.url + path)
        policy = answer.headers["content-security-policy"]
        assert "script-src 'self'" in policy
        assert "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "<script>" not in answer.text
        assert " on" not in answer.text.split("<body")[1].replace(" one", "")


def test_a_login_is_a_strict_cookie(console: LiveConsole) -> None:
    with console.anonymous() as client:
        assert problem_status(client.post("/session", json={"password": "wrong password"})) == 401
        answer = client.post("/session", json={"password": PASSWORD})
        cookie = answer.headers["set-cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=strict" in cookie
        assert client.get("/booth").status_code == 200
        # A page of another site has the cookie, too; its Origin gives it away.
        evil = client.post("/booth/stop", headers={"Origin": "http://evil.example"})
        assert problem_status(evil) == 403
        assert client.delete("/session").status_code == 200
        assert problem_status(client.get("/booth")) == 401
