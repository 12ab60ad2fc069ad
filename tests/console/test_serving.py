"""Console's process: its port, its end, and whom it may serve."""

from __future__ import annotations

import logging
import signal
import socket
import ssl
import subprocess
import threading
from pathlib import Path
from types import SimpleNamespace

import httpx
import psutil
import pytest
from click.testing import CliRunner
from cryptography import x509
from ctrl_c import heard
from live_console import API, free_port
from running_station import STATION
from waiting import wait_until
from websockets.sync.client import connect
from websockets.typing import Origin

from station.cli import station
from station.console.api.console import Console
from station.console.security.certificate import make_certificate, reached_by
from station.console.server import _awaited_listener, check_exposure
from station.core.config import ConsoleConfig
from station.core.config_file import load_config
from station.core.errors import ConfigError
from station.core.service import read_health


def test_a_console_whose_port_is_taken_says_so_and_waits(tmp_path: Path) -> None:
    """It ended again and again, and status did not say why."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        path = tmp_path / "booth.toml"
        path.write_text(
            '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
            f"[console]\nport = {port}\n"
        )
        console = Console(load_config(path), path, logging.getLogger())
        stop = threading.Event()
        got: list[socket.socket | None] = []
        waiting = threading.Thread(
            target=lambda: got.append(_awaited_listener(console, console.log, stop))
        )
        waiting.start()
        runtime = console.config.runtime.folder
        wait_until(lambda: read_health(runtime, "console"), "the console's report")
        told = read_health(runtime, "console")
        assert told["problems"][0].startswith(f"the console cannot listen at 127.0.0.1:{port} (")
    waiting.join(60.0)
    [listener] = got
    assert listener is not None
    listener.close()
    stop.set()
    assert _awaited_listener(console, console.log, stop) is None
    console.vault.close()
    console.audit.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_console_that_is_watched_ends_quietly(tmp_path: Path, number: signal.Signals) -> None:
    """A page that was open was cut off, with a traceback."""
    path, port = tmp_path / "booth.toml", free_port()
    path.write_text(
        f'[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n[console]\nport = {port}\n'
    )
    command = [*STATION, "console", "--config", str(path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heard) as console:
        assert console.stderr is not None
        while "the console is at" not in console.stderr.readline():
            assert console.poll() is None
        place = f"127.0.0.1:{port}{API}"
        with (
            connect(
                f"ws://{place}/pictures", origin=Origin(f"http://127.0.0.1:{port}")
            ) as pictures,
            httpx.stream("GET", f"http://{place}/events", timeout=60.0) as events,
        ):
            pictures.send("next")
            parts = events.iter_raw()
            assert next(parts).startswith(b"retry")
            console.send_signal(number)
            rest = console.stderr.read()
            assert console.wait(60.0) == 0
    assert rest == ""


def test_beyond_this_machine_password_and_certificate_are_needed(tmp_path: Path) -> None:
    assert not check_exposure(ConsoleConfig(folder=tmp_path), has_password=False)
    open_to_all = ConsoleConfig(folder=tmp_path, host="0.0.0.0")
    with pytest.raises(ConfigError, match="--set-password"):
        check_exposure(open_to_all, has_password=False)
    with pytest.raises(ConfigError, match="--make-certificate"):
        check_exposure(open_to_all, has_password=True)
    path = make_certificate(tmp_path, reached_by(["booth.shop.example", "192.168.1.9"]))
    assert check_exposure(open_to_all, has_password=True)
    assert ((tmp_path / "key.pem").stat().st_mode & 0o077) == 0
    ssl.create_default_context(cafile=str(path))


def test_a_certificate_names_the_addresses_at_which_the_machine_is_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a console open to all was for 0.0.0.0, and a browser refused the machine's address
    also where the certificate was trusted."""
    inet, inet6, packet = socket.AF_INET, socket.AF_INET6, socket.AF_PACKET
    found = {
        "lo": [(inet, "127.0.0.1"), (inet6, "::1")],
        "eth0": [(inet, "192.168.1.9"), (inet6, "fd00::9"), (inet6, "fe80::9%eth0"),
                 (packet, "02:fc:00:00:00:01")],
    }  # fmt: skip
    links = {
        name: [SimpleNamespace(family=family, address=address) for family, address in own]
        for name, own in found.items()
    }
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: links)
    config = tmp_path / "booth.toml"
    config.write_text(
        '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
        '[console]\nhost = "0.0.0.0"\nnames = ["booth.shop.example", "kabine-süd.example"]\n'
    )
    done = CliRunner().invoke(station, ["console", "--make-certificate", "--config", str(config)])
    assert "192.168.1.9, fd00::9: make it again when an address changes" in done.output
    made = x509.load_pem_x509_certificate((tmp_path / "console/certificate.pem").read_bytes())
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    addresses = names.get_values_for_type(x509.IPAddress)
    assert sorted(map(str, addresses)) == ["127.0.0.1", "192.168.1.9", "::1", "fd00::9"]
    hosts = names.get_values_for_type(x509.DNSName)
    assert {"booth.shop.example", "xn--kabine-sd-x9a.example"} <= set(hosts)
