"""The units: what they start exists, systemd finds nothing wrong, and they may do little else."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from station.administration import booth_file
from station.booth.supervisor import services
from station.cli import COMMANDS as STATION
from station.core.config_file import load_config
from workers.cli import COMMANDS as RECONSTRUCT

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "systemd"
COMMON = UNITS / "booth-.service.d/10-common.conf"
SERVICES = sorted(UNITS.glob("booth-*.service"))
_HIDDEN = {"booth-capture@", "booth-deliver", "booth-drift"}
"""Services that neither remove what others left nor compare boots."""
MAX_EXPOSURE = 1.5
"""systemd-analyze's exposure, from 0 (safe) to 10."""


def _read(*paths: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment]
    parser.read(paths)
    return parser


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_a_unit_starts_a_command_that_exists(path: Path) -> None:
    program, command, *_ = _read(path)["Service"]["ExecStart"].split()
    assert Path(program).parent == Path("/opt/booth/bin")
    assert command in {"station": STATION, "reconstruct": RECONSTRUCT}[Path(program).name]


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_a_service_comes_back_whatever_happens(path: Path) -> None:
    """After five quick deaths systemd once gave up for good."""
    unit = _read(path, COMMON)
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"
    assert unit["Unit"]["PartOf"] == "booth.target"
    if unit["Service"]["Type"] != "oneshot":
        assert unit["Service"]["Type"] == "notify"
        assert unit["Service"]["Restart"] == "always"
        assert float(unit["Service"]["RestartSec"]) <= 2.0
        assert float(unit["Service"]["WatchdogSec"]) <= 60.0
        assert int(unit["Service"]["MemoryMax"][:-1]) > 0


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_proc_is_hidden_where_nobody_looks_at_it(path: Path) -> None:
    """Each removed at its start, and control every ten minutes, what the others were writing, and
    a day without power counted as none."""
    hidden = {"ProtectProc": "invisible", "ProcSubset": "pid"}
    found = {key: value for key, value in _read(path, COMMON)["Service"].items() if key in hidden}
    assert found == (hidden if path.stem in _HIDDEN else {})


def test_pauses_are_written_as_sleep_reads_them() -> None:
    """systemd's "20min" ended the drift check before it began."""
    pauses = [
        pause
        for path in SERVICES
        for pause in re.findall(r"^Exec\w+=sleep (.*)$", path.read_text(), re.MULTILINE)
    ]
    assert pauses
    for pause in pauses:
        assert re.fullmatch(r"\d+[smh]?", pause)


def test_the_target_wants_units_that_exist() -> None:
    wanted = [
        name
        for line in (UNITS / "booth.target").read_text().splitlines()
        if line.startswith("Wants=")
        for name in line.removeprefix("Wants=").split()
    ]
    assert wanted
    assert {name for name in wanted if not (UNITS / name).exists()} == set()


def test_every_camera_of_the_configuration_gets_its_service(tmp_path: Path) -> None:
    """The names of the cameras once stood in the target itself."""
    config = tmp_path / "booth.toml"
    cameras = booth_file.name_cameras(["A", "B"], ["porch=B"])
    config.write_text(booth_file.booth_toml(cameras, installed=True))
    program = (UNITS / "booth-generator").read_text()
    generator = tmp_path / "generator"
    generator.write_text(program.replace(f'"{booth_file.CONFIG}"', f'"{config}"'))
    assert str(config) in generator.read_text()
    subprocess.run([sys.executable, generator, tmp_path / "out"], check=True)
    made = {path.name for path in (tmp_path / "out/booth.target.wants").iterdir()}
    captures = {"booth-capture@front-lower.service", "booth-capture@porch.service"}
    assert made == captures | {"booth-console.service"}


def test_console_and_deliver_run_as_the_configuration_says(tmp_path: Path) -> None:
    """`station run` and systemd start the same processes."""
    config = tmp_path / "booth.toml"
    cameras = booth_file.name_cameras(["A"], [])
    text = booth_file.booth_toml(cameras, installed=False)
    config.write_text(f'{text}[console]\nenabled = false\n[[deliver]]\nname = "d"\nfolder = "d"\n')
    program = (UNITS / "booth-generator").read_text()
    generator = tmp_path / "generator"
    generator.write_text(program.replace(f'"{booth_file.CONFIG}"', f'"{config}"'))
    subprocess.run([sys.executable, generator, tmp_path / "out"], check=True)
    made = {path.stem for path in (tmp_path / "out/booth.target.wants").iterdir()}
    fixed = re.findall(r"booth-\w+(?=\.service)", (UNITS / "booth.target").read_text())
    units = {
        name.removeprefix("booth-").replace("capture@", "capture ") for name in made | {*fixed}
    }
    assert units == {service.name for service in services(load_config(config))}


@pytest.mark.parametrize("text", ["", "[[cameras", "cameras = 3", "[[cameras]]\nserial = 'A'"])
def test_a_configuration_without_cameras_does_not_stop_the_boot(tmp_path: Path, text: str) -> None:
    config, log = tmp_path / "booth.toml", tmp_path / "kmsg"
    config.write_text(text)
    program = (UNITS / "booth-generator").read_text().replace("/dev/kmsg", str(log))
    generator = tmp_path / "generator"
    generator.write_text(program.replace(f'"{booth_file.CONFIG}"', f'"{config}"'))
    subprocess.run([sys.executable, generator, tmp_path / "out"], check=True)
    assert "names no cameras" in log.read_text()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The units as the package installs them, in a root of their own."""
    folder = tmp_path_factory.mktemp("root")
    place = folder / "usr/lib/systemd/system"
    shutil.copytree(UNITS, place)
    (place / "booth-generator").unlink()
    programs = folder / "opt/booth/bin"
    programs.mkdir(parents=True)
    for name in ("station", "reconstruct"):
        (programs / name).write_text("#!/bin/sh\n")
        (programs / name).chmod(0o755)
    # The targets and slices that every unit refers to.
    for source in Path("/usr/lib/systemd/system").glob("*.target"):
        shutil.copy(source, place, follow_symlinks=True)
    (folder / "etc").mkdir()
    (folder / "etc/passwd").write_text("root:x:0:0::/:/bin/sh\nbooth:x:900:900::/:/bin/sh\n")
    (folder / "etc/group").write_text("root:x:0:\nbooth:x:900:\nplugdev:x:46:\n")
    return folder


def test_systemd_finds_nothing_wrong(root: Path) -> None:
    names = [path.name.replace("@.", "@front.") for path in sorted(UNITS.glob("*.*"))]
    names = [name for name in names if not name.endswith(".d")]
    done = subprocess.run(
        ["systemd-analyze", f"--root={root}", "verify", "--man=no", *names],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout + done.stderr == ""
    assert done.returncode == 0


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.name)
def test_a_service_may_do_little_beside_its_work(root: Path, path: Path) -> None:
    name = path.name.replace("@.", "@front.")
    limit = f"--threshold={round(10 * MAX_EXPOSURE)}"
    done = subprocess.run(
        ["systemd-analyze", f"--root={root}", "security", "--offline=true", limit, name],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout.splitlines()[-1]
    assert "Overall exposure level" in done.stdout
