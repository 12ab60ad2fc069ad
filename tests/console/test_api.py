"""The API against a real station: scans, results, ranges, events, what a program relies on."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from live_console import API, LiveConsole, problem_of

from station.archive.surfaces import read_mesh
from station.console.security.vault import Vault
from station.core.rig import Rig
from station.handover.ledger import Ledger, Waiting

README = Path(__file__).parents[2] / "README.md"


def test_a_scan_carries_its_order_to_every_export(
    console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    scan = scans[0]
    assert (scan["label"], scan["booth"]) == ("Order 1234", "Shop 1")
    assert scan["may_leave"]
    assert scan["seconds"]["total"] > 0
    path = f"/scans/{scan['scan_id']}"
    with console.client("read") as client:
        table = client.get(f"{path}/measurements", params={"unit": "in"}).json()
        assert (table["label"], table["unit"]) == ("Order 1234", "in")
        metres = client.get(f"{path}/measurements", params={"unit": "m"}).json()
        for inches, row in zip(table["rows"], metres["rows"], strict=True):
            if row["value"] is not None:
                assert inches["value"] == pytest.approx(row["value"] / 0.0254, abs=0.01)
        standard = client.get(f"{path}/measurements", params={"pose": "standard"}).json()
        assert standard["pose"] == "standard"
        assert "Order 1234" in client.get(f"{path}/measurements.csv").text
        assert "Order 1234" in client.get(f"{path}/individual.smis").text
        archive = zipfile.ZipFile(io.BytesIO(client.get(f"{path}/result.zip").content))
        names = {Path(name).name for name in archive.namelist()}
        assert {"mesh.glb", "measurements.csv", "individual.smis", "sheet.pdf"} <= names
        assert client.get(f"{path}/sheet.pdf").content.startswith(b"%PDF-")
        quality = client.get(f"{path}/quality").json()
        assert {part["name"] for part in quality["parts"]} >= {"chest", "forearm_left"}


def test_files_have_ranges_and_tags(console: LiveConsole, scans: list[dict[str, Any]]) -> None:
    path = f"/scans/{scans[0]['scan_id']}/files"
    with console.client("read") as client:
        listed = {file["name"]: file for file in client.get(path).json()}
        whole = client.get(f"{path}/mesh.ply")
        assert hashlib.sha256(whole.content).hexdigest() == listed["mesh.ply"]["sha256"]
        part = client.get(f"{path}/mesh.ply", headers={"Range": "bytes=100-199"})
        assert part.status_code == 206
        assert part.content == whole.content[100:200]
        beyond = client.get(f"{path}/mesh.ply", headers={"Range": "bytes=999999999-"})
        assert beyond.status_code == 416
        tag = whole.headers["etag"]
        same = client.get(f"{path}/mesh.ply", headers={"If-None-Match": tag})
        assert (same.status_code, same.content) == (304, b"")


def test_the_pages_files_are_packed_and_tagged(console: LiveConsole) -> None:
    with httpx.Client(base_url=console.url) as client:
        plain = client.get("/static/js/app.js", headers={"Accept-Encoding": "identity"})
        assert "content-encoding" not in plain.headers
        packed = client.get("/static/js/app.js")
        assert packed.headers["content-encoding"] == "gzip"
        assert packed.content == plain.content
        assert packed.headers["content-type"].startswith("text/javascript")
        tag = packed.headers["etag"]
        same = client.get("/static/js/app.js", headers={"If-None-Match": tag})
        assert (same.status_code, same.content) == (304, b"")
        assert "content-security-policy" in client.get("/").headers
        assert client.head("/static/icon.svg").status_code == 200
        assert client.post("/static/icon.svg").status_code == 405
        for path in ("/static/", "/static/js", "/static/../app.py", "/static/%2e%2e/app.py"):
            assert client.get(path).status_code == 404, path


def test_the_same_key_never_scans_twice(console: LiveConsole, scans: list[dict[str, Any]]) -> None:
    with console.sensors(), console.client("scan") as client:
        first = client.post(
            "/scans", json={"label": "twice"}, headers={"Idempotency-Key": "k-1"}
        ).json()
        again = client.post(
            "/scans", json={"label": "twice"}, headers={"Idempotency-Key": "k-1"}
        ).json()
        assert again["scan_id"] == first["scan_id"]
        done = console.wait_for(first["scan_id"])
        after = client.post(
            "/scans", json={"label": "twice"}, headers={"Idempotency-Key": "k-1"}
        ).json()
        assert (after["scan_id"], after["state"]) == (done["scan_id"], done["state"])
        found = client.get("/scans", params={"label": "twice"}).json()["scans"]
        assert len(found) == 1
        reused = client.post("/scans", json={"label": "other"}, headers={"Idempotency-Key": "k-1"})
        problem_of(reused, 422, "idempotency-key-reused")
    assert scans


def test_a_target_that_is_no_longer_configured_waits_for_nothing(console: LiveConsole) -> None:
    """The page told of its failures for ever."""
    ledger = Ledger(console.config.spool.folder)
    ledger.keep(Waiting("gone", "scan-1", error="answers 500"))
    try:
        assert [one.target for one in ledger.waiting()] == ["gone"]
        with console.client("read") as client:
            assert client.get("/booth").json()["waiting_deliveries"] == []
    finally:
        shutil.rmtree(console.config.spool.folder / "handover" / "gone", ignore_errors=True)


def test_a_countdown_can_be_cancelled(console: LiveConsole) -> None:
    with console.sensors(), console.client("scan") as client:
        scan = client.post("/scans", json={"label": "gone", "countdown_s": 20}).json()
        assert scan["state"] == "countdown"
        assert not scan["may_leave"]
        busy = client.post("/scans", json={"label": "next", "countdown_s": 1})
        assert "another scan" in problem_of(busy, 409, "refused")["detail"]
        gone = client.post(f"/scans/{scan['scan_id']}/cancel").json()
        assert (gone["state"], gone["reasons"]) == ("failed", ["cancelled by the operator"])


def test_a_token_that_only_scans_follows_its_scan(console: LiveConsole) -> None:
    """It could, and nothing said so; and it was told of all results that wait to be handed over."""
    vault = Vault(console.config.console.folder)
    kiosk, other = (vault.make_token(name, ["scan"], 1.0) for name in ("kiosk", "other"))
    vault.close()
    order: dict[str, Any] = {"json": {"label": "kiosk", "countdown_s": 20}}
    headers = {"Idempotency-Key": "mine", "Authorization": f"Bearer {kiosk}"}
    with console.sensors(), console.anonymous() as client:
        first = client.post("/scans", **order, headers=headers).json()
        try:
            assert client.post("/scans", **order, headers=headers).json() == first
            asked = client.get(f"/scans/{first['scan_id']}", headers=headers)
            assert "needs the scope read" in problem_of(asked, 403, "not-allowed")["detail"]
            problem_of(client.post("/booth/hand-over", headers=headers), 403, "not-allowed")
            # Another one's key is another key.
            theirs = {**headers, "Authorization": f"Bearer {other}"}
            problem_of(client.post("/scans", **order, headers=theirs), 409, "refused")
        finally:
            client.post(f"/scans/{first['scan_id']}/cancel", headers=headers)
        gone = client.post("/scans", **order, headers=headers).json()
        assert (gone["scan_id"], gone["state"]) == (first["scan_id"], "failed")


def test_search_and_delete(console: LiveConsole, scans: list[dict[str, Any]]) -> None:
    assert scans
    done = console.scan("to be deleted")
    with console.client() as client:
        found = client.get("/scans", params={"text": "BE DEL"}).json()["scans"]
        assert [scan["scan_id"] for scan in found] == [done["scan_id"]]
        ledger = Ledger(console.config.spool.folder)
        ledger.finish(Waiting("shop", done["scan_id"]))
        assert client.get(f"/scans/{done['scan_id']}").json()["handed_over"] == ["shop"]
        told = client.delete(f"/scans/{done['scan_id']}").json()
        assert told == {"scans": [done["scan_id"]], "handed_over": ["shop"]}
        assert ledger.receivers(done["scan_id"]) == []
        problem_of(client.get(f"/scans/{done['scan_id']}"), 404, "no-such-scan")
        problem_of(client.delete("/scans", params={"label": "nobody"}), 404, "no-such-scan")
    log = (console.config.console.folder / "audit.log").read_text()
    entries = [json.loads(line) for line in log.splitlines()]
    deleted = [e for e in entries if e["what"] == "delete" and e["scan"] == done["scan_id"]]
    assert [entry["who"] for entry in deleted] == ["manage"]
    # Who did what to which scan, and nothing of whose it was or what was measured.
    assert "to be deleted" not in log
    assert "Order" not in log


def test_two_scans_are_compared(console: LiveConsole, scans: list[dict[str, Any]]) -> None:
    one, other = (scan["scan_id"] for scan in scans)
    with console.client("read") as client:
        found = client.get(f"/scans/{one}/comparison/{other}").json()
        waist = next(row for row in found["rows"] if row["name"] == "waist_girth")
        assert waist["difference"] == pytest.approx(waist["second"] - waist["first"], abs=0.11)
        assert found["surface_rms_m"] < 0.005
        signed = np.frombuffer(
            client.get(f"/scans/{one}/comparison/{other}/distances").content, "<f4"
        )
        mesh = console.config.spool.folder / "outbox" / one / "mesh.ply"
        assert len(signed) == len(read_mesh(mesh).vertices)
        assert np.sqrt(np.mean(signed**2)) == pytest.approx(found["surface_rms_m"], rel=1e-3)
        problem_of(client.get(f"/scans/{one}/comparison/nobody"), 404, "no-such-scan")


def test_events_are_resumed_where_they_stopped(
    console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    assert scans
    with console.client("read") as client:
        early = {"Last-Event-ID": "other-1", "follow": "x"}
        lost = client.get("/events", params={"follow": "false"}, headers=early).text
        assert "event: reset" in lost
        start = re.findall(r"^id: (\w+)-\d+$", lost, re.MULTILINE)[0]
        text = client.get(
            "/events", params={"follow": "false"}, headers={"Last-Event-ID": f"{start}-0"}
        ).text
        numbers = [int(n) for n in re.findall(rf"^id: {start}-(\d+)$", text, re.MULTILINE)]
        assert numbers == list(range(1, len(numbers) + 1))
        kinds = set(re.findall(r"^event: (\w+)$", text, re.MULTILINE))
        assert {"camera", "framesets", "scan", "result"} <= kinds
        half = numbers[len(numbers) // 2]
        rest = client.get(
            "/events", params={"follow": "false"}, headers={"Last-Event-ID": f"{start}-{half}"}
        ).text
        assert re.findall(rf"^id: {start}-(\d+)$", rest, re.MULTILINE)[0] == str(half + 1)


def test_errors_say_what_the_commands_say(console: LiveConsole) -> None:
    with console.client() as client:
        problem_of(client.get("/scans/unknown-1"), 404, "no-such-scan")
        problem_of(client.get("/nothing"), 404, "not-found")
        problem_of(client.post("/scans", json={"labl": "x"}), 422, "invalid")
        problem_of(client.post("/scans", content=b"{"), 422, "invalid")
        problem_of(client.post("/task/answer", json={"answer": "go"}), 409, "refused")
        problem_of(client.put("/scans", json={}), 405, "method-not-allowed")
        problem_of(client.post("/calibrations/none/use"), 404, "no-such-calibration")


def test_a_calibration_of_other_cameras_is_not_put_into_use(console: LiveConsole) -> None:
    rig = Rig.load(console.config.calibration)
    fewer = dict(list(rig.cameras.items())[:2])
    entry = console.config.calibrate.folder / "20260101T000000Z"
    entry.mkdir(parents=True)
    Rig("2026-01-01T00:00:00Z", rig.reference, fewer, 0.0).save(entry / "calibration.json")
    before = console.config.calibration.read_bytes()
    try:
        with console.client() as client:
            problem = problem_of(
                client.post(f"/calibrations/{entry.name}/use"), 409, "not-possible"
            )
    finally:
        # Other tests share the booth, which has no stored calibration.
        shutil.rmtree(entry)
    missing = "cameras back-lower, back-upper are in booth.toml and were not calibrated"
    assert missing in problem["detail"]
    assert console.config.calibration.read_bytes() == before


def test_a_killed_camera_is_told_with_its_remedy(console: LiveConsole) -> None:
    def dead() -> bool:
        with console.client("read") as client:
            cameras = {c["name"]: c for c in client.get("/booth").json()["cameras"]}
        return cameras["back-upper"]["state"] == "dead" and bool(cameras["back-upper"]["detail"])

    with console.sensors():
        pid = console.station.pids("capture", "back-upper")[0]
        os.kill(pid, signal.SIGSTOP)
        try:
            console.station.wait_until(dead, "the stopped camera is told", 20.0)
        finally:
            os.kill(pid, signal.SIGCONT)
        # Later tests want it back.
        console.start_sensors()


def test_the_openapi_document_is_there_without_a_login(console: LiveConsole) -> None:
    with console.anonymous() as client:
        document = client.get("/openapi.json").json()
        assert f"{API}/scans/{{scan_id}}" in document["paths"]
        for methods in document["paths"].values():
            for operation in methods.values():
                assert "application/problem+json" in operation["responses"]["401"]["content"]
        page = client.get("/docs")
        assert page.status_code == 200
        assert "http" not in re.sub(r"http-equiv", "", page.text)


def test_the_readme_client_works(console: LiveConsole, tmp_path: Path) -> None:
    """The program that the README shows, run as it stands there, with the token it shows."""
    text = README.read_text()
    command = re.search(r"station token make orders((?:\s+--scope \w+)+)", text)
    program = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert command is not None
    assert program is not None
    assert set(re.findall(r"--scope (\w+)", command[1])) == {"read", "scan"}
    assert len(program[1].splitlines()) <= 40
    path = tmp_path / "client.py"
    path.write_text(program[1])
    with console.sensors():
        done, refused = (
            subprocess.run(
                [sys.executable, str(path), console.url, console.tokens[scope], "Order 99"],
                capture_output=True, text=True, timeout=120, check=False,
            )
            for scope in ("scan", "read")
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "waist_girth" in done.stdout
    # A refusal was a traceback with "409 Conflict", and its reason was not read.
    assert refused.returncode == 1
    assert "scope" in refused.stderr
    assert refused.stderr.count("\n") == 1
