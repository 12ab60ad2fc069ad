"""Tables, SeamlyMe's file, the sheet, comparison, hand-over: what leaves the booth."""

from __future__ import annotations

import csv
import hashlib
import hmac
import io
import json
import re
import shutil
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pypdf
import pytest
from click.testing import CliRunner
from live_console import LiveConsole

from station.archive import sheet
from station.archive.compare import compare_rows
from station.archive.index import ScanIndex
from station.archive.phrases import in_language
from station.archive.records import ScanRecord
from station.archive.sheet import sheet_pdf
from station.archive.smis import seamly_name, smis
from station.archive.surfaces import Surface, aligned, distances
from station.archive.tables import csv_table, read_measurements, rows, side_differences
from station.core.config_file import load_config
from station.core.files import write_json
from station.core.geometry import so3_exp
from station.core.service import set_up_logs
from station.core.spool import Spool
from station.core.words.terms import TERMS, Language, plain_name, split_side
from station.handover.deliver_cli import HandOver
from station.handover.ledger import PAUSES_S, Ledger, Waiting
from workers.measure.definitions import DEFINITIONS
from workers.reconstruct.measure_cli import measure

_TIMELY_S = 5.0
"""A try against this machine takes less."""
_DOCUMENT: dict[str, Any] = {
    "format": "booth-measurements", "version": 1, "pose": "as-scanned",
    "measurements": [
        {"name": "waist_girth", "standard": "ISO", "value_m": 0.8421,
         "interval95_m": [0.834, 0.850], "basis": "seen", "path": [], "closed": True},
        {"name": "wrist_girth_left", "standard": "", "value_m": None, "interval95_m": None,
         "basis": None, "path": [], "closed": True},
        {"name": "wrist_girth_right", "standard": "", "value_m": 0.17,
         "interval95_m": [0.16, 0.18], "basis": "partly", "path": [], "closed": True},
    ],
}  # fmt: skip


def _scan(label: str) -> ScanRecord:
    return ScanRecord("20261121T100000Z-7f3a", "delivered", label, "b", "2026-11-21T10:00:00Z", "")


def test_every_measurement_has_a_name_in_both_languages() -> None:
    for definition in DEFINITIONS:
        stem, _ = split_side(definition.name)
        assert stem in TERMS, f"{definition.name} has no plain name (station.core.words.terms)"
    assert plain_name("wrist_girth_left") == "Wrist girth, left"
    assert plain_name("wrist_girth_left", "zh") == "左腕围"
    assert len({term.zh for term in TERMS.values()}) == len(TERMS)


def test_a_label_is_never_a_formula() -> None:
    """A spreadsheet runs what begins with an equals sign, and a label is anybody's text."""
    table = csv_table(_scan('=HYPERLINK("http://evil")'), _DOCUMENT, "cm", "en")
    assert table.startswith("\ufeff")
    read = list(csv.DictReader(io.StringIO(table.lstrip("\ufeff"))))
    assert read[0]["order"] == '\'=HYPERLINK("http://evil")'
    assert (read[0]["value"], read[0]["unit"], read[0]["verdict"]) == ("84.2", "cm", "usable")
    assert read[1]["value"] == ""
    assert rows(_DOCUMENT, "in", "en")[0]["value"] == 33.15


def test_a_label_stays_in_its_cell() -> None:
    table = csv_table(_scan("Order\x00 1\nred\x1b[31m"), _DOCUMENT, "cm", "en")
    assert table.splitlines()[1].startswith("Order  1 red [31m,")


def test_a_spreadsheet_is_in_one_language() -> None:
    """The basis was English in the Chinese one."""

    def bases(language: Language) -> list[str]:
        table = csv_table(_scan("Order 1"), _DOCUMENT, "cm", language).lstrip("\ufeff")
        return [line[10] for line in list(csv.reader(io.StringIO(table)))[1:]]

    assert bases("en") == ["seen", "", "partly"]
    assert bases("zh") == ["可见", "", "部分可见"]


def test_a_difference_is_that_of_the_numbers_beside_it(tmp_path: Path) -> None:
    """The page and the sheet said 17.3 and 17.2, and a difference of 0.2; two scans 87.3 and 87.4,
    and 0.0."""
    table = {**_DOCUMENT, "differences": [
        {"name": "wrist_girth", "value_m": 0.0016, "interval95_m": [0.0006, 0.0026]},
    ]}  # fmt: skip
    for number, waist_m in enumerate((0.8734, 0.8736)):
        table["measurements"] = [
            {**row, "value_m": value_m, "interval95_m": [value_m - 0.001, value_m + 0.001]}
            for row, value_m in zip(
                _DOCUMENT["measurements"], (waist_m, 0.1734, 0.1718), strict=True
            )
        ]
        (tmp_path / f"{number}").mkdir()
        write_json(tmp_path / f"{number}/measurements.json", table)
    _, left, right = rows(table, "cm", "en")
    [sides] = side_differences(table, "cm", "en")
    assert (left["value"], right["value"], sides["value"]) == (17.3, 17.2, 0.1)
    assert sides["real"]
    told = CliRunner().invoke(measure, [str(tmp_path / "0")]).output
    assert re.search(r"Wrist girth, left +17\.3 cm", told)
    assert re.search(r"Wrist girth, right +17\.2 cm", told)
    assert re.search(r"Wrist girth +0\.1 cm .* larger on the left", told)
    waist = compare_rows(tmp_path / "0", tmp_path / "1", "as-scanned", "cm", "en")[0]
    assert (waist["first"], waist["second"], waist["difference"]) == (87.3, 87.4, 0.1)


def test_seamly_reads_what_was_written() -> None:
    """The file as SeamlyMe's format 0.3.4 has it, read back by a parser of its own."""
    content = smis(_scan("Ann & <Bob>\x07"), _DOCUMENT)
    root = ElementTree.fromstring(content)
    assert root.tag == "smis"
    order = [child.tag for child in root]
    assert order == [
        "version", "read-only", "notes", "unit", "pm_system", "personal", "body-measurements",
    ]  # fmt: skip
    assert root.findtext("version") == "0.3.4"
    assert root.findtext("unit") == "cm"
    assert root.findtext("personal/family-name") == "Ann & <Bob>"
    read = {m.get("name"): float(m.get("value", "")) for m in root.iter("m")}
    assert read == {"waist_circ": 84.21, "arm_wrist_circ": 17.0}
    names = [seamly_name(definition.name) for definition in DEFINITIONS]
    assert len(set(names)) == len(names)


def test_the_sheet_has_the_whole_table_on_one_page(
    console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    spool = Spool(console.config.spool.folder)
    scan = ScanIndex(spool).get(scans[0]["scan_id"])
    assert scan is not None
    folder = spool.path("outbox", scan.scan_id)
    document = pypdf.PdfReader(io.BytesIO(sheet_pdf(scan, folder, "standard", "cm", "en")))
    assert len(document.pages) == 1
    page = document.pages[0]
    assert [round(float(side)) for side in page.mediabox[2:]] == [595, 842]
    text = page.extract_text()
    assert "Order 1234" in text
    assert ("USABLE" in text) or ("SCAN AGAIN" in text)
    for row in rows(read_measurements(folder, "standard"), "cm", "en"):
        assert row["words"] in text
        assert row["value"] is None or f"{row['value']:.1f}" in text
    # A tailor must see which values the cameras did not.
    assert "it is inferred" in text
    assert re.search(r"± \d\.\d\s*\*\*", text)
    chinese = sheet_pdf(scan, folder, "as-scanned", "in", "zh")
    assert len(pypdf.PdfReader(io.BytesIO(chinese)).pages) == 1


def test_a_long_label_is_cut_without_a_look_at_each_letter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The sheet of a scan with a label of 100,000 letters, which a bundle may have, took hours."""
    looks = []

    def width(text: str, size: float, bold: bool = False) -> float:
        looks.append((size, bold))
        return float(len(text))

    monkeypatch.setattr(sheet, "_width", width)
    assert sheet._cut("i" * 100_000, 40.0, 20.0) == "i" * 39 + "…"
    assert len(looks) < 200
    assert sheet._cut("Order 1", 40.0, 20.0) == "Order 1"


def test_the_sheet_tells_all_reasons_or_that_there_are_more() -> None:
    """They ended after 150 letters, within a word."""
    reasons = [f"the cameras saw only {share} % of the left forearm" for share in range(10, 30)]
    for some in (reasons[:2], reasons[:8]):
        lines = sheet._lines("; ".join(some))
        assert " ".join(lines) == "; ".join(some)
    assert len(lines) == 3
    *whole, last = sheet._lines("; ".join(reasons))
    assert "; ".join(reasons).startswith(" ".join([*whole, last.removesuffix("…")]))
    assert last.endswith("…")
    chinese = in_language("; ".join(reasons[:8]), "zh")
    assert "".join(sheet._lines(chinese)).replace(" ", "") == chinese.replace(" ", "")
    room = sheet._WIDTH - 2 * sheet._MARGIN
    for line in (*whole, last, *sheet._lines(chinese), *sheet._lines("i" * 100_000)):
        assert sheet._width(line, sheet._REASONS_SIZE) <= room
    assert sheet._lines("") == []
    # A line ended after its first words, where nothing but a number has spaces.
    assert len(sheet._lines("只看到 9 " + "左" * 150)[0]) > 60


def test_the_sheet_of_a_body_without_a_neck_to_measure(
    console: LiveConsole, scans: list[dict[str, Any]], tmp_path: Path
) -> None:
    """A blank row has neither value nor line."""
    spool = Spool(console.config.spool.folder)
    scan = ScanIndex(spool).get(scans[0]["scan_id"])
    assert scan is not None
    folder = Path(shutil.copytree(spool.path("outbox", scan.scan_id), tmp_path / scan.scan_id))
    for name in ("measurements.json", "measurements-standard.json"):
        document = json.loads((folder / name).read_text())
        for row in document["measurements"]:
            if row["name"] == "neck_girth":
                row |= {"value_m": None, "interval95_m": None, "basis": None, "path": []}
        (folder / name).write_text(json.dumps(document))
    for pose in ("as-scanned", "standard"):
        text = pypdf.PdfReader(io.BytesIO(sheet_pdf(scan, folder, pose, "cm", "en"))).pages[0]
        assert "Neck" in text.extract_text()


def _sphere(radius_m: float) -> Surface:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_sphere(radius_m, 40)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles, np.int32))


def test_distances_between_surfaces() -> None:
    """Spheres of 20 and 21 cm lie 1 cm apart, and signs say which is the larger."""
    small, large = _sphere(0.20), _sphere(0.21)
    assert distances(large, small) == pytest.approx(0.01, abs=3e-4)
    assert distances(small, large) == pytest.approx(-0.01, abs=3e-4)
    assert np.abs(distances(small, small)).max() < 1e-9


def test_a_body_that_moved_as_a_whole_is_laid_over() -> None:
    rng = np.random.default_rng(3)
    still = _sphere(0.3)
    still = Surface(still.vertices * [1.0, 0.6, 2.0], still.faces)
    turned = still.vertices @ so3_exp(np.array([0.02, -0.03, 0.2])).T + [0.05, -0.02, 0.01]
    raised = rng.random(len(turned)) < 0.2
    turned[raised] += [0.0, 0.0, 0.1]
    found = aligned(Surface(turned, still.faces), still)
    off = np.linalg.norm(found.vertices - still.vertices, axis=1)
    assert off[~raised].max() < 1e-6


class _Receiver(BaseHTTPRequestHandler):
    """Another program's webhook."""

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        server = self.server
        assert isinstance(server, _Server)
        server.got.append((dict(self.headers), body))
        self.send_response(server.answer)
        self.send_header("Location", "http://127.0.0.1:1/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Quiet."""


class _Server(HTTPServer):
    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Receiver)
        self.answer = 503
        self.got: list[tuple[dict[str, str], bytes]] = []


@pytest.fixture
def receiver() -> Iterator[_Server]:
    server = _Server()
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()


def _hand_over(
    folder: Path, console: LiveConsole, scans: list[dict[str, Any]], sections: str
) -> tuple[HandOver, Ledger]:
    """A spool with one result, and its [[deliver]] sections."""
    config = folder / "booth.toml"
    if not config.exists():
        cameras = '[[cameras]]\nname = "a"\ndriver = "recorded"\nrecording = "a"\n'
        config.write_text(cameras + sections)
        scan_id = scans[0]["scan_id"]
        outbox = Spool(folder / "spool").folder / "outbox"
        shutil.copytree(console.config.spool.folder / "outbox" / scan_id, outbox / scan_id)
    loaded = load_config(config)
    return HandOver(loaded, set_up_logs("deliver")), Ledger(loaded.spool.folder)


def test_a_wall_clock_that_was_put_back_delays_no_hand_over() -> None:
    entry = Waiting("orders", "a").failed("no answer", now_s=1e9 + 40 * 86_400)
    assert entry.due(1e9)
    entry = entry.failed("no answer", now_s=1e9)
    assert not entry.due(1e9)
    assert entry.due(1e9 + PAUSES_S[1])


def test_a_webhook_is_tried_until_it_takes_the_result_and_never_again(
    console: LiveConsole, scans: list[dict[str, Any]], receiver: _Server, tmp_path: Path
) -> None:
    (tmp_path / "secret").write_text("topsecret\n")
    sections = (
        f'[[deliver]]\nname = "orders"\nurl = "http://127.0.0.1:{receiver.server_port}/hook"\n'
        'secret_file = "secret"\nlink = "https://booth.example"\nrescans = true\n'
    )
    handover, ledger = _hand_over(tmp_path, console, scans, sections)
    handover.look()
    now_s = 1e9
    for number, pause_s in enumerate(PAUSES_S, start=1):
        handover.try_all("orders", now_s)
        (waiting,) = ledger.waiting()
        assert waiting.tries == number
        assert now_s + pause_s <= waiting.next_s < now_s + pause_s + _TIMELY_S
        assert "503" in waiting.error
        handover.try_all("orders", now_s + pause_s - 0.1)
        assert len(receiver.got) == number
        now_s = waiting.next_s
    # The station was restarted meanwhile; a redirect is no delivery either.
    handover, ledger = _hand_over(tmp_path, console, scans, sections)
    receiver.answer = 307
    handover.look()
    handover.try_all("orders", now_s)
    assert len(ledger.waiting()) == 1
    receiver.answer = 204
    now_s = ledger.waiting()[0].next_s
    handover.try_all("orders", now_s)
    assert ledger.waiting() == []
    handover.look()
    handover.try_all("orders", now_s + 1e6)
    headers, body = receiver.got[-1]
    assert len(receiver.got) == len(PAUSES_S) + 2
    seconds, mac = (part.split("=")[1] for part in headers["Booth-Signature"].split(","))
    expected = hmac.new(b"topsecret", seconds.encode() + b"." + body, hashlib.sha256).hexdigest()
    assert hmac.compare_digest(mac, expected)
    document = json.loads(body)
    assert document["label"] == "Order 1234"
    assert document["links"]["mesh.glb"].startswith("https://booth.example/api/v1/scans/")
    assert len({h["Idempotency-Key"] for h, _ in receiver.got}) == 1


def test_a_folder_gets_a_result_whole_once_the_share_is_there(
    console: LiveConsole, scans: list[dict[str, Any]], tmp_path: Path
) -> None:
    sections = '[[deliver]]\nname = "share"\nfolder = "mnt/share"\nrescans = true\n'
    handover, ledger = _hand_over(tmp_path, console, scans, sections)
    handover.look()
    handover.try_all("share", 1e9)
    assert "is the share mounted" in ledger.waiting()[0].error
    told = handover.health()
    assert told["waiting"] == {"share": 1}
    assert "is the share mounted" in told["problems"][0]
    (tmp_path / "mnt/share").mkdir(parents=True)
    (tmp_path / "mnt/share" / f".{scans[0]['scan_id']}.part").mkdir()
    handover.try_all("share", 2e9)
    assert ledger.waiting() == []
    assert handover.health() == {"waiting": {"share": 0}, "problems": []}
    names = [path.name for path in (tmp_path / "mnt/share").iterdir()]
    assert names == [scans[0]["scan_id"]]
    there = {path.name for path in (tmp_path / "mnt/share" / names[0]).iterdir()}
    assert {"result.json", "measurements.csv", "individual.smis", "mesh.glb"} <= there
    # A purged result is forgotten.
    shutil.rmtree(tmp_path / "spool/outbox" / names[0])
    handover.look()
    assert not list((tmp_path / "spool/handover/share/done").iterdir())
