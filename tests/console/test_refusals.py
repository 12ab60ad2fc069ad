"""Refusals of the API that tell what is missing, and what a program can do about it."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from live_console import API

from station.archive import tables
from station.archive.phrases import untranslated
from station.console.api.console import Console
from station.console.api.problems import install
from station.console.app import create_app
from station.core.config_file import load_config
from station.core.files import read_bounded_json, write_json
from station.messaging.asking import RefusedError

_RESULT = "20261121T100000Z-0001"
_TABLE = {"format": "booth-measurements", "version": 1, "pose": "as-scanned", "measurements": []}


@pytest.fixture
def parts(option: list[str]) -> Iterator[Console]:
    """A console whose station does not run."""
    path = Path(option[1])
    console = Console(load_config(path), path, logging.getLogger())
    yield console
    console.vault.close()
    console.audit.close()


def _ask(console: Console, method: str, path: str, token: str = "") -> httpx.Response:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    return _answer(create_app(console), method, f"http://127.0.0.1{API}{path}", headers)


def _answer(
    app: FastAPI, method: str, url: str, headers: dict[str, str] | None = None
) -> httpx.Response:
    async def answer() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app)) as client:
            return await client.request(method, url, headers=headers)

    return asyncio.run(answer())


@pytest.mark.parametrize("torn", [None, '{"status": "o', "[]", '{"status": []}'])
def test_nothing_is_told_of_a_result_whose_verdict_is_lost(
    parts: Console, torn: str | None
) -> None:
    """Its files were refused, and its table, sheet and archive were not."""
    folder = parts.spool.path("outbox", _RESULT)
    for name in ("measurements.json", "measurements-standard.json"):
        write_json(folder / name, _TABLE)
    assert _ask(parts, "GET", f"/scans/{_RESULT}/measurements.csv").status_code == 200
    result = folder / "result.json"
    result.unlink() if torn is None else result.write_text(torn)
    for what in (
        "measurements", "measurements.csv", "individual.smis", "sheet.pdf", "result.zip", "files",
        "files/measurements.json", "quality", "comparison/20261123T100000Z-0003",
        "comparison/20261123T100000Z-0003/distances",
    ):  # fmt: skip
        refused = _ask(parts, "GET", f"/scans/{_RESULT}/{what}")
        assert refused.status_code == 409, what
        assert refused.json()["detail"] == f"the result of {_RESULT} is damaged; scan again"


def test_a_disk_that_refuses_is_not_said_to_have_damaged_a_result(
    parts: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table was "missing", and a new scan was asked for."""
    write_json(parts.spool.path("outbox", _RESULT) / "measurements.json", _TABLE)
    for what, name in (("files", "result.json"), ("measurements.csv", "measurements.json")):

        def refused(path: Path, most: int, name: str = name) -> Any:
            if path.name == name:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return read_bounded_json(path, most)

        monkeypatch.setattr(tables, "read_bounded_json", refused)
        told = _ask(parts, "GET", f"/scans/{_RESULT}/{what}").json()["detail"]
        words = f"{name} of {_RESULT} cannot be read (Input/output error)"
        assert told == f"{words}; check the spool's disk"
        assert untranslated(told) == []


def test_a_result_that_is_taken_away_at_this_moment_is_not_damaged(
    parts: Console, monkeypatch: pytest.MonkeyPatch
) -> None:

    def taken(path: Path, most: int) -> Any:
        shutil.rmtree(path.parent)
        return read_bounded_json(path, most)

    monkeypatch.setattr(tables, "read_bounded_json", taken)
    answer = _ask(parts, "GET", f"/scans/{_RESULT}/measurements.csv")
    assert (answer.status_code, answer.json()["type"]) == (404, "/problems/gone")


@pytest.mark.parametrize("method", ["GET", "DELETE"])
def test_what_is_missing_is_told_by_its_name(parts: Console, method: str) -> None:
    """The spool's place on the disk was told to programs."""
    missing = "20261130T100000Z-7f3a"
    answer = _ask(parts, method, f"/scans/{missing}")
    told = answer.json()["detail"]
    assert answer.status_code == 404
    assert told.partition("; ")[0] == f"there is no scan {missing}"
    assert str(parts.spool.folder) not in told
    assert untranslated(told) == []


def test_a_mesh_that_is_none_is_told_by_its_name(parts: Console) -> None:
    other = "20261123T100000Z-0003"
    for one in (_RESULT, other):
        (parts.spool.path("outbox", one) / "mesh.ply").write_text("ply")
    answer = _ask(parts, "GET", f"/scans/{_RESULT}/comparison/{other}")
    assert answer.status_code == 409
    assert answer.json()["detail"].startswith(f"mesh.ply of {_RESULT} is not a mesh")


def test_a_refusal_names_requests_that_do_what_its_commands_do() -> None:
    """Programs were told to run commands."""
    app = FastAPI()
    install(app)
    words = "scan a can no longer be cancelled (its state is delivered)"

    @app.get("/")
    def refuse() -> None:
        raise RefusedError(f"{words}; delete it with: station purge a; see station list")

    told = _answer(app, "GET", "http://127.0.0.1/").json()["detail"]
    assert told == f"{words}; delete it with: DELETE /api/v1/scans/a; see GET /api/v1/scans"
    assert untranslated(told) == []
