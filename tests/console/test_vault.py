"""Secrets of the console: password, sessions and tokens on the disk."""

from __future__ import annotations

import asyncio
import logging
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest
from click.testing import CliRunner
from live_console import API, PASSWORD

from station.console.api.console import COOKIE, Console
from station.console.app import create_app
from station.console.security.vault import Vault
from station.core.config_file import load_config
from station.core.errors import BoothError

_SESSIONS_OF_A_PAGE = 60
"""So many rows do not fit on one page of sqlite's, 4 kB."""


@pytest.fixture
def vault(tmp_path: Path) -> Vault:
    return Vault(tmp_path / "console")


def test_a_full_disk_is_told_by_a_problem_document(tmp_path: Path) -> None:
    """It was a 500 without words, from sqlite."""
    path = tmp_path / "booth.toml"
    path.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    console = Console(load_config(path), path, logging.getLogger())
    console.vault.set_password(PASSWORD)
    database = console.vault._database
    [[pages]] = database.execute("PRAGMA page_count")
    database.execute(f"PRAGMA max_page_count = {pages}")
    # Not by logging in: each password that is checked takes 0.2 s of a core.
    with pytest.raises(OSError, match="No space left on device"):
        list(map(console.vault.open_session, [1.0] * _SESSIONS_OF_A_PAGE))

    async def answer() -> httpx.Response:
        transport = httpx.ASGITransport(create_app(console))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.post(f"{API}/session", json={"password": PASSWORD})

    told = asyncio.run(answer())
    assert (told.status_code, told.json()["type"]) == (503, "/problems/disk"), told.text
    assert "No space left on device" in told.json()["detail"]
    assert "console.sqlite" in told.json()["detail"]
    console.vault.close()
    console.audit.close()


class _Hurried(Vault):
    """A vault whose keys another request forgets at once: it was refused."""

    def _run(self, query: str, *values: object) -> list[tuple[object, ...]]:
        found = super()._run(query, *values)
        if "INTO keys" in query:
            super()._run("DELETE FROM keys")
        return found


def test_a_key_that_another_request_forgets_meanwhile_is_new(tmp_path: Path) -> None:
    """It was a server error."""
    vault = _Hurried(tmp_path)
    assert vault.remember("key", "request", "answer") == ("request", "answer")
    Vault(tmp_path).remember("other", "request", "first")
    assert vault.remember("other", "request", "answer") == ("request", "answer")
    vault.close()


def test_a_refused_check_may_be_asked_for_again(tmp_path: Path) -> None:
    """The same key was answered as if the check had begun, and none ever did."""
    path = tmp_path / "booth.toml"
    path.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    console = Console(load_config(path), path, logging.getLogger())
    headers = {"Idempotency-Key": "morning"}

    async def answers() -> list[httpx.Response]:
        transport = httpx.ASGITransport(create_app(console))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            begun = await client.post(f"{API}/calibration", json={"step": "floor"})
            refused = await client.post(f"{API}/booth/check", headers=headers)
            deadline_s = time.monotonic() + 60.0
            while (await client.get(f"{API}/task")).json()["running"]:
                assert time.monotonic() < deadline_s
                await asyncio.sleep(0.1)
            return [begun, refused, await client.post(f"{API}/booth/check", headers=headers)]

    begun, refused, again = asyncio.run(answers())
    console.tasks.close()
    console.vault.close()
    console.audit.close()
    assert [begun.status_code, refused.status_code, again.status_code] == [202, 409, 202]
    assert again.json()["kind"] == "check"


@contextmanager
def _nothing_written() -> Iterator[None]:
    """No file grows, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_key_has_its_answer_on_a_full_disk(vault: Vault) -> None:
    """A program that asked once more got "the disk cannot be written", not its scan."""
    vault.remember("key", "request", "first")
    with _nothing_written():
        assert vault.remember("key", "request", "second") == ("request", "first")
        with pytest.raises(OSError, match=r"console\.sqlite"):
            vault.remember("other", "request", "first")


def test_a_disk_that_became_read_only_keeps_the_memory_as_it_is(vault: Vault) -> None:
    """Whoever sent cookies of no session, without end, filled it."""
    session = vault.open_session(1.0)
    vault._database.execute("PRAGMA query_only = ON")
    for secret in ("none", session, session):
        vault.close_session(secret)
    assert not vault.session_holds(session)
    assert len(vault._ended) == 1


def test_a_disk_that_refuses_a_new_database_is_told(tmp_path: Path) -> None:
    """The console ended with a traceback from sqlite whenever it was started."""
    with _nothing_written(), pytest.raises(OSError, match=r"console\.sqlite"):
        Vault(tmp_path / "console")


def test_who_logs_out_is_logged_out_on_a_full_disk(tmp_path: Path) -> None:
    """The cookie was kept, and so was the session."""
    path = tmp_path / "booth.toml"
    path.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    console = Console(load_config(path), path, logging.getLogger())
    console.vault.set_password(PASSWORD)
    secret = console.vault.open_session(1.0)

    async def answers() -> list[httpx.Response]:
        transport = httpx.ASGITransport(create_app(console))
        cookie = {"Cookie": f"{COOKIE}={secret}"}
        async with httpx.AsyncClient(
            transport=transport, base_url="http://127.0.0.1", headers=cookie
        ) as client:
            place = f"{API}/session"
            return [await client.get(place), await client.delete(place), await client.get(place)]

    with _nothing_written():
        before, told, after = asyncio.run(answers())
    assert [answer.json()["logged_in"] for answer in (before, told, after)] == [True, False, False]
    assert f'{COOKIE}=""' in told.headers["set-cookie"]
    assert "Max-Age=0" in told.headers["set-cookie"]
    console.vault.open_session(1.0)
    assert not Vault(console.config.console.folder).session_holds(secret)
    console.vault.close()
    console.audit.close()


def test_secrets_are_stored_hashed(vault: Vault, tmp_path: Path) -> None:
    secret = vault.make_token("orders", ("read",), None)
    session = vault.open_session(1.0)
    vault.set_password("a good password")
    stored = b"".join(p.read_bytes() for p in (tmp_path / "console").iterdir())
    for text in (secret, session, "a good password"):
        assert text.encode() not in stored
    assert b"$argon2id$" in stored
    assert all((p.stat().st_mode & 0o077) == 0 for p in (tmp_path / "console").iterdir())
    # A new password ends every session.
    assert not vault.session_holds(session)
    assert vault.check_password("a good password")
    assert not vault.check_password("another password")
    with pytest.raises(BoothError, match="8 characters"):
        vault.set_password("short")


def test_a_password_of_any_script(vault: Vault) -> None:
    """One keyboard sends an accented letter, the other a letter and an accent."""
    vault.set_password("Caf\u00e9 \u6d4b\u91cf \U0001f4cf")
    assert vault.check_password("Cafe\u0301 \u6d4b\u91cf \U0001f4cf")
    assert not vault.check_password("Cafe \u6d4b\u91cf \U0001f4cf")
    assert not vault.check_password("\udcff" * 12)
    with pytest.raises(BoothError, match="not UTF-8"):
        vault.set_password("\udcff" * 12)


def test_tokens_expire_and_are_revoked(vault: Vault) -> None:
    gone = vault.make_token("gone", ("read",), 0.0)
    kept = vault.make_token("kept", ("scan", "read"), 1.0)
    assert vault.find_token(gone) is None
    found = vault.find_token(kept)
    assert found is not None
    assert found.scopes == ("read", "scan")
    with pytest.raises(BoothError, match="already"):
        vault.make_token("kept", ("read",), None)
    vault.revoke_token("kept")
    assert vault.find_token(kept) is None
    with pytest.raises(BoothError, match="no token"):
        vault.revoke_token("kept")


def test_tokens_on_the_command_line(tmp_path: Path) -> None:
    from station.cli import station

    config = tmp_path / "booth.toml"
    config.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    option = ["--config", str(config)]
    made = CliRunner().invoke(station, ["token", "make", "orders", "--scope", "scan", *option])
    secret = made.output.splitlines()[0]
    assert Vault(tmp_path / "console").find_token(secret) is not None
    assert "orders" in CliRunner().invoke(station, ["token", "list", *option]).output
    assert CliRunner().invoke(station, ["token", "revoke", "orders", *option]).exit_code == 0
    assert Vault(tmp_path / "console").find_token(secret) is None


@pytest.mark.usefixtures("in_shanghai")
def test_a_token_is_listed_with_the_local_day_of_its_end(tmp_path: Path) -> None:
    """At 20:00 UTC the next day has begun in Shanghai."""
    from station.cli import station

    config = tmp_path / "booth.toml"
    config.write_text('[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n')
    end_s = datetime(2030, 1, 1, 20, tzinfo=UTC).timestamp()
    vault = Vault(tmp_path / "console")
    vault.make_token("orders", ("scan",), (end_s - time.time()) / 86400.0)
    vault.make_token("sheets", ("read",), None)
    listed = CliRunner().invoke(station, ["token", "list", "--config", str(config)]).output
    assert [line.split("  ")[-1].strip() for line in listed.splitlines()] == [
        "until 2030-01-02",
        "does not expire",
    ]
