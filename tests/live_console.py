"""A real station on recordings, its console, and the clients of a test."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from running_station import Station

from station.console.security.vault import SCOPES, Scope, Vault
from station.core.config_file import load_config

PASSWORD = "correct horse battery"
API = "/api/v1"
_TRIES = 50
_PATIENCE_S = 600.0
"""With a machine that does much else."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def problem_status(answer: httpx.Response) -> int:
    """Status of an answer that has to be a problem document."""
    assert answer.headers["content-type"].startswith("application/problem+json"), answer.text
    return answer.status_code


def problem_of(answer: httpx.Response, status: int, kind: str) -> dict[str, Any]:
    """The problem document that an answer has to be."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["status"] == status
    assert problem["type"] == f"/problems/{kind}"
    assert problem["detail"]
    return problem


class LiveConsole:
    """A station with a console, a password and tokens of every scope.

    Calibrations replay the recordings of a whole procedure, or none but an empty booth's.
    """

    def __init__(self, booth: Path, folder: Path, procedure: Path | None = None) -> None:
        self.port = free_port()
        recordings = procedure or folder / "recordings"
        if procedure is None:
            recordings.mkdir()
            # Whoever stands still is as good as an empty booth for looking at it.
            os.symlink(booth, recordings / "empty")
        text = (booth / "booth.toml").read_text().replace('recording = "', f'recording = "{booth}/')
        text = text.replace("freenect", "recorded")
        (folder / "booth.toml").write_text(
            f'name = "Shop 1"\ncalibration = "{booth}/calibration.json"\n{text}\n'
            f'[console]\nport = {self.port}\nrecordings = "{recordings}"\n'
        )
        self.config = load_config(folder / "booth.toml")
        vault = Vault(self.config.console.folder)
        vault.set_password(PASSWORD)
        self.tokens = {scope: vault.make_token(scope, self._below(scope), 1.0) for scope in SCOPES}
        vault.close()
        self.station = Station(folder / "booth.toml")
        self.url = f"http://127.0.0.1:{self.port}"
        self._sensors = False
        self.station.wait_until(self.answers, "the console answers")

    @staticmethod
    def _below(scope: Scope) -> tuple[Scope, ...]:
        return SCOPES[: SCOPES.index(scope) + 1]

    def answers(self) -> bool:
        try:
            return httpx.get(f"{self.url}{API}/session").status_code == 200
        except httpx.HTTPError:
            return False

    def client(self, scope: Scope = "manage") -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.tokens[scope]}"}
        return httpx.Client(base_url=self.url + API, headers=headers, timeout=60.0)

    def anonymous(self) -> httpx.Client:
        return httpx.Client(base_url=self.url + API, timeout=60.0)

    def start_sensors(self) -> None:
        with self.client() as client:
            client.post("/booth/start").raise_for_status()
            self._wait_for(client, "streaming")

    def _wait_for(self, client: httpx.Client, state: str) -> None:
        self.station.wait_until(
            lambda: all(
                camera["state"] == state for camera in client.get("/booth").json()["cameras"]
            ),
            f"every camera is {state}",
        )

    @contextmanager
    def sensors(self) -> Iterator[None]:
        """Sensors that run for as long as they are needed: four of them keep half a core busy."""
        if self._sensors:
            yield
            return
        self.start_sensors()
        self._sensors = True
        try:
            yield
        finally:
            self._sensors = False
            with self.client() as client:
                client.post("/booth/stop").raise_for_status()
                self._wait_for(client, "off")

    def scan(self, label: str) -> dict[str, Any]:
        """Take a scan and wait for its result; again while a busy machine's cameras are late."""
        with self.sensors(), self.client("scan") as client:
            for _ in range(_TRIES):
                answer = client.post("/scans", json={"label": label})
                assert answer.status_code == 202, answer.text
                found = self.wait_for(answer.json()["scan_id"])
                if found["state"] != "failed":
                    break
                time.sleep(0.2)
            return found

    def wait_for(self, scan_id: str) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def done() -> bool:
            with self.client("read") as client:
                found.update(client.get(f"/scans/{scan_id}").json())
            return found["state"] in ("delivered", "rescan", "failed")

        self.station.wait_until(done, f"scan {scan_id} ends", _PATIENCE_S)
        return found

    def close(self) -> None:
        self.station.close()
