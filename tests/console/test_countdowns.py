"""Scans in the console's countdown, as the API and commands know of them."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from click.testing import CliRunner
from live_console import LiveConsole, problem_of

from station.archive.phrases import untranslated
from station.booth.deletion import purge
from station.booth.operator.sensors_cli import cancel
from station.messaging.asking import command
from station.messaging.countdowns import (
    begin_countdown,
    cancel_countdown,
    counting_down,
    end_countdown,
)
from station.messaging.messages import Request


def test_a_scan_in_its_countdown_is_not_said_to_be_missing(console: LiveConsole) -> None:
    """Whoever deleted it was told that there was no such scan, and then it was taken."""
    with console.sensors(), console.client() as client:
        scan = client.post("/scans", json={"label": "Order\u3000 8", "countdown_s": 20}).json()
        try:
            for path in (f"/scans/{scan['scan_id']}", "/scans?label=Order 8"):
                told = problem_of(client.delete(path), 409, "not-possible")
                assert "is being taken; try again when it is done" in told["detail"]
            problem_of(client.delete("/scans?label=Order"), 404, "no-such-scan")
        finally:
            client.post(f"/scans/{scan['scan_id']}/cancel")
        problem_of(client.delete("/scans?label=Order 8"), 404, "no-such-scan")


def test_commands_know_a_scan_in_its_countdown(console: LiveConsole) -> None:
    """They said that there was no such scan, and it was taken seconds later."""
    option = ["--config", str(console.station.config)]
    with console.sensors(), console.client() as client:
        scan = client.post("/scans", json={"label": "Order 9", "countdown_s": 20}).json()
        scan_id = scan["scan_id"]
        for words in ([scan_id], ["--label", "Order\u3000 9"]):
            told = str(CliRunner().invoke(purge, [*words, *option]).exception)
            assert told == f"scan {scan_id} is being taken; try again when it is done"
        assert "no scan with the label" in str(
            CliRunner().invoke(purge, ["--label", "Order", *option]).exception
        )
        # At the same moment as on the page, too.
        for _ in range(2):
            done = CliRunner().invoke(cancel, [scan_id, *option])
            assert done.output == f"scan {scan_id}: cancelled by the operator\n", done.exception
        found = console.wait_for(scan_id)
        assert (found["state"], found["reasons"]) == ("failed", ["cancelled by the operator"])
        assert "there is no scan" in str(CliRunner().invoke(purge, [scan_id, *option]).exception)
    assert counting_down(console.config.runtime.folder) == {}


def test_a_cancel_is_carried_out_though_the_order_is_on_its_way(console: LiveConsole) -> None:
    """Control, if it was late, said that there was no such scan, and then took it."""
    [control] = console.station.pids("control")
    with console.sensors(), console.client() as client, ThreadPoolExecutor() as pool:
        scan = client.post("/scans", json={"label": "late", "countdown_s": 1}).json()
        os.kill(control, signal.SIGSTOP)
        try:
            request = Request("cancel", scan["scan_id"])
            answer = pool.submit(command, console.config, request)
            time.sleep(1.5)
        finally:
            os.kill(control, signal.SIGCONT)
        assert answer.result()["reason"] == "cancelled by the operator"
        found = console.wait_for(scan["scan_id"])
        assert (found["state"], found["reasons"]) == ("failed", ["cancelled by the operator"])


def test_a_countdown_ends_though_its_disk_refuses(console: LiveConsole) -> None:
    """A cancel was refused, and the reason was an error's own words."""
    folder, aside = (console.config.runtime.folder / name for name in ("countdown", "aside"))
    key = {"Idempotency-Key": "refused by the disk"}
    with console.sensors(), console.client() as client:
        for seconds in (20, 2):
            scan = client.post("/scans", json={"label": "a", "countdown_s": seconds}).json()
            folder.rename(aside)
            folder.touch()
            try:
                if seconds > 2:
                    cancelled = client.post(f"/scans/{scan['scan_id']}/cancel").json()
                    assert cancelled["reasons"] == ["cancelled by the operator"]
                    continue
                [reason] = console.wait_for(scan["scan_id"])["reasons"]
                assert reason.startswith("the disk cannot be written (Not a directory: ")
                assert untranslated(reason) == ["Not a directory"]
                order = {"label": "b", "countdown_s": 20}
                problem_of(client.post("/scans", json=order, headers=key), 503, "disk")
            finally:
                folder.unlink()
                aside.rename(folder)
        # Nothing was begun, and the key may be another request's.
        scan = client.post("/scans", json={**order, "label": "c"}, headers=key).json()
        assert list(counting_down(console.config.runtime.folder).values()) == ["c"]
        client.post(f"/scans/{scan['scan_id']}/cancel").raise_for_status()


def test_a_countdown_whose_console_ended_is_over(tmp_path: Path) -> None:
    begin_countdown(tmp_path, "one", "Order 1", time.monotonic() - 60.0)
    assert counting_down(tmp_path) == {}
    begin_countdown(tmp_path, "two", "Order 2", time.monotonic() + 60.0)
    assert counting_down(tmp_path) == {"two": "Order 2"}
    assert end_countdown(tmp_path, "one")
    assert not cancel_countdown(tmp_path, "one")
    assert cancel_countdown(tmp_path, "two")
    assert cancel_countdown(tmp_path, "two")
    assert not end_countdown(tmp_path, "two")
    assert counting_down(tmp_path) == {}
    begin_countdown(tmp_path, "two", "Order 2", time.monotonic() + 60.0)
    assert end_countdown(tmp_path, "two")
    assert not cancel_countdown(tmp_path, "two")
