"""Output of the operator's commands."""

import itertools
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

from station.archive.phrases import untranslated
from station.booth.operator import scan_cli
from station.booth.operator.scan_cli import _follow, scan, show_result
from station.booth.operator.sensors_cli import cancel, start, stop
from station.booth.operator.status_cli import status
from station.booth.session import FINAL
from station.core.config import BoothConfig
from station.core.errors import BoothError, FormatError
from station.core.files import held
from station.core.scans import CANCELLED
from station.core.service import HEALTH, STATION_LOCK
from station.messaging import asking
from station.messaging.messages import Reply, Request
from station.messaging.transport import NoAnswerError, NothingRunsError


def _row(name: str, value_m: float | None, half_m: float = 0.008, basis: str = "seen") -> Any:
    ends = [None, None] if value_m is None else [value_m - half_m, value_m + half_m]
    return {"name": name, "value_m": value_m, "interval95_m": ends, "basis": basis}


def test_a_result_is_printed_with_plain_names_and_both_sides_on_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        _row("waist_girth", 0.842),
        _row("neck_shoulder_to_waist_front_left", 0.441, basis="partly"),
        _row("neck_shoulder_to_waist_front_right", None),
        _row("hand_length_right", 0.19),
        _row("calf_girth_left", 0.36, basis="inferred"),
        _row("calf_girth_right", 0.37),
    ]
    verdict = {"status": "ok", "reasons": [], "notes": ["hair is left out"]}
    document = {"format": "booth-measurements", "version": 1, "measurements": rows}
    (tmp_path / "measurements.json").write_text(json.dumps({**document, "verdict": verdict}))
    show_result(tmp_path)
    remark, _, *lines = capsys.readouterr().out.splitlines()
    assert remark == "remark: hair is left out"
    heading, waist, _, sides, neck, hand, calf, _, partly, inferred = lines
    assert heading.split() == ["cm", "95", "%", "interval"]
    assert waist.split() == ["Waist", "girth", "84.2", "83.4", "to", "85.0"]
    assert sides.split() == ["left", "right"]
    assert neck.endswith("44.1   43.3 to  44.9 *         -  not measured")
    assert "36.0   35.2 to  36.8 **" in calf
    for row, value in ((hand, "19.0"), (calf, "37.0")):
        assert row.index(value) + len(value) == sides.index("right") + len("right")
    assert "not measured" not in hand
    assert partly == "  * the cameras saw only a part of this line"
    assert inferred.startswith("  ** ")


def test_a_result_whose_table_is_damaged_is_an_error(tmp_path: Path) -> None:
    """Nothing told what to do about it."""
    result, bundle = tmp_path / "outbox" / "one", tmp_path / "done" / "one"
    for folder in (result, bundle):
        folder.mkdir(parents=True)
    table = result / "measurements.json"
    again = "in the spool's folder: reconstruct fit done/one --out FOLDER"
    for text, words in (
        (None, "one has no measurements.json"),
        ("{", "measurements.json of one is damaged"),
        ("{}", "measurements.json of one is not booth-measurements version 1"),
    ):
        if text is not None:
            table.write_text(text)
        (bundle / "bundle.json").touch()
        with pytest.raises(FormatError, match=f"^{words}.*; scan again, or {again}$") as told:
            show_result(result)
        assert untranslated(str(told.value)) == []
        (bundle / "bundle.json").unlink()
        with pytest.raises(FormatError, match=f"^{words}.*; scan again$"):
            show_result(result)


def _run(command: click.Command, config: BoothConfig, *words: str) -> Result:
    path = config.runtime.folder.parent / "booth.toml"
    return CliRunner().invoke(command, [*words, "--config", str(path)])


def _report(config: BoothConfig, process: str, **content: Any) -> None:
    """The report that a process wrote just now."""
    folder = config.runtime.folder / HEALTH
    folder.mkdir(parents=True, exist_ok=True)
    document = {"pid": os.getpid(), "told_s": time.monotonic(), **content}
    (folder / f"{process}.json").write_text(json.dumps(document))


@pytest.mark.parametrize("command", [status, scan, start, stop, cancel])
def test_a_booth_that_does_not_run_is_told_at_once(
    one_camera: BoothConfig, command: click.Command
) -> None:
    """Every command waited for an answer first."""
    words = ["some-scan"] if command is cancel else []
    done = _run(command, one_camera, *words)
    assert isinstance(done.exception, BoothError)
    assert str(done.exception).startswith("the booth is not running here; start it with")


def test_a_booth_that_was_just_stopped_has_no_processes(one_camera: BoothConfig) -> None:
    """Their last reports are as fresh as those of a booth that runs."""
    ended = subprocess.Popen(["true"])
    ended.wait()
    for process in ("control", "sync"):
        _report(one_camera, process, pid=ended.pid)
    shown = _run(status, one_camera).output
    assert "running" not in shown
    assert "SILENT" not in shown


def test_a_booth_that_is_starting_is_waited_for(one_camera: BoothConfig) -> None:
    path = one_camera.runtime.folder.parent / "booth.toml"
    path.write_text(path.read_text() + "[runtime]\ncommand_timeout_s = 0.2\n")
    with held(one_camera.runtime.folder / STATION_LOCK, BoothError("held")):
        done = _run(stop, one_camera)
    assert "did not answer within 0.2 s" in str(done.exception)


@pytest.mark.parametrize("watched", [True, False])
def test_a_reconstruction_counts_its_seconds_on_one_line(
    one_camera: BoothConfig,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    *,
    watched: bool,
) -> None:
    """It said nothing for most of a minute on a busy computer."""
    states = iter(["accepted", *7 * ["reconstructing"]])
    moments_s = itertools.count(0.0, 0.25)
    clock = SimpleNamespace(monotonic=lambda: next(moments_s), sleep=lambda _: None)

    def answer(*_: object) -> dict[str, Any]:
        return {"state": next(states), "reason": "", "wanted": 0, "framesets": 0}

    monkeypatch.setattr(scan_cli, "_ask_until_answered", answer)
    monkeypatch.setattr(scan_cli, "time", clock)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: watched)
    order = Request("scan", "a")
    with pytest.raises(BoothError, match="is not done yet"):
        _follow(one_camera, order, answer(), lambda _: False, 3.0)
    *_, last = capsys.readouterr().out.split("\n")[:-1]
    told = [words.strip() for words in last.split("\r")]
    if not watched:
        assert told == ["reconstructing"]
    else:
        assert told[0] == "reconstructing (0 s)"
        assert "reconstructing (1 s)" in told


def test_a_reconstruction_that_is_compiled_first_says_so(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first one takes a minute longer than any other, and nobody knew why."""
    states = iter(["accepted", *4 * ["reconstructing"], "delivered"])
    compiling = iter([False, True, True, False])

    def answer(*_: object) -> dict[str, Any]:
        return {"state": next(states), "reason": "", "wanted": 0, "framesets": 0}

    def health(_: Path, process: str) -> dict[str, bool]:
        return {"compiling": process == "workers" and next(compiling)}

    monkeypatch.setattr(scan_cli, "_ask_until_answered", answer)
    monkeypatch.setattr(scan_cli, "read_health", health)
    order = Request("scan", "a")
    _follow(one_camera, order, answer(), FINAL.__contains__, time.monotonic() + 60.0)
    told = [line.strip() for line in capsys.readouterr().out.splitlines()]
    about = [line for line in told if "compiled" in line]
    assert about == ["the reconstruction is being compiled, once on this machine: a minute or two"]
    assert told[-1] == "delivered"


def test_a_long_label_is_refused_by_control_and_not_cut_here(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever looked for the scan by its whole label did not find it."""
    told = []

    def refused(_: BoothConfig, order: Request) -> dict[str, Any]:
        told.append(order.label)
        raise BoothError("the label has 300 characters")

    monkeypatch.setattr(scan_cli, "_ask_until_answered", refused)
    done = _run(scan, one_camera, "--label", 300 * "x")
    assert str(done.exception) == "the label has 300 characters"
    assert told == [300 * "x"]


def test_a_station_that_was_just_begun_is_waited_for(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`station run & station start` in a script."""
    answers: Iterator[Reply | NothingRunsError] = iter(
        [NothingRunsError(), NothingRunsError(), Reply(ok=False, error="it answered")]
    )

    def asked(*_: object) -> Reply:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(asking, "ask_again", asked)
    assert str(_run(start, one_camera).exception) == "it answered"


def test_a_scan_that_was_accepted_outlives_the_station(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command ended at once, with no word on the scan."""
    session = {"state": "accepted", "reason": "", "wanted": 0, "framesets": 0}
    answers: Iterator[dict[str, Any] | NothingRunsError] = iter(
        [NothingRunsError(), {**session, "state": "delivered"}]
    )

    def told(*_: object) -> dict[str, Any]:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(scan_cli, "command", told)
    order = Request("scan", "a")
    done = _follow(one_camera, order, session, lambda state: state == "delivered", math.inf)
    assert done["state"] == "delivered"
    assert "outcome not known yet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("state", "reason", "words", "code"),
    [
        ("delivered", "", "verdict: usable", 0),
        ("rescan", "stand upright", "scan again: stand upright", 3),
    ],
)
def test_the_verdict_is_told_whatever_it_is(
    one_camera: BoothConfig,
    monkeypatch: pytest.MonkeyPatch,
    state: str,
    reason: str,
    words: str,
    code: int,
) -> None:
    """A good one was to be guessed from the lack of words."""
    session = {"state": state, "reason": reason, "wanted": 0, "framesets": 0, "path": ""}
    monkeypatch.setattr(scan_cli, "_ask_until_answered", lambda *_: session)
    done = _run(scan, one_camera)
    assert words in done.output.splitlines()
    assert done.exit_code == code


@pytest.mark.parametrize("answers", [True, False])
def test_a_scan_of_a_booth_that_is_starting_is_not_said_to_be_unsure(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch, *, answers: bool
) -> None:
    """Nobody had received it: it was refused a moment later."""
    replies: Iterator[Reply] = iter([Reply(ok=False, error="the sensors are stopped")])
    asked: list[object] = []

    def ask(*words: object) -> Reply:
        asked.append(words)
        if len(asked) < 3 or not answers:
            raise NoAnswerError("control did not answer")
        return next(replies)

    monkeypatch.setattr(asking, "ask", ask)
    monkeypatch.setattr(scan_cli, "_UNSURE_S", 60.0 if answers else 0.0)
    with held(one_camera.runtime.folder / STATION_LOCK, BoothError("held")):
        done = _run(scan, one_camera)
    if answers:
        assert str(done.exception) == "the sensors are stopped"
        assert done.output == "  the booth is starting\n"
    else:
        assert str(done.exception).endswith("no scan was started")


def test_a_scan_that_control_may_have_received_is_said_to_be_unsure(
    one_camera: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ask(*_: object) -> Reply:
        raise NoAnswerError("control did not answer")

    monkeypatch.setattr(asking, "ask", ask)
    monkeypatch.setattr(scan_cli, "_UNSURE_S", 0.0)
    with held(one_camera.runtime.folder / "control.lock", BoothError("held")):
        done = _run(scan, one_camera)
    assert isinstance(done.exception, scan_cli.UnsureError)


def test_a_cancelled_scan_is_not_said_to_have_failed(
    one_camera: BoothConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    session = {"state": "failed", "reason": CANCELLED, "wanted": 0, "framesets": 0}
    _follow(one_camera, Request("scan", "a"), session, lambda _: True, math.inf)
    assert capsys.readouterr().out.split() == ["cancelled"]
