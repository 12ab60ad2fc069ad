"""A booth on a machine of its own, and what technicians, power cuts and upgrades do to it.

The tests are one story, in order: each goes on where the one before it ended. Times are printed
against their bars; a slow machine fails none of them.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import pytest

from install.bars import TABLE
from install.machine import Machine
from station.core.service import answered

STATE = "/var/lib/booth"
_DELIVERED = (0, 3)
"""`station scan`: a result, or a result that says to scan again."""
_RESTART_BAR_S, _BOOT_BAR_S, _FIRST_SCAN_BAR_S, _SIZE_BAR_MB = 3.0, 15.0, 120.0, 250.0
_EXPOSURE_BAR = 1.5
_EXTENDING = Path(__file__).parents[2] / "docs/extending.md"
_DRIVERS = "/usr/local/lib/body-booth"


def _until(true: Callable[[], bool], what: str, limit_s: float = 300.0) -> float:
    """Wait; returns how long it took."""
    began_s = time.monotonic()
    while not true():
        assert time.monotonic() - began_s < limit_s, f"{what}: not within {limit_s:g} s"
        time.sleep(0.05)
    return time.monotonic() - began_s


def _services(machine: Machine) -> list[str]:
    options = ("--plain", "--no-legend", "--type=service", "--state=running")
    listed = machine.run("systemctl", "list-units", *options, "booth-*")
    return [line.split()[0] for line in listed.stdout.splitlines()]


def _shown(machine: Machine, unit: str) -> dict[str, str]:
    keys = "MainPID,NRestarts,ActiveState,SubState,WatchdogUSec"
    shown = machine.run("systemctl", "show", "-p", keys, unit).stdout
    return dict(line.split("=", 1) for line in shown.splitlines())


def _is_back(machine: Machine, unit: str, restarts: int) -> bool:
    shown = _shown(machine, unit)
    return int(shown["NRestarts"]) > restarts and shown["SubState"] == "running"


def _scan(machine: Machine, label: str) -> str:
    """Scan and wait for the result; returns the scan's id."""
    done = machine.run("station", "scan", "--label", label, "--timeout", "600", check=False)
    assert done.returncode in _DELIVERED, done.stdout + done.stderr
    found = re.search(r"^scan (\S+)", done.stdout, re.MULTILINE)
    assert found, done.stdout
    return found[1]


def _outbox(machine: Machine) -> set[str]:
    folder = machine.root / STATE.lstrip("/") / "spool/outbox"
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def _accepted(machine: Machine) -> set[str]:
    """Scans that the station has accepted, wherever they are by now."""
    spool = machine.root / STATE.lstrip("/") / "spool"
    states = ("queue", "work", "outbox", "failed")
    return {path.name for state in states for path in (spool / state).iterdir()}


def _status(machine: Machine) -> str:
    return machine.run("station", "status", "--json", check=False).stdout


def _ready(machine: Machine) -> None:
    """The sensors run and every camera gives frames."""
    _until(lambda: answered(_status(machine)), "control answers")
    machine.run("station", "start", "--timeout", "60")


def _kept(machine: Machine) -> dict[str, bytes]:
    """Read what an upgrade must not touch: configuration, calibration, results."""
    state = machine.root / STATE.lstrip("/")
    found = [machine.root / "etc/booth/booth.toml", state / "calibration.json"]
    found += [path for path in (state / "spool/outbox").rglob("*") if path.is_file()]
    return {str(path): path.read_bytes() for path in found}


@pytest.fixture(scope="module")
def untouched(machine: Machine) -> set[str]:
    """List the disk before anything is installed."""
    return machine.files()


def test_three_commands_lead_to_the_first_scan(
    machine: Machine, untouched: set[str], package: Path
) -> None:
    assert "usr/bin/station" not in untouched
    machine.put(package, f"/root/{package.name}")
    began_s = time.monotonic()
    machine.run("apt-get", "install", "-y", f"/root/{package.name}")
    setup = machine.run("station", "setup", "--virtual")
    assert "the console's password, shown only once" in setup.stdout
    assert "ready: station scan" in setup.stdout
    scan = _scan(machine, "first")
    TABLE.add("from apt install to the first scan", time.monotonic() - began_s, _FIRST_SCAN_BAR_S)
    for field in (f"SCAN={scan}", "CAMERA=front-upper"):
        assert machine.run("journalctl", "-q", "-o", "cat", field).stdout.strip(), field
    size = machine.run("dpkg-query", "-W", "-f", "${Installed-Size}", "body-booth").stdout
    TABLE.add("installed size", int(size) / 1000, _SIZE_BAR_MB, "MB")


def test_setup_again_changes_nothing(machine: Machine, prepared_before: Future[Path]) -> None:
    assert prepared_before  # the other package is built from now on
    before = _kept(machine), {unit: _shown(machine, unit) for unit in _services(machine)}
    assert ", kept" in machine.run("station", "setup").stdout
    assert before == (_kept(machine), {unit: _shown(machine, unit) for unit in _services(machine)})


def test_the_console_answers_and_asks_for_the_password(machine: Machine) -> None:
    fetch = (
        "import urllib.request as r; "
        "print(r.urlopen('http://127.0.0.1:8420/').status); r.urlopen('http://127.0.0.1:8420/api/v1/booth')"
    )
    answered = machine.run("/opt/booth/bin/python", "-c", fetch, check=False)
    assert answered.stdout.strip() == "200"
    assert "HTTP Error 401" in answered.stderr


def test_systemd_finds_nothing_wrong_with_the_installed_units(machine: Machine) -> None:
    units = machine.run("sh", "-c", "cd /usr/lib/systemd/system; ls -d booth*.* opt-booth*")
    names = [name.replace("@.", "@front-lower.") for name in units.stdout.split()]
    names = [name for name in names if not name.endswith(".d")]
    verified = machine.run("systemd-analyze", "verify", *names)
    assert verified.stdout + verified.stderr == ""
    services = [name for name in names if name.endswith(".service")]
    for unit in services:
        words = machine.run("systemd-analyze", "--no-pager", "security", unit).stdout
        found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", words)
        assert found, words
        TABLE.add(f"exposure of {unit}", float(found[1]), _EXPOSURE_BAR, "")
        assert float(found[1]) <= _EXPOSURE_BAR


def test_manuals_and_completion_are_there(machine: Machine) -> None:
    for page in ("station", "reconstruct", "booth-setup"):
        assert "station" in machine.run("man", "--pager=cat", page).stdout
    completed = machine.run(
        "env", "_STATION_COMPLETE=bash_complete", "COMP_WORDS=station sc", "COMP_CWORD=1", "station"
    )
    assert "scan" in completed.stdout


def test_a_killed_process_comes_back(machine: Machine) -> None:
    for unit in _services(machine):
        restarts = int(_shown(machine, unit)["NRestarts"])
        machine.run("systemctl", "kill", "-s", "KILL", "--kill-whom=main", unit)
        seconds = _until(lambda u=unit, n=restarts: _is_back(machine, u, n), unit)  # type: ignore[misc]
        TABLE.add(f"{unit} back after kill -9", seconds, _RESTART_BAR_S)
    _ready(machine)
    _scan(machine, "after kill -9")


def test_a_start_removes_nothing_that_another_process_writes(machine: Machine) -> None:
    writer = _shown(machine, "booth-workers")["MainPID"]
    made_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    written, left = (f"{STATE}/spool/tmp/probe.{pid}.{made_ns}" for pid in (writer, "999999999"))
    machine.run("install", "-d", "-o", "booth", "-g", "booth", written, left)
    for unit in ("booth-sync", "booth-control"):
        machine.run("systemctl", "restart", unit)
    place = machine.root / left.lstrip("/")
    _until(lambda: not place.exists(), "what a dead process left is removed")
    _ready(machine)
    machine.run("rmdir", written)


def test_notes_know_their_boot(machine: Machine) -> None:
    note = machine.root / STATE.lstrip("/") / "spool/scans" / f"{_scan(machine, 'a boot')}.json"
    assert json.loads(note.read_text())["boot"]


def test_a_process_that_hangs_is_started_anew(machine: Machine) -> None:
    """SIGSTOP to all at once; each has its own watchdog."""
    units = _services(machine)
    before = {unit: _shown(machine, unit) for unit in units}
    began_s = time.monotonic()
    for unit in units:
        machine.run("systemctl", "kill", "-s", "STOP", "--kill-whom=main", unit)
    for unit in units:
        restarts = int(before[unit]["NRestarts"])
        _until(lambda u=unit, n=restarts: _is_back(machine, u, n), unit)  # type: ignore[misc]
        watchdog_s = float(before[unit]["WatchdogUSec"].removesuffix("s"))
        seconds = time.monotonic() - began_s
        TABLE.add(f"{unit} back after SIGSTOP", seconds, 2 * watchdog_s)
    _ready(machine)
    _scan(machine, "after SIGSTOP")


@pytest.mark.parametrize("moment", ["capturing", "reconstructing"])
def test_a_reset_loses_no_accepted_scan(machine: Machine, moment: str) -> None:
    """Whatever was accepted is delivered after the boot, and nothing half-written is."""
    before = _outbox(machine)
    scan = machine.begin("station", "scan", "--label", f"reset while {moment}")
    if moment == "capturing":
        time.sleep(0.4)
    else:
        work = machine.root / STATE.lstrip("/") / "spool/work"
        # The bundle of the scan before may still be there.
        _until(lambda: any(p.name not in before for p in work.iterdir()), "a scan is claimed")
    machine.reset()
    scan.wait(timeout=10)
    accepted = _accepted(machine)
    assert moment == "capturing" or accepted - before
    began_s = time.monotonic()
    machine.boot()
    _ready(machine)
    TABLE.add("from power on to ready to scan", time.monotonic() - began_s, _BOOT_BAR_S)
    _until(lambda: accepted <= _outbox(machine), "accepted scans are delivered")
    for scan_id in _outbox(machine):
        folder = machine.root / STATE.lstrip("/") / "spool/outbox" / scan_id
        assert json.loads((folder / "result.json").read_text())["scan_id"] == scan_id
    _scan(machine, "after a reset")


def test_upgrade_and_downgrade_keep_what_the_shop_has(
    machine: Machine, package: Path, package_before: Path
) -> None:
    before = _kept(machine)
    # A command that still runs: systemd told of a job that failed, and yet the booth was upgraded.
    busy = machine.begin("/opt/booth/bin/python", "-c", "import time; time.sleep(3600)")
    for step in (package_before, package):
        machine.put(step, f"/root/{step.name}")
        install = ("apt-get", "install", "-y", "--allow-downgrades", f"/root/{step.name}")
        assert "failed" not in machine.run(*install).stderr
        assert busy.poll() is None
        _ready(machine)
        assert _kept(machine) == before
    busy.kill()
    _, version, _ = package.name.split("_")
    assert machine.run("station", "--version").stdout.split()[-1] == version
    _scan(machine, "after an upgrade")


def test_unknown_formats_are_refused_and_the_booth_goes_on(
    machine: Machine, package_before: Path
) -> None:
    """An older package once would have met files that it cannot read, and a booth that was stopped
    had no commands until the next boot."""
    install = ("apt-get", "install", "-y", "--allow-downgrades", f"/root/{package_before.name}")
    for name, running in (("state.json", True), ("calibration.json", False)):
        if not running:
            machine.run("systemctl", "stop", "booth.target")
        path = machine.root / STATE.lstrip("/") / name
        known = path.read_text()
        path.write_text(re.sub('"version": 1', '"version": 99', known, count=1))
        refused = machine.run(*install, check=False)
        path.write_text(known)
        assert refused.returncode != 0
        assert f"{name} has version 99" in refused.stdout + refused.stderr
        machine.run("station", "--version")
        if not running:
            machine.run("systemctl", "start", "booth.target")
        _ready(machine)
    _scan(machine, "after a refused downgrade")


def test_a_backup_makes_another_machine_the_same_booth(
    machine: Machine, base: Path, package: Path, tmp_path: Path
) -> None:
    machine.run("systemctl", "stop", "booth.target")
    machine.run("mkdir", "/root/usb")
    machine.run("station", "backup", "/root/usb", "--with-scans")
    other = Machine(base, tmp_path / "other")
    try:
        other.boot()
        other.put(package, f"/root/{package.name}")
        other.run("apt-get", "install", "-y", f"/root/{package.name}")
        other.put(machine.root / "root/usb", "/root/usb")
        # Compiled code comes along: it takes a minute to make and is not what is tested here.
        other.put(machine.root / "var/cache/booth/numba", "/var/cache/booth", owner="booth:")
        (saved,) = (other.root / "root/usb").iterdir()
        other.run("station", "restore", f"/root/usb/{saved.name}")
        assert "ready: station scan" in other.run("station", "setup").stdout
        assert _outbox(other) == _outbox(machine)
        _scan(other, "on the other machine")
    finally:
        other.close()
        machine.run("systemctl", "start", "booth.target")


def test_a_driver_of_another_sensor_streams(machine: Machine, tmp_path: Path) -> None:
    """The example of the documents, as a shop would add it."""
    blocks = re.findall(r"```(?:toml|python)\n(.*?)```", _EXTENDING.read_text(), re.DOTALL)[:3]
    project, driver, cameras = blocks
    assert all("myrig" in block for block in (project, driver.lower(), cameras))
    (tmp_path / "pyproject.toml").write_text(project)
    (tmp_path / "myrig.py").write_text(driver)
    build = ("wheel", "--quiet", "--no-index", "--no-deps", "--no-build-isolation")
    subprocess.run(
        [sys.executable, "-m", "pip", *build, "--wheel-dir", tmp_path, tmp_path], check=True
    )
    [wheel] = tmp_path.glob("*.whl")
    machine.put(wheel, f"/root/{wheel.name}")
    unpack = f"umask 022 && python3 -m zipfile -e /root/{wheel.name} {_DRIVERS}"
    machine.run("sh", "-c", unpack)
    config = machine.root / "etc/booth/booth.toml"
    known = config.read_text()
    config.write_text(known + "\n" + cameras.replace("front-upper", "fifth"))
    try:
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "restart", "booth.target")
        _ready(machine)
        told = json.loads(_status(machine))
        assert told["sync"]["cameras"]["fifth"]["state"] == "streaming"
        assert "booth-capture@fifth.service" in _services(machine)
    finally:
        config.write_text(known)
        machine.run("systemctl", "stop", "booth.target")
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "start", "booth.target")
        machine.run("rm", "-r", _DRIVERS)
        # This Debian has no /usr/local.
        machine.run("rmdir", "--parents", "--ignore-fail-on-non-empty", str(Path(_DRIVERS).parent))


def test_purge_leaves_nothing(machine: Machine, untouched: set[str]) -> None:
    machine.run("apt-get", "purge", "-y", "body-booth")
    left = {
        path
        for path in machine.files() - untouched
        if not path.startswith(("root", "var/lib/dpkg", "var/cache/debconf", "var/cache/man"))
    }
    # Debian's Python keeps the byte code of its own library.
    left = {path for path in left if not path.startswith("usr/lib/python3")}
    assert {path for path in left if not path.endswith(("-", ".old"))} == set()
    assert machine.run("id", "booth", check=False).returncode != 0
    assert machine.run("losetup", "-a").stdout.count("body-booth") == 0
