"""Refusals of crooked, large, slow and countless requests."""

from __future__ import annotations

import json
import os
import socket
import time
from typing import Any

import pytest
from live_console import API, LiveConsole, problem_status


def _raw(console: LiveConsole, data: bytes, *, wait_s: float = 15.0) -> bytes:
    with socket.create_connection(("127.0.0.1", console.port), timeout=wait_s) as connection:
        connection.sendall(data)
        received = b""
        try:
            while part := connection.recv(65536):
                received += part
        except (TimeoutError, ConnectionResetError):
            pass
        return received


@pytest.mark.parametrize(
    "name",
    ["../../booth.toml", "..%2f..%2fbooth.toml", "%2e%2e/result.json", "/etc/passwd", ".hidden",
     "result.json%00.png", "..", "mesh.ply/..", "%5c..%5cbooth.toml"],
)  # fmt: skip
def test_no_path_leads_out_of_a_result(
    console: LiveConsole, scans: list[dict[str, Any]], name: str
) -> None:
    path = f"/scans/{scans[0]['scan_id']}/files/{name}"
    request = (
        f"GET {API}{path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n"
        f"Authorization: Bearer {console.tokens['manage']}\r\n\r\n"
    )
    answer = _raw(console, request.encode())
    assert answer.split(b" ")[1] in (b"404", b"422", b"405"), answer[:300]
    assert b"[[cameras]]" not in answer


def test_large_requests_are_refused(console: LiveConsole) -> None:
    with console.anonymous() as client:
        assert problem_status(client.post("/session", content=b"x" * 70_000)) == 413

        def endless() -> Any:
            for _ in range(80):
                yield b"x" * 1000

        assert problem_status(client.post("/session", content=endless())) == 413
    head = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"a" * 40_000 + b"\r\n\r\n"
    assert _raw(console, head).split(b" ")[1] in (b"400", b"431")
    crooked = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -5\r\n\r\n"
    assert _raw(console, crooked).split(b" ")[1] in (b"400", b"413")
    assert console.answers()


def test_slow_senders_are_not_waited_for(console: LiveConsole) -> None:
    """Ten seconds for a head, ten for a body; meanwhile everybody else is served."""
    began_s = time.monotonic()
    heads = [socket.create_connection(("127.0.0.1", console.port), timeout=20.0) for _ in range(20)]
    for connection in heads:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127")
    body = socket.create_connection(("127.0.0.1", console.port), timeout=20.0)
    body.sendall(
        f"POST {API}/session HTTP/1.1\r\nHost: 127.0.0.1\r\n"
        "Content-Type: application/json\r\nContent-Length: 50\r\n\r\n{".encode()
    )
    assert console.answers()
    assert b" 408 " in body.recv(65536)
    for connection in heads:
        assert connection.recv(100) == b""
        connection.close()
    body.close()
    assert time.monotonic() - began_s < 19.0
    assert console.answers()


def test_thousands_of_wrong_passwords(console: LiveConsole) -> None:
    """Most are refused unread; the station goes on meanwhile, and so does whoever is logged in.

    Those that are checked depend on how long it takes, not on how many are sent: 600 show what
    the 10,000 of `make test-console-long` do.
    """
    from concurrent.futures import ThreadPoolExecutor

    count = int(os.environ.get("CONSOLE_GUESSES", "600"))
    body = json.dumps({"password": "guess"}).encode()
    head = (
        f"POST {API}/session HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    ).encode()

    def guess(count: int) -> list[int]:
        found = []
        with socket.create_connection(("127.0.0.1", console.port), timeout=30.0) as connection:
            stream = connection.makefile("rb")
            for _ in range(count):
                connection.sendall(head + body)
                status = int(stream.readline().split()[1])
                length = 0
                while (line := stream.readline()) != b"\r\n":
                    if line.lower().startswith(b"content-length"):
                        length = int(line.split()[1])
                stream.read(length)
                found.append(status)
        return found

    with ThreadPoolExecutor(4) as pool:
        statuses = [s for part in pool.map(guess, [count // 4] * 4) for s in part]
    assert len(statuses) == count
    assert set(statuses) <= {401, 429}
    assert statuses.count(401) < 40
    with console.client("read") as client:
        assert client.get("/booth").status_code == 200
