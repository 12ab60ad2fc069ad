import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest
import zmq
from waiting import wait_until

from station.console.security.audit import AuditLog
from station.core import files
from station.core.errors import BundleError, FormatError
from station.messaging.transport import endpoint, server


def test_json_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    files.write_json(path, {"format": "x", "version": 2, "name": "Zoë"})
    assert files.read_json(path, format="x", versions={1, 2})["name"] == "Zoë"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_time_stays_in_its_line() -> None:
    """A bundle of another program may say anything; its lines in `station list` broke."""
    assert files.local_time("yesterday") == "yesterday"
    assert files.local_time("a\nb\x1b[31m") == "a?b?[31m"
    assert files.local_time(1000 * "c") == 32 * "c"
    assert files.local_time("2026-11-21T10:00:00Z").startswith("2026-11-2")


def test_not_a_number_never_reaches_a_file(tmp_path: Path) -> None:
    """json.dumps writes NaN by default, which other languages' readers refuse."""
    with pytest.raises(ValueError):
        files.write_json(tmp_path / "a.json", {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "is missing"),
        ('{"format": "x", "ver', "cannot be read as JSON"),
        (f'{{"version": {"1" * 5000}}}', "has 5000 digits); restore it"),
        ("[]", "is not a x file"),
        ('{"format": "y", "version": 1}', "its format is 'y'"),
        ('{"format": "x", "version": 9}', "version 9; this program reads 1, 2"),
        ('{"format": "x", "version": true}', "version True"),
    ],
)
def test_unreadable_documents_are_named(tmp_path: Path, content: str | None, words: str) -> None:
    path = tmp_path / "a.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(BundleError) as raised:
        files.read_json(path, format="x", versions={1, 2}, error=BundleError)
    assert words in str(raised.value)
    assert str(path) in str(raised.value)
    assert issubclass(BundleError, FormatError)


def test_a_folder_is_no_document(tmp_path: Path) -> None:
    (tmp_path / "a.json").mkdir()
    with pytest.raises(
        FormatError, match=r"a\.json cannot be read as JSON \(is not a regular file"
    ):
        files.read_json(tmp_path / "a.json", format="x", versions={1})


def test_private_files_are_private_whatever_the_mask(tmp_path: Path) -> None:
    mask = os.umask(0)
    try:
        files.private_file(tmp_path / "a")
        files.write_bytes(tmp_path / "b", b"secret", private=True)
        AuditLog(tmp_path / "c").close()
        with zmq.Context() as context, server(context, tmp_path / "d", "booth"):
            socket = Path(endpoint(tmp_path / "d", "booth").removeprefix("ipc://"))
            made = [socket, *tmp_path.rglob("*")]
            modes = {path.name: path.stat().st_mode & 0o077 for path in made}
    finally:
        os.umask(mask)
    assert modes == dict.fromkeys(("booth.ipc", "a", "b", "c", "audit.log", "d"), 0)


def test_publish_never_overwrites(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    with pytest.raises(FileExistsError):
        files.publish_folder(tmp_path / "a", tmp_path / "b")


def _rewrite_for_ever(path: Path) -> None:
    generation = 0
    while True:
        generation += 1
        files.write_json(path, {"format": "x", "version": 1, "load": [generation] * 20_000})


def test_a_document_is_whole_after_kill(tmp_path: Path) -> None:
    """An in-place write torn by kill -9 once left a state file that no restart could read."""
    path = tmp_path / "state.json"
    for delay_s in (0.05, 0.11, 0.17):
        writer = multiprocessing.get_context("spawn").Process(
            target=_rewrite_for_ever, args=(path,)
        )
        writer.start()
        wait_until(path.exists, "the document")
        time.sleep(delay_s)
        assert writer.pid is not None
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        load = json.loads(path.read_text())["load"]
        assert len(load) == 20_000
        assert len(set(load)) == 1
