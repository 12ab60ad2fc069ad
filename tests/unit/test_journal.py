"""Log lines as systemd's journal takes them, on a socket in its place."""

from __future__ import annotations

import io
import logging
import os
import socket
import struct
from pathlib import Path

import pytest

from station.core.service import JournalHandler, is_read_by_journal


def _read(datagram: bytes) -> dict[str, str]:
    """Fields of one entry in systemd's binary form (systemd.io/JOURNAL_NATIVE_PROTOCOL)."""
    stream, fields = io.BytesIO(datagram), {}
    while name := stream.readline():
        (length,) = struct.unpack("<Q", stream.read(8))
        fields[name.decode().rstrip("\n")] = stream.read(length).decode()
        assert stream.read(1) == b"\n"
    return fields


def _logger(address: Path) -> logging.Logger:
    log = logging.Logger("test")
    log.addHandler(JournalHandler("capture front-lower", str(address)))
    return log


def test_a_line_about_a_scan_carries_its_id(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(str(tmp_path / "journal"))
        log = _logger(tmp_path / "journal")
        log.warning("scan %s\nis put back", "order-1", extra={"scan": "order-1"})
        log.info("streaming")
        assert _read(journal.recv(1 << 16)) == {
            "MESSAGE": "scan order-1\nis put back",
            "PRIORITY": "4",
            "SYSLOG_IDENTIFIER": "capture-front-lower",
            "SCAN": "order-1",
        }
        assert "SCAN" not in _read(journal.recv(1 << 16))


def test_what_the_journal_does_not_take_goes_to_stderr(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _logger(tmp_path / "nobody").error("the disk is full")
    assert "the disk is full" in capsys.readouterr().err


def test_the_journal_is_known_by_the_stream_that_it_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "stream").open("w") as stream:
        found = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino}")
        assert is_read_by_journal(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{found.st_dev}:{found.st_ino + 1}")
        assert not is_read_by_journal(stream.fileno())
