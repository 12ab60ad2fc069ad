"""Targets that answer nonsense, and results that are damaged: the others are handed over."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import shutil
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import URLError

import pytest
from click.testing import CliRunner
from waiting import wait_until

from station.archive.phrases import in_language
from station.archive.records import ScanRecord
from station.booth.deletion import purge_scans
from station.booth.retention import Deleted
from station.console.api.booth import hand_over
from station.core.config import DeliverConfig
from station.core.config_file import load_config
from station.core.errors import BoothError
from station.core.files import held, private_folder, read_bounded_json
from station.core.scans import ScanId, ScanNote
from station.core.service import NOTHING_RUNS
from station.core.spool import Spool
from station.handover.deliver_cli import HandOver, deliver
from station.handover.ledger import PAUSES_S, Ledger, Waiting
from station.handover.targets import HandOverError, _refusal, make_target

_CAMERA = '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
_IDS = ("20261121T100000Z-0001", "20261121T100000Z-0002")


@pytest.fixture
def no_http() -> Iterator[int]:
    """The port of a program that does not speak HTTP."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            try:
                connection, _ = server.accept()
            except OSError:
                return  # the test is over
            connection.recv(1 << 16)
            connection.sendall(b"220 mail.example ESMTP\r\n\r\n")
            connection.close()

        threading.Thread(target=answer, daemon=True).start()
        yield server.getsockname()[1]


def _result(folder: Path, **table: object) -> Path:
    folder.mkdir(parents=True)
    document = {"format": "booth-measurements", "version": 1, "pose": "as-scanned", **table}
    for name in ("measurements.json", "measurements-standard.json"):
        (folder / name).write_text(json.dumps(document))
    (folder / "result.json").write_text(json.dumps({"status": "ok", "label": "Order 1"}))
    return folder


def _scan() -> ScanRecord:
    return ScanRecord(_IDS[0], "delivered", "Order 1", "", "2026-11-21T10:00:00Z", "")


@pytest.mark.parametrize("place", ["127.0.0.1:{port}/", "127.0.0.1:eighty/", "127.0.0.1/a b"])
def test_what_is_no_webhook_is_tried_again(tmp_path: Path, no_http: int, place: str) -> None:
    """It ended the thread that hands results over, and none came any more."""
    (tmp_path / "secret").write_text("topsecret")
    url = "http://" + place.format(port=no_http)
    config = DeliverConfig(name="orders", url=url, secret_file=tmp_path / "secret")
    with pytest.raises(HandOverError, match=r"\A[^\n]*\Z"):
        make_target(config)(_scan(), _result(tmp_path / "result", measurements=[]))


@pytest.fixture
def receiver() -> Iterator[tuple[str, dict[str, str]]]:
    """A webhook's address, and the answer that it gives: a line and headers, after a pause."""
    answer = {"line": "200 OK", "pause_s": "0"}

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            time.sleep(float(answer["pause_s"]))
            with contextlib.suppress(OSError):
                self.wfile.write(f"HTTP/1.0 {answer['line']}\r\nLocation: /else\r\n\r\n".encode())

        def log_message(self, *_: object) -> None:
            """Tell nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Receiver) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/booth", answer
        server.shutdown()


@pytest.mark.parametrize(
    ("line", "pause_s", "words"),
    [
        ("500 Error", "0", r"/booth answers 500\Z"),
        ("302 Found", "0", "answers 302, a redirection, which is not followed"),
        ("200 OK", "0.5", r"has not answered within 0\.1 s"),
    ],
)
def test_a_receiver_that_does_not_accept_is_told_in_words(
    tmp_path: Path,
    receiver: tuple[str, dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    line: str,
    pause_s: str,
    words: str,
) -> None:
    """A slow one "cannot be reached", although it had the result."""
    url, answer = receiver
    answer |= {"line": line, "pause_s": pause_s}
    monkeypatch.setattr("station.handover.targets._TIMEOUT_S", 0.1 if pause_s != "0" else 10.0)
    (tmp_path / "secret").write_text("topsecret")
    config = DeliverConfig(name="orders", url=url, secret_file=tmp_path / "secret")
    with pytest.raises(HandOverError, match=words):
        make_target(config)(_scan(), _result(tmp_path / "result", measurements=[]))


def test_an_untrusted_certificate_is_named_as_such() -> None:
    cause = ssl.SSLCertVerificationError(1, "[SSL: CERTIFICATE_VERIFY_FAILED] (_ssl.c:1006)")
    cause.verify_message = "self-signed certificate"
    said = str(_refusal("https://shop.example", URLError(cause)))
    assert said == (
        "the certificate of https://shop.example is not trusted (self-signed certificate)"
    )


def test_a_share_that_cannot_be_looked_at_is_tried_again(tmp_path: Path) -> None:
    """Nothing was counted as a try, and the status told no problem. A name that is too long is
    refused as a server that is down refuses."""
    config = DeliverConfig(name="share", folder=tmp_path / (300 * "x"))
    with pytest.raises(HandOverError, match="name too long"):
        make_target(config)(_scan(), _result(tmp_path / "result", measurements=[]))


def test_a_damaged_result_keeps_no_other_back(tmp_path: Path) -> None:
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    (tmp_path / "share").mkdir()
    outbox = Spool(tmp_path / "spool").folder / "outbox"
    _result(outbox / _IDS[0])
    _result(outbox / _IDS[1], measurements=[])
    handover = HandOver(load_config(config), logging.getLogger("deliver"))
    handover.look()
    handover.try_all("share", 1e9)
    (waiting,) = Ledger(tmp_path / "spool").waiting()
    assert (waiting.scan_id, waiting.tries) == (_IDS[0], 1)
    assert "measurements" in waiting.error
    assert (tmp_path / "share" / _IDS[1] / "measurements.csv").exists()


def test_a_scan_that_is_deleted_while_it_is_handed_over_waits_for_nobody(tmp_path: Path) -> None:
    """Status told of it until the next result came."""
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    spool = Spool(tmp_path / "spool")
    for name in _IDS:
        _result(spool.folder / "outbox" / name)
    handover = HandOver(load_config(config), logging.getLogger("deliver"))

    def deleted(scan: ScanRecord, result: Path) -> None:
        purge_scans(spool, [result.name], Deleted())
        if scan.scan_id == _IDS[0]:
            raise HandOverError("it is gone")

    handover._targets["share"] = deleted
    handover.look()
    handover.try_all("share", 1e9)
    ledger = Ledger(spool.folder)
    assert ledger.waiting() == []
    assert [ledger.receivers(name) for name in _IDS] == [[], []]


def test_who_has_copies_is_known_after_a_result_was_taken_away(tmp_path: Path) -> None:
    """Deleting the scan named nobody then."""
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    (tmp_path / "share").mkdir()
    spool, scan_id = Spool(tmp_path / "spool"), ScanId(_IDS[0])
    for name in _IDS:
        _result(spool.folder / "outbox" / name, measurements=[])
    spool.notes.write(ScanNote(scan_id, "delivered"), durable=False)
    handover = HandOver(load_config(config), logging.getLogger("deliver"))
    handover.look()
    handover.try_all("share", 1e9)
    for name in _IDS:
        shutil.rmtree(spool.folder / "outbox" / name)
    handover.look()
    assert [Ledger(spool.folder).receivers(name) for name in _IDS] == [["share"], []]
    deleted = Deleted()
    purge_scans(spool, [scan_id], deleted)
    assert deleted.receivers == {"share"}


@pytest.fixture
def handover(tmp_path: Path) -> HandOver:
    """Hand-overs of one result to a folder."""
    config = tmp_path / "booth.toml"
    config.write_text(f'{_CAMERA}[[deliver]]\nname = "share"\nfolder = "share"\n')
    (tmp_path / "share").mkdir()
    spool = Spool(tmp_path / "spool")
    _result(spool.folder / "outbox" / _IDS[0], measurements=[])
    spool.notes.write(ScanNote(ScanId(_IDS[0]), "delivered"), durable=False)
    return HandOver(load_config(config), logging.getLogger("deliver"))


def test_a_result_that_is_taken_away_during_a_try_is_waited_for_no_longer(
    handover: HandOver, tmp_path: Path
) -> None:
    """Status told that it would be tried again."""

    def taken(scan: ScanRecord, result: Path) -> None:  # noqa: ARG001
        shutil.rmtree(result)
        raise HandOverError("it answers 503")

    handover._targets["share"] = taken
    handover.look()
    handover.try_all("share", 1e9)
    assert Ledger(tmp_path / "spool").waiting() == []


def test_the_pause_begins_when_a_try_has_failed(handover: HandOver, tmp_path: Path) -> None:
    """A receiver that answered after its time limit got the next try without a pause."""

    def slow(scan: ScanRecord, result: Path) -> None:  # noqa: ARG001
        time.sleep(0.2)
        raise HandOverError("it has not answered")

    handover._targets["share"] = slow
    handover.look()
    handover.try_all("share", 1e9)
    [entry] = Ledger(tmp_path / "spool").waiting()
    assert entry.next_s >= 1e9 + 0.2 + PAUSES_S[0]


def test_a_result_is_not_sent_again_and_again_while_the_disk_refuses(
    handover: HandOver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A webhook received it four times a second, and status told nothing."""
    sent, stop = list[str](), threading.Event()

    def received(scan: ScanRecord, result: Path) -> None:  # noqa: ARG001
        sent.append(scan.scan_id)

    def refused(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no inodes")

    monkeypatch.setattr(Ledger, "finish", refused)
    handover._targets["share"] = received
    handover.look()
    serving = threading.Thread(target=handover._serve, args=("share", stop))
    serving.start()
    wait_until(lambda: handover.health()["problems"], "a problem")
    time.sleep(0.6)
    stop.set()
    serving.join()
    assert sent == [_IDS[0]]
    assert "no inodes" in handover.health()["problems"][0]


def test_a_hand_over_whose_end_was_cut_short_is_not_repeated(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.finish(Waiting("share", _IDS[0]))
    ledger.keep(Waiting("share", _IDS[0]))
    assert ledger.waiting() == []


def test_no_part_of_a_copy_stays_that_was_not_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stayed for ever where the scan was deleted before the next try."""
    (tmp_path / "share").mkdir()
    target = make_target(DeliverConfig(name="share", folder=tmp_path / "share"))
    result = _result(tmp_path / "result", measurements=[])

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("station.handover.targets.fsync_file", full)
    with pytest.raises(HandOverError, match=r"cannot be written \(No space left"):
        target(_scan(), result)
    assert list((tmp_path / "share").iterdir()) == []
    (result / "mesh.obj").symlink_to("missing")
    with pytest.raises(HandOverError, match=r"\A[^\n]*written \(\[Errno 2\] No such file[^\n]*\Z"):
        target(_scan(), result)
    assert list((tmp_path / "share").iterdir()) == []


def test_a_share_that_is_back_gets_at_once_what_waits_for_it(
    handover: HandOver, tmp_path: Path
) -> None:
    """It was said for minutes that it does not exist, while it received new results."""
    ledger = Ledger(tmp_path / "spool")
    _result(tmp_path / "spool/outbox" / _IDS[1], measurements=[])
    handover.look()
    ledger.keep(Waiting("share", _IDS[1], tries=5, next_s=1e9 + 300.0, error="does not exist"))
    handover.try_all("share", 1e9)
    handover.try_all("share", 1e9)
    assert ledger.waiting() == []
    assert {path.name for path in (tmp_path / "share").iterdir()} == set(_IDS)


def test_what_failed_is_tried_at_once_if_somebody_asks_for_it(
    handover: HandOver, tmp_path: Path
) -> None:
    """Whoever had mended the share waited for up to an hour."""
    ledger = Ledger(tmp_path / "spool")
    later = Waiting("share", _IDS[0], tries=6, next_s=1e9 + 3600.0, error="does not exist")
    for entry in (later, replace(later, target="gone")):
        ledger.keep(entry)
    config = load_config(tmp_path / "booth.toml")
    words = ["--now", "--config", str(tmp_path / "booth.toml")]
    done = CliRunner().invoke(deliver, words)
    assert done.output == f"deliver share: 1 to hand over\n{NOTHING_RUNS}\n"
    assert ledger.waiting() == [replace(later, target="gone"), replace(later, next_s=0.0)]
    with held(private_folder(config.runtime.folder) / "deliver.lock", BoothError()):
        trying = CliRunner().invoke(deliver, words).output
    # Nothing said that the number is not the outcome.
    hint = "being tried; station status shows what fails"
    assert trying == f"deliver share: 1 to hand over\n{hint}\n"
    ledger.keep(later)
    told: Any = SimpleNamespace(config=config, ledger=ledger)
    # The hour after which it would have been tried was told.
    assert [(one.error, one.next_try) for one in hand_over(told, told, told)] == [
        ("does not exist", "")
    ]
    handover.try_all("share", 1e9)
    assert ledger.receivers(_IDS[0]) == ["share"]


def test_a_try_that_somebody_asks_for_makes_no_pause_longer(
    handover: HandOver, tmp_path: Path
) -> None:
    """After a few presses of "Try now" the booth itself tried only once in an hour."""

    def down(scan: ScanRecord, result: Path) -> None:  # noqa: ARG001
        raise HandOverError("it answers 503")

    ledger = Ledger(tmp_path / "spool")
    handover._targets["share"] = down
    handover.look()
    for now_s in (1e9, 1e9 + 100.0):
        handover.try_all("share", now_s)
    for now_s in (1e9 + 101.0, 1e9 + 102.0, 1e9 + 103.0):
        ledger.try_now(["share"])
        handover.try_all("share", now_s)
    [entry] = ledger.waiting()
    assert (entry.tries, round(entry.next_s)) == (2, 1e9 + 103.0 + PAUSES_S[1])
    handover.try_all("share", 1e9 + 200.0)
    [entry] = ledger.waiting()
    assert (entry.tries, round(entry.next_s)) == (3, 1e9 + 200.0 + PAUSES_S[2])


def test_a_result_that_the_disk_refuses_to_read_waits_until_its_verdict_is_known(
    handover: HandOver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A webhook received it as usable, without its label, and never again."""
    result = tmp_path / "spool/outbox" / _IDS[0] / "result.json"
    taken: list[ScanRecord] = []
    handover._targets["share"] = lambda scan, _: taken.append(scan)

    def refused(path: Path, most_bytes: int) -> Any:
        if path == result:
            raise OSError(errno.EIO, "Input/output error")
        return read_bounded_json(path, most_bytes)

    with monkeypatch.context() as patched:
        patched.setattr("station.archive.records.read_bounded_json", refused)
        handover.look()
        handover.try_all("share", 1e9)
    (waiting,) = Ledger(tmp_path / "spool").waiting()
    assert (taken, waiting.tries) == ([], 1)
    told = handover.health()["problems"][0]
    assert in_language(told, "zh").startswith("移交 share：1 项尚未移交（它的文件无法读取（Input/")
    monkeypatch.setattr("station.archive.index._AGAIN_NS", 0)
    # This target wants none that ask for another scan.
    text = result.read_text()
    result.write_text(text.replace('"ok"', '"rescan"'))
    handover.try_all("share", 2e9)
    assert (taken, Ledger(tmp_path / "spool").waiting()) == ([], [])


def test_a_result_that_leaves_before_it_is_handed_over_is_told(
    handover: HandOver, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    handover.look()
    shutil.rmtree(tmp_path / "spool/outbox" / _IDS[0])
    handover.look()
    assert f"scan {_IDS[0]} left the outbox before it was handed over to share" in caplog.text


@pytest.mark.parametrize(
    "content",
    ["[" * 100_000, '{"tries": Infinity, "next_s": 0, "error": ""}',
     '{"tries": -100, "next_s": NaN, "error": ""}', '{"tries": 1, "next_s": 1e300, "error": ""}'],
)  # fmt: skip
def test_odd_entries_are_tried_at_once(tmp_path: Path, content: str) -> None:
    """`station deliver` ended with them at every start, and the API told nothing of the booth."""
    ledger = Ledger(tmp_path)
    ledger.keep(Waiting("share", _IDS[0]))
    (tmp_path / "handover/share/waiting" / f"{_IDS[0]}.json").write_text(content)
    [entry] = ledger.waiting()
    assert entry.due(1e9)
    assert entry.document()["next_try"] == ""
    assert entry.failed("again", 1e9).next_s == 1e9 + PAUSES_S[0]


def test_what_is_no_scan_in_the_outbox_is_not_handed_over(
    handover: HandOver, tmp_path: Path
) -> None:
    """A name that is no UTF-8, or too long for a record's name, ended the hand-over of all."""
    outbox = os.fsencode(tmp_path / "spool/outbox")
    for name in (b"M\xfcller", b"x" * 250):
        os.mkdir(outbox + b"/" + name)
    handover.look()
    assert [entry.scan_id for entry in Ledger(tmp_path / "spool").waiting()] == [_IDS[0]]


def test_the_name_of_a_deleted_folder_is_no_pattern(tmp_path: Path) -> None:
    """Everything would have been handed over again."""
    ledger = Ledger(tmp_path)
    ledger.finish(Waiting("share", _IDS[0]))
    ledger.keep(Waiting("orders", _IDS[0]))
    ledger.forget("*")
    assert ledger.receivers("2026*") == []
    assert (ledger.receivers(_IDS[0]), len(ledger.waiting())) == (["share"], 1)
