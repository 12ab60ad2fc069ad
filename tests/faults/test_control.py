"""Control on a disk that fails: nothing is told of a scan that may turn out untrue."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError

from station.booth.control import ControlProcess
from station.booth.session import MAX_LABEL_LENGTH, UNSURE
from station.console.api.models import NewScan
from station.core.config import BoothConfig
from station.core.errors import BoothError
from station.core.scans import Notes, ScanId, ScanNote
from station.messaging.messages import Request

_ORDER = Request("scan", "a", "", 1e9)


@pytest.fixture
def control(one_camera: BoothConfig) -> Iterator[ControlProcess]:
    process = ControlProcess(one_camera, Path("booth.toml"), logging.getLogger())
    process._reply(Request("start"))
    yield process
    process._context.destroy(linger=0)


@pytest.mark.parametrize("failing_read", [1, 2, 3])
def test_a_disk_that_cannot_be_read_is_no_refusal(
    control: ControlProcess, monkeypatch: pytest.MonkeyPatch, failing_read: int
) -> None:
    reads = 0
    whole = Notes.read

    def read(notes: Notes, scan_id: object) -> object:
        nonlocal reads
        reads += 1
        if reads == failing_read:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return whole(notes, scan_id)  # type: ignore[arg-type]

    monkeypatch.setattr(Notes, "read", read)
    first = control._reply(_ORDER)
    assert first.ok
    # An order that was not recorded is recorded now; another one is the same scan.
    again = control._reply(_ORDER)
    assert again.ok
    last = control._reply(_ORDER)
    assert (last.ok, last.content["state"], last.content["reason"]) == (True, "armed", "")
    assert UNSURE in (first.content["reason"], again.content["reason"])


def test_a_scan_that_nobody_ordered_is_none(control: ControlProcess) -> None:
    with pytest.raises(BoothError, match="there is no scan b"):
        control._reply(Request("scan-status", "b"))


def test_a_label_that_no_note_holds_is_refused(control: ControlProcess) -> None:
    reply = control._reply(Request("scan", "c", "x" * 10_000, 1e9))
    assert not reply.ok
    assert "the label has 10000 characters" in reply.error
    assert not list((control._spool.folder / "scans").iterdir())


def test_a_label_is_as_long_as_what_is_kept_of_it(control: ControlProcess) -> None:
    """Accents that are spelled apart, as a Mac does, counted as characters of their own."""
    label = MAX_LABEL_LENGTH * "e\u0301"
    assert control._reply(Request("scan", "a", label, 1e9)).ok
    assert NewScan(label=label).label == MAX_LABEL_LENGTH * "é"
    assert not control._reply(Request("scan", "b", f"{label}e", 1e9)).ok
    with pytest.raises(ValidationError, match="at most 200 characters"):
        NewScan(label=f"{label}e")


def test_a_label_is_kept_as_lists_show_it(control: ControlProcess) -> None:
    """Two that looked the same were two, and one of blanks looked like a scan of nobody."""
    for scan_id, label in (("a", " a\tb\x07\n"), ("b", "   "), ("c", "👩\u200d👧 李")):
        assert control._reply(Request("scan", scan_id, label, 1e9)).ok
    notes = [control._spool.notes.read(scan_id) for scan_id in control._spool.notes.ids()]
    assert [note and note.label for note in notes] == ["a b", "", "👩\u200d👧 李"]


def test_a_cancel_that_comes_too_late_says_what_to_do_now(control: ControlProcess) -> None:
    """A delivered scan was to be deleted when it is done."""
    for stage in ("delivered", "accepted"):
        note = ScanNote(ScanId("a"), stage)
        control._spool.notes.write(note, durable=False)
        if stage == "accepted":
            (control._spool.path("work", "a")).mkdir()
        error = control._reply(Request("cancel", "a")).error
        assert "can no longer be cancelled" in error
        assert ("when it is done" in error) == (stage == "accepted")
