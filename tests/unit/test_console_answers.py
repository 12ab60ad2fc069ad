"""Answers of the console where the disk refuses, or what was asked for cannot be had."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI

from station.console.api import booth
from station.console.api.problems import ProblemError, install
from station.simulation.scene import default_rig


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (FileNotFoundError(2, "No such file or directory", "/spool/outbox/a"), 404, "moved away"),
        (
            OSError(28, "No space left on device", "/spool/x"),
            503,
            "No space left on device: /spool",
        ),
        (PermissionError(13, "Permission denied", "/spool/x"), 503, "see GET /api/v1/booth"),
    ],
)
def test_an_error_of_the_disk_is_a_problem_document(
    error: OSError, status: int, words: str
) -> None:
    """A result that was collected while it was read was a server error, in plain text."""
    app = FastAPI()
    install(app)

    @app.get("/")
    def refuse() -> None:
        raise error

    async def asked() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://booth") as client:
            return await client.get("/")

    answer = asyncio.run(asked())
    assert answer.status_code == answer.json()["status"] == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert words in answer.json()["detail"]


def test_calibrations_without_a_common_reference_are_not_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It was a server error."""
    rig = default_rig()
    others = {name: camera for name, camera in rig.cameras.items() if name != rig.reference}
    rigs = {"old": rig, "new": replace(rig, reference=next(iter(others)), cameras=others)}
    monkeypatch.setattr(booth, "_known", lambda _, name: SimpleNamespace(rig=rigs[name]))
    nobody: Any = None
    with pytest.raises(ProblemError, match=f"new has no camera {rig.reference}"):
        booth.compare("old", "new", nobody, nobody)
    shifts = booth.compare("new", "old", nobody, nobody)
    assert [shift.camera for shift in shifts] == sorted(others)
    assert max(shift.shift_mm for shift in shifts) == 0.0
