"""Lists of scans on the command line."""

import json

import pytest
from click.testing import CliRunner

from station.archive.phrases import in_language
from station.archive.records import read_record
from station.cli import station
from station.core.files import write_json
from station.core.scans import CANCELLED, REASON, ScanId, ScanNote
from station.core.spool import Spool

_ODD = {
    "half of a pair": r'{"label": "\ud800", "reasons": ["\udfff"]}',
    "deep": 100_000 * "[",
    "no list": '{"reasons": null, "seconds": []}',
    "no number": '{"reasons": 7, "seconds": {"fit": "long"}}',
}


@pytest.mark.parametrize("place", ["outbox", "failed"])
@pytest.mark.parametrize("odd", _ODD)
def test_one_damaged_scan_does_not_hide_the_others(
    spool: Spool, option: list[str], place: str, odd: str
) -> None:
    """Neither a list nor the page showed any scan, and no result was handed over."""
    folder = spool.path(place, "20261125T100000Z-0005")
    folder.mkdir()
    for name in ("bundle.json", "result.json", REASON):
        (folder / name).write_text(_ODD[odd])
    listed = CliRunner().invoke(station, ["list", *option])
    assert (listed.exit_code, len(listed.output.splitlines())) == (0, 5)


@pytest.mark.parametrize("torn", [None, "", '{"status": "o', '{"reasons": []}'])
def test_a_result_whose_verdict_is_lost_is_not_usable(spool: Spool, torn: str | None) -> None:
    """It was listed, and handed over, as usable."""
    scan_id = ScanId("20261125T100000Z-0005")
    folder = spool.path("outbox", scan_id)
    folder.mkdir()
    if torn is not None:
        (folder / "result.json").write_text(torn)
    spool.notes.write(ScanNote(scan_id, "delivered", label="7", verdict="ok"), durable=False)
    found = read_record(spool, "outbox", scan_id)
    assert found is not None
    assert (found.state, found.label) == ("rescan", "7")
    assert found.reasons == ("its result.json is missing or damaged; scan again",)
    assert "缺失" in in_language(found.reasons[0], "zh")


def test_list_and_find_on_the_command_line(option: list[str]) -> None:
    listed = CliRunner().invoke(station, ["list", *option])
    assert listed.output.splitlines()[0].startswith("20261123T100000Z-0003")
    assert "scan again" in listed.output
    found = CliRunner().invoke(station, ["find", "order 1234", "--json", *option])
    assert [scan["scan_id"] for scan in json.loads(found.output)] == ["20261121T100000Z-0001"]
    assert "no scan matches 'x'" in CliRunner().invoke(station, ["find", "x", *option]).output


def test_a_scan_that_was_never_stored_is_found_by_its_id(spool: Spool, option: list[str]) -> None:
    """The operator was told to look for an interrupted scan, and nothing matched."""
    scan_id = ScanId("20261125T100000Z-7f3a")
    note = ScanNote(scan_id, "failed", label="Order 8", reason="the booth was stopped")
    spool.notes.write(note, durable=False)
    shown = CliRunner().invoke(station, ["find", scan_id, *option]).output
    assert shown.startswith(scan_id)
    assert shown.endswith("failed         Order 8  the booth was stopped\n")
    told = CliRunner().invoke(station, ["find", scan_id, "--json", *option]).output
    assert json.loads(told)[0]["created"] == "2026-11-25T10:00:00Z"
    assert scan_id not in CliRunner().invoke(station, ["list", *option]).output
    spool.notes.write(ScanNote(scan_id, "delivered", verdict="rescan"), durable=False)
    assert "scan again" in CliRunner().invoke(station, ["find", scan_id, *option]).output
    spool.notes.write(ScanNote(scan_id, "capturing"), durable=False)
    assert "has no outcome yet" in CliRunner().invoke(station, ["find", scan_id, *option]).output


def test_a_cancelled_scan_is_listed_as_such(spool: Spool, option: list[str]) -> None:
    """It was said to have failed, as if something had gone wrong."""
    scan_id = "20261120T100000Z-0000"
    assert spool.withdraw(scan_id, CANCELLED)
    (line,) = CliRunner().invoke(station, ["find", scan_id, *option]).output.splitlines()
    assert "cancelled" in line
    assert "failed" not in line
    found = json.loads(CliRunner().invoke(station, ["find", scan_id, "--json", *option]).output)
    assert (found[0]["state"], found[0]["reasons"]) == ("failed", [CANCELLED])


@pytest.mark.usefixtures("in_shanghai")
def test_people_read_local_time_and_programs_utc(option: list[str]) -> None:
    """The table showed UTC without saying so."""

    def listed(*words: str) -> str:
        return CliRunner().invoke(station, ["list", *words, *option]).output

    newest = listed().splitlines()[0]
    assert newest.startswith("20261123T100000Z-0003    2026-11-23 18:00:00  scan again")
    assert json.loads(listed("--json"))[0]["created"] == "2026-11-23T10:00:00Z"
    assert listed("--since", "2026-11-23T17:59").splitlines() == [newest]
    assert listed("--since", "2026-11-23T18:01") == "no scans since 2026-11-23 18:01:00\n"
    assert listed("--since", "2026-11-23T09:59Z").splitlines() == [newest]


def test_a_long_label_is_cut_short_in_the_table_alone(spool: Spool, option: list[str]) -> None:
    """It broke the table."""
    folder = spool.path("outbox", "20261125T100000Z-0005")
    folder.mkdir()
    write_json(folder / "result.json", {"label": 300 * "x", "status": "ok"})
    (line,) = CliRunner().invoke(station, ["find", "xxx", *option]).output.splitlines()
    assert line.endswith(f" {39 * 'x'}…")
    found = json.loads(CliRunner().invoke(station, ["find", "xxx", "--json", *option]).output)
    assert found[0]["label"] == 300 * "x"


def test_a_list_since_what_is_no_day_is_refused(option: list[str]) -> None:
    """It said that there were no scans."""

    def listed(since: str) -> str:
        return CliRunner().invoke(station, ["list", "--since", since, *option]).output

    assert "gestern is no day or time: write 2026-11-21" in listed("gestern")
    assert "is no day or time" in listed("0001-01-01T00:00+05:00")
    assert listed("0999-01-01") == listed("")
    assert listed("2099-01-01") == "no scans since 2099-01-01 00:00:00\n"
    assert listed("20261123").count("\n") == listed("2026-11-23T00:00+00:00").count("\n") > 0
