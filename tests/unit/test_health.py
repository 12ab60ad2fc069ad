"""Problems that `station status` lists, from the processes' health files."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from sync_process import sync_of

from station.archive.index import ScanIndex
from station.booth.frameset import rate_hz
from station.booth.health import MAX_AGE_S, booth_health, can_scan, starting, unusable
from station.booth.metrics import BoothCollector
from station.booth.operator import status_cli
from station.booth.scan_writer import booth_rig
from station.calibration.drift.check_cli import check
from station.calibration.guide.calibrate_cli import calibrate
from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.errors import BoothError
from station.core.files import held
from station.core.rig import Rig
from station.core.scans import CANCELLED, ScanId, scan_id_of
from station.core.service import HEALTH, STATION_LOCK, answered, file_name
from station.core.spool import Spool
from station.messaging import asking
from station.messaging.messages import Reply
from station.sensors.freenect import FreenectCamera
from station.sensors.identity import calibrated_serials
from station.simulation.scene import default_rig

_CAMERAS = ("a", "b")


@pytest.fixture
def config(tmp_path: Path) -> Iterator[BoothConfig]:
    """A booth that `station run` runs."""
    cameras = "".join(
        f'[[cameras]]\nname = "{name}"\ndriver = "recorded"\nrecording = "{name}"\n'
        for name in _CAMERAS
    )
    (tmp_path / "booth.toml").write_text(f"{cameras}[console]\nenabled = false\n")
    config = load_config(tmp_path / "booth.toml")
    _calibrate(config, _CAMERAS)
    with held(config.runtime.folder / STATION_LOCK, BoothError("held")):
        yield config


def _calibrate(config: BoothConfig, names: Sequence[str]) -> None:
    lenses = default_rig().cameras.values()
    cameras = {name: replace(lens, name=name) for name, lens in zip(names, lenses, strict=False)}
    Rig("2026-11-21T10:00:00Z", names[0], cameras, 0.0).save(config.calibration)


def _tell(config: BoothConfig, process: str, age_s: float = 0.0, **content: Any) -> None:
    folder = config.runtime.folder / HEALTH
    folder.mkdir(parents=True, exist_ok=True)
    document = {"pid": os.getpid(), "told_s": time.monotonic() - age_s, **content}
    (folder / f"{file_name(process)}.json").write_text(json.dumps(document))


def _problems(config: BoothConfig, *, streaming: bool, **sync: Any) -> list[str]:
    for process in ("capture a", "capture b", "workers"):
        _tell(config, process)
    _tell(config, "control", streaming=streaming)
    _tell(config, "sync", **sync)
    return booth_health(config).problems


def _camera(state: str, detail: str = "", trouble: str = "") -> dict[str, str]:
    return {"state": state, "detail": detail, "trouble": trouble}


def test_a_silent_camera_is_named_once_the_sensors_are_started(config: BoothConfig) -> None:
    cameras = {"a": _camera("lost", "no such device"), "b": _camera("streaming")}
    [problem] = _problems(config, streaming=True, silent=["a"], cameras=cameras)
    assert problem.startswith("camera a sends no frames (no such device)")
    assert _problems(config, streaming=False, silent=["a"], cameras=cameras) == []


def test_a_booth_that_is_not_calibrated_says_so(config: BoothConfig) -> None:
    """It was only said to the person who stood in it."""
    config.calibration.unlink()
    [problem] = _problems(config, streaming=True, silent=[], cameras={})
    assert problem.endswith("takes no scans: run station calibrate")


def test_a_lost_calibration_is_replaced_by_the_newest_that_is_kept(config: BoothConfig) -> None:
    """Status, a scan and a check asked for another calibration, which takes an hour."""
    path = config.calibration.parent / "booth.toml"
    for day in ("20261119", "20261120"):
        kept = config.calibrate.folder / f"{day}T100000Z" / "calibration.json"
        kept.parent.mkdir(parents=True)
        kept.write_bytes(config.calibration.read_bytes())
    config.calibration.unlink()
    [words] = _problems(config, streaming=True, silent=[], cameras={})
    assert "put the newest calibration back with station calibrate --use 20261120T100000Z" in words
    with pytest.raises(BoothError) as refusal:
        booth_rig(config)
    assert str(refusal.value) == words
    checked = CliRunner().invoke(check, ["--config", str(path)])
    assert str(checked.exception) == words
    # What is kept cannot be looked at: a problem like any other.
    config.calibrate.folder.rename(moved := config.calibration.parent / "moved")
    config.calibrate.folder.write_text("")
    [words] = _problems(config, streaming=True, silent=[], cameras={})
    assert "Not a directory" in words
    config.calibrate.folder.unlink()
    moved.rename(config.calibrate.folder)
    asked = ["--use", "20261120T100000Z", "--config", str(path)]
    assert CliRunner().invoke(calibrate, asked).exit_code == 0
    assert _problems(config, streaming=True, silent=[], cameras={}) == []


def test_the_remedy_of_several_silent_cameras_is_said_once(config: BoothConfig) -> None:
    cameras = {name: _camera("streaming") for name in _CAMERAS}
    found = _problems(config, streaming=True, silent=["a", "b"], cameras=cameras)
    assert found == ["cameras a, b send no frames; check the recordings"]
    serials = calibrated_serials(Rig.load(config.calibration).cameras)
    sensors = tuple(FreenectCamera(name=name, serial=serials[name]) for name in _CAMERAS)
    cabled = config.model_copy(update={"cameras": sensors})
    found = _problems(cabled, streaming=True, silent=["a", "b"], cameras=cameras)
    assert found == ["cameras a, b send no frames; check their cables"]


def test_a_camera_whose_process_hangs_is_not_sent_to_its_cable(config: BoothConfig) -> None:
    cameras = {name: _camera("streaming") for name in _CAMERAS}
    _problems(config, streaming=True, silent=["a"], cameras=cameras)
    _tell(config, "capture a", age_s=5.0)
    (problem,) = booth_health(config).problems
    assert problem.startswith("the capture a process has not reported for 5 s")


def test_a_camera_that_is_being_opened_is_no_problem(config: BoothConfig) -> None:
    cameras = {"a": _camera("opening"), "b": _camera("streaming")}
    assert _problems(config, streaming=True, silent=["a"], cameras=cameras) == []


def test_what_sync_says_of_its_disk_and_sensors_is_named(config: BoothConfig) -> None:
    cameras = {"a": _camera("streaming", trouble="it keeps sending the same picture")}
    words = "the spool's disk has not answered for 4 s"
    found = _problems(config, streaming=True, silent=[], cameras=cameras, problems=[words])
    assert found == ["camera a: it keeps sending the same picture", words]


def test_a_booth_that_was_stopped_is_told_in_one_sentence(config: BoothConfig) -> None:
    """Each process's last report was an alarm of its own."""
    for process in ("capture a", "capture b", "workers", "sync", "control"):
        _tell(config, process, age_s=60.0)
    _tell(config, "sync", age_s=60.0, problems=["the spool's disk has not answered for 4 s"])
    (problem,) = booth_health(config).problems
    assert problem.startswith("the booth is not running here; start it with: station run")
    _tell(config, "control")
    assert len(booth_health(config).problems) == 4


def test_a_booth_that_has_just_started_is_not_said_to_hang(config: BoothConfig) -> None:
    """Each process' last report was that of the day before."""
    for process in ("capture a", "capture b"):
        _tell(config, process, age_s=143.0)
    now_s = time.monotonic()
    _tell(config, "workers", started_s=now_s - 3.0)
    _tell(config, "sync", started_s=now_s - 2.0)
    assert starting(booth_health(config).processes) == {"capture a", "capture b", "control"}
    assert booth_health(config).problems == []
    # One that has reported since, and no more, hangs.
    _tell(config, "capture a", age_s=2.9 + MAX_AGE_S - 3.0, started_s=now_s - 3.0)
    _tell(config, "workers", started_s=now_s - 60.0)
    problems = booth_health(config).problems
    assert any("the capture b process has not reported for 143 s" in told for told in problems)


def test_a_recording_that_gives_nothing_is_not_sent_to_its_cable(config: BoothConfig) -> None:
    cameras = {"a": _camera("lost", "0.pgm is torn; record again"), "b": _camera("streaming")}
    (problem,) = _problems(config, streaming=True, silent=["a"], cameras=cameras)
    assert problem == "camera a sends no frames (0.pgm is torn; record again); check the recording"


@pytest.mark.parametrize(
    ("sets", "apart_s", "quiet_s", "flows_s", "told"),
    [
        (10, 0.25, 60.0, 60.0, False),
        (10, 0.4, 60.0, 60.0, True),
        (3, 0.1, 60.0, 60.0, True),
        # A camera was silent a moment ago: framesets have only begun.
        (3, 0.1, 1.0, 60.0, False),
        # The sensors have just been stopped.
        (3, 0.1, 60.0, -1.0, False),
    ],
)
def test_framesets_that_are_too_rare_for_a_scan_are_told(
    config: BoothConfig, sets: int, apart_s: float, quiet_s: float, flows_s: float, *, told: bool
) -> None:
    """Scans failed for it, and status said that all was well."""
    with sync_of(config) as sync:
        sync._silent_s = 100.0 - quiet_s
        sync._intake.last_frame_s.update(dict.fromkeys(_CAMERAS, time.monotonic() + flows_s))
        sync._set_times_s.extend(100.0 - apart_s * np.arange(sets)[::-1])
        words = sync._too_slow(100.0)
        assert bool(words) == told
        assert not told or "pictures of a scan came within 3 s: this computer is too busy" in words


def test_status_tells_by_its_exit_code_whether_scans_can_be_taken(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was 0 with a silent camera."""

    def code(*, streaming: bool, silent: Sequence[str] = ()) -> int:
        _problems(config, streaming=streaming, silent=silent, cameras={})
        told = {**asdict(booth_health(config)), "streaming": streaming}
        monkeypatch.setattr(asking, "ask", lambda *_: Reply(ok=True, content=told))
        path = str(config.runtime.folder.parent / "booth.toml")
        done = CliRunner().invoke(status_cli.status, ["--json", "--config", path])
        assert answered(done.stdout)
        return done.exit_code

    assert code(streaming=True) == 0
    assert code(streaming=True, silent=["a"]) == 1
    assert code(streaming=False, silent=["a"]) == 0
    config.calibration.unlink()
    assert code(streaming=True) == 1


def test_status_says_that_a_process_that_scans_need_is_starting(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It ended with 1, and without a reason."""
    now_s = time.monotonic()
    for process in ("capture a", "workers", "control"):
        _tell(config, process, started_s=now_s - 1.0)
    _tell(config, "sync", started_s=now_s - 1.0, silent=["b"], cameras={"b": _camera("off")})
    told = {**asdict(booth_health(config)), "streaming": False}
    monkeypatch.setattr(asking, "ask", lambda *_: Reply(ok=True, content=told))
    path = str(config.runtime.folder.parent / "booth.toml")
    monkeypatch.setattr(status_cli, "_show_status", lambda _: None)
    done = CliRunner().invoke(status_cli.status, ["--config", path])
    assert done.exit_code == 1
    assert done.output == "! the booth is starting; try again in a few seconds\n"


def test_status_tells_once_that_the_calibration_is_of_other_cameras(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if booth.toml has been edited since the station was begun."""
    path = config.runtime.folder.parent / "booth.toml"

    def shown(told: Sequence[str]) -> str:
        health = {**asdict(booth_health(config)), "streaming": True, "problems": told}
        monkeypatch.setattr(asking, "ask", lambda *_: Reply(ok=True, content=health))
        return CliRunner().invoke(status_cli.status, ["--config", str(path)]).output

    _problems(config, streaming=True, silent=[], cameras={})
    assert "!" not in shown([])
    path.write_text(path.read_text().replace('name = "b"', 'name = "c"'))
    _tell(config, "capture c")
    for told in ([], [unusable(load_config(path))]):
        assert shown(told).count("! camera b was calibrated and is not in booth.toml") == 1


def test_a_booth_that_goes_by_another_booth_toml_says_so(config: BoothConfig) -> None:
    """To put booth.toml back, as it was told to, did not help, and nothing said why."""
    path = config.runtime.folder.parent / "booth.toml"
    text = path.read_text()
    path.write_text(text.replace('name = "b"', 'name = "c"'))
    wrong = load_config(path)
    _problems(wrong, streaming=True, silent=[], cameras={})
    _tell(wrong, "capture c")
    [problem] = booth_health(wrong, path).problems
    assert problem.startswith("camera b was calibrated and is not in booth.toml")
    path.write_text(text)
    health = booth_health(wrong, path)
    assert health.problems[0].startswith("booth.toml was changed after the booth was started")
    assert health.problems[1] == problem
    assert not can_scan(config, {**asdict(health), "streaming": True})
    path.write_text(f"# A remark changes nothing.\n{text}")
    assert booth_health(config, path).problems == []
    path.unlink()
    [problem] = booth_health(config, path).problems
    assert "was changed" in problem


@pytest.mark.parametrize(
    "sync",
    [
        {"problems": ["camera a is sensor 2, but 1 was calibrated"]},
        {"cameras": {"a": _camera("streaming", trouble="it keeps sending the same picture")}},
    ],
)
def test_what_a_scan_is_refused_for_is_in_its_way(config: BoothConfig, sync: Any) -> None:
    _problems(config, streaming=True, silent=[], **sync)
    assert not can_scan(config, {**asdict(booth_health(config)), "streaming": True})


def test_a_calibration_of_other_cameras_and_a_full_disk_are_in_the_way_of_scans(
    config: BoothConfig,
) -> None:
    """The exit code of status was 0, and every scan was refused."""
    _problems(config, streaming=True, silent=[], cameras={})
    told = {**asdict(booth_health(config)), "streaming": True}
    assert can_scan(config, told)
    assert unusable(config) == ""
    _calibrate(config, ("a", "b", "c"))
    assert unusable(config).startswith("camera c was calibrated and is not in booth.toml; put")
    assert not can_scan(config, told)
    _calibrate(config, ("a", "c", "d"))
    assert unusable(config).startswith(
        "cameras c, d were calibrated and are not in booth.toml; camera b is in booth.toml and"
    )
    config.calibration.write_text('{"format": "booth-cal')
    assert not can_scan(config, told)
    assert "cannot be read as JSON" in unusable(config)
    _calibrate(config, _CAMERAS)
    config.spool.folder.mkdir()
    assert not can_scan(config, {**told, "free_bytes": 10_000})


def test_a_calibration_of_other_cameras_is_a_problem(config: BoothConfig) -> None:
    """Only the command told it; metrics counted no problem."""
    assert _problems(config, streaming=True, silent=[], cameras={}) == []
    _calibrate(config, ("a", "c"))
    (problem,) = booth_health(config).problems
    assert problem.startswith("camera c was calibrated and is not in booth.toml; camera b is in")
    # Sync may say the same of the sensors that it has seen.
    assert _problems(config, streaming=True, silent=[], cameras={}, problems=[problem]) == [problem]


def test_a_calibration_is_read_again_only_when_its_file_changed(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Health is asked for every second."""
    loaded: list[Path] = []
    load = Rig.load

    def counted(path: Path) -> Rig:
        loaded.append(path)
        return load(path)

    monkeypatch.setattr(Rig, "load", counted)
    for names, told in ((("a", "c"), True), (_CAMERAS, False)):
        loaded.clear()
        _calibrate(config, names)
        for _ in range(3):
            assert bool(unusable(config)) == told
        assert loaded == [config.calibration]


def test_a_silent_process_is_in_the_way_of_scans(config: BoothConfig) -> None:
    _problems(config, streaming=True, silent=[], cameras={})
    assert can_scan(config, {**asdict(booth_health(config)), "streaming": True})
    _tell(config, "capture a", age_s=5.0)
    assert not can_scan(config, {**asdict(booth_health(config)), "streaming": True})


def test_cancelled_scans_are_not_said_to_have_failed(config: BoothConfig) -> None:
    """Status and the metrics counted them as failures, and the page did not."""
    spool = Spool(config.spool.folder)
    path = config.runtime.folder.parent / "booth.toml"
    for scan_id in ("a", "b", "c"):
        bundle = spool.temporary(scan_id)
        bundle.mkdir()
        spool.submit(bundle, scan_id)
        assert spool.withdraw(scan_id_of(scan_id), "torn" if scan_id == "c" else CANCELLED)
    shown = CliRunner().invoke(status_cli.status, ["--config", str(path)]).output
    assert "spool: 1 failed, 2 cancelled;" in shown
    [scans] = [m for m in BoothCollector(config, path).collect() if m.name == "booth_scans"]
    assert {s.labels["state"]: s.value for s in scans.samples} == {"failed": 1, "cancelled": 2}
    spool.retry(scan_id_of("c"))
    assert booth_health(config).spool == {"queue": 1, "failed": 2}
    assert booth_health(config).cancelled == 2


def test_what_is_no_scan_does_not_wait_in_the_queue(config: BoothConfig) -> None:
    """A file there, which nobody reconstructs, was listed and counted as a scan that waits for
    ever."""
    spool = Spool(config.spool.folder)
    for state in ("queue", "work", "outbox"):
        spool.path(state, "notes-of-the-owner").write_text("")
        spool.path(state, "no scan.d").mkdir()
    os.utime(spool.path("queue", "notes-of-the-owner"), (0.0, 0.0))
    health = booth_health(config)
    assert (health.spool, health.oldest_waiting_s) == ({}, 0.0)
    assert ScanIndex(spool).find() == []


def test_workers_tell_what_is_stuck_by_a_clock_that_nobody_sets(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scan was said to be stuck where the clock was set while it was reconstructed."""
    Spool(config.spool.folder).path("work", "a").mkdir()
    tomorrow_s = time.time() + 86_400.0
    monkeypatch.setattr("station.booth.health.time.time", lambda: tomorrow_s)
    assert booth_health(config).stuck == []
    _tell(config, "workers", stuck=["a"])
    health = booth_health(config)
    assert health.stuck == ["a"]
    none = config.workers.model_copy(update={"count": 0})
    assert booth_health(config.model_copy(update={"workers": none})).stuck == []
    assert "scan a is stuck in work; see the workers' log" in health.problems


def test_a_scan_that_moves_on_while_it_is_looked_at_is_no_fault(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk was said to be unreadable and full, for as long as a worker took to claim a scan."""
    Spool(config.spool.folder)
    monkeypatch.setattr("station.booth.health.scans_of", lambda _: [ScanId("a")])
    health = booth_health(config)
    assert not [problem for problem in health.problems if "disk" in problem]
    assert health.free_bytes > 0


def test_a_console_that_only_starts_is_not_in_the_way_of_scans(config: BoothConfig) -> None:
    """Status ended with 1 for it, and said nothing."""
    shown = config.console.model_copy(update={"enabled": True})
    config = config.model_copy(update={"console": shown})
    assert _problems(config, streaming=True, silent=[], cameras={})
    health = booth_health(config)
    assert health.processes["console"] == {}
    assert can_scan(config, {**asdict(health), "streaming": True})


def test_status_shows_framesets_per_second(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its help promised them, and only JSON had a number of them."""
    path = str(config.runtime.folder.parent / "booth.toml")

    def shown(*, streaming: bool) -> str:
        _problems(config, streaming=streaming, silent=[], cameras={}, framesets_hz=29.97)
        told = {**asdict(booth_health(config)), "streaming": streaming}
        monkeypatch.setattr(asking, "ask", lambda *_: Reply(ok=True, content=told))
        return CliRunner().invoke(status_cli.status, ["--config", path]).output

    assert "framesets: 30 per second\n" in shown(streaming=True)
    assert "framesets" not in shown(streaming=False)
    with sync_of(config) as sync:
        assert sync._health()["framesets_hz"] == 0.0


def test_a_remark_is_shown_and_is_no_problem(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A monitor that counts problems raised an alarm for sensors that were a little warm."""
    words = "all cameras see the booth 0.09 % farther away than when they were calibrated"
    assert _problems(config, streaming=True, silent=[], cameras={}, remarks=[words]) == []
    told = {**asdict(booth_health(config)), "streaming": True}
    monkeypatch.setattr(asking, "ask", lambda *_: Reply(ok=True, content=told))
    path = str(config.runtime.folder.parent / "booth.toml")
    shown = CliRunner().invoke(status_cli.status, ["--config", path]).output
    assert f"! {words}\n" in shown


def test_status_says_of_no_result_that_it_was_handed_over(
    config: BoothConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All were "handed over" to a target that nobody reached, once their scans were deleted."""
    told = {**asdict(booth_health(config)), "streaming": False}
    told["processes"] = {"deliver": {"waiting": {"orders": 0, "share": 2}, "age_s": 0.0}}
    monkeypatch.setattr(asking, "ask", lambda *_: Reply(ok=True, content=told))
    path = str(config.runtime.folder.parent / "booth.toml")
    shown = CliRunner().invoke(status_cli.status, ["--config", path]).output
    assert "deliver orders: nothing to hand over\ndeliver share: 2 to hand over\n" in shown


def test_framesets_before_a_pause_do_not_count() -> None:
    times_s = [0.0, 0.1, 0.2, *(100.0 + np.arange(7) / 30)]
    assert rate_hz(times_s, 100.2) == pytest.approx(30.0)
    assert rate_hz(times_s, 103.0) == rate_hz([], 1.0) == rate_hz([0.5], 1.0) == 0.0


def test_control_answered_if_it_says_whether_the_sensors_run() -> None:
    told = {'{"streaming": false}': True, '{"streaming": null}': False, "[]": False, "": False}
    assert {text: answered(text) for text in told} == told
