import importlib
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from ctrl_c import heard
from waiting import wait_until

from station import cli as station_cli
from station.core.commands import LazyGroup, Number, run
from station.core.errors import InputError
from station.core.files import private_folder
from workers import cli as workers_cli

_ALL = [
    (group, name)
    for group, commands in (
        (station_cli.station, station_cli.COMMANDS),
        (workers_cli.reconstruct, workers_cli.COMMANDS),
    )
    for name in commands
]


@pytest.mark.parametrize(("group", "name"), _ALL)
def test_every_command_explains_itself(group: click.Group, name: str) -> None:
    result = CliRunner().invoke(group, [name, "--help"])
    assert result.exit_code == 0, result.output
    assert "Examples:" in result.output


@pytest.mark.parametrize(
    "words",
    [
        "calibrate --new --list",
        "calibrate --new --use 20261121T100000Z",
        "calibrate --list --recordings .",
        "check --correct --recordings .",
        "check --correct --json",
        "setup --virtual --camera front-upper=A1",
    ],
)
def test_options_that_exclude_each_other_are_refused(words: str) -> None:
    """All but one of them were ignored."""
    done = CliRunner().invoke(station_cli.station, words.split())
    assert done.exit_code == 2
    assert ", not both" in done.output
    assert "starting" not in done.output


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("nan", "nan is not a number above 0 up to 90 days."),
        ("inf", "inf is not a number above 0 up to 90 days."),
        ("two", "two is not a number above 0 up to 90 days."),
        ("1,5", "1,5 is not a number above 0 up to 90 days (write a point, 1.8)."),
        ("0", "0 is not above 0 up to 90 days."),
        ("100", "100 is not above 0 up to 90 days."),
    ],
)
def test_a_number_is_finite_and_in_its_range(given: str, words: str) -> None:
    """A token of nan days would never expire."""

    @click.command()
    @click.option("--days", type=Number(0.0, 90.0, min_open=True, unit="days"))
    def command(days: float) -> None:
        click.echo(f"{days:.2f}")

    refused = CliRunner().invoke(command, ["--days", given])
    assert refused.exit_code == 2
    assert words in refused.output
    assert CliRunner().invoke(command, ["--days", "1.5"]).output == "1.50\n"


def test_a_number_without_an_end_says_so() -> None:
    """The words were "from 0 or more metres"."""

    @click.command()
    @click.option("--height", type=Number(0.0, unit="metres"))
    def command(height: float) -> None:
        click.echo(f"{height:.2f}")

    refused = CliRunner().invoke(command, ["--height", "-1"])
    assert "-1 is not from 0 metres up." in refused.output
    assert CliRunner().invoke(command, ["--height", "7e9"]).exit_code == 0


@pytest.mark.parametrize("group", [station_cli.station, workers_cli.reconstruct])
def test_help_lists_every_command_without_importing_it(
    group: LazyGroup, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"--help imported {name}")

    monkeypatch.setattr(importlib, "import_module", refuse)
    result = CliRunner().invoke(group, ["--help"])
    assert result.exit_code == 0
    assert all(name in result.output for name in group.list_commands(click.Context(group)))


def test_a_full_disk_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @click.group(invoke_without_command=True)
    def write() -> None:
        with Path("/dev/full").open("w") as full:
            full.write("x")

    monkeypatch.setattr(sys, "argv", ["write"])
    with pytest.raises(SystemExit, match="1"):
        run(write)
    told = capsys.readouterr().err
    assert told.startswith("error: the disk cannot be written (No space left on device)")
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("place", "words"),
    [("/" + 300 * "a", "File name too long"), ("/proc/x", "No such file or directory")],
)
def test_a_place_that_cannot_be_used_is_one_line(
    place: str, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder of booth.toml that cannot be made ended every command with a traceback."""

    @click.group(invoke_without_command=True)
    def make() -> None:
        private_folder(Path(place))

    monkeypatch.setattr(sys, "argv", ["make"])
    with pytest.raises(SystemExit, match="1"):
        run(make)
    told = capsys.readouterr().err
    assert f"{place} cannot be used ({words}); check its name" in told
    assert told.count("\n") == 1


@pytest.mark.parametrize(
    ("group", "words"),
    [
        (station_cli.station, ["record-virtual", "--out", "/proc/x"]),
        (workers_cli.reconstruct, ["train", "--out", "/proc/x/body.npz"]),
        (workers_cli.reconstruct, ["evaluate-model", "--pictures", "/proc/x"]),
    ],
)
def test_a_folder_that_cannot_be_written_is_told_before_the_work(
    group: click.Group, words: list[str]
) -> None:
    """A model was learned for minutes before its file could not be made."""
    done = CliRunner().invoke(group, words)
    assert isinstance(done.exception, InputError)
    assert "/proc/x cannot be written (No such file or directory); name another folder with " in (
        str(done.exception)
    )


def test_a_folder_is_no_file_for_a_model(tmp_path: Path) -> None:
    done = CliRunner().invoke(workers_cli.reconstruct, ["train", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "is a directory" in done.output


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_told_to_end_leaves_no_folder(
    tmp_path: Path, number: signal.Signals
) -> None:
    """Half a result stayed beside --out, also where its terminal was closed."""
    source = (
        "import click, tempfile, time\n"
        "from station.core.commands import run\n"
        "@click.group(invoke_without_command=True)\n"
        "def wait():\n"
        f"    with tempfile.TemporaryDirectory(dir={str(tmp_path)!r}):\n"
        "        print('waits', flush=True)\n"
        "        time.sleep(60)\n"
        "run(wait)\n"
    )
    command = [sys.executable, "-c", source]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, text=True, preexec_fn=heard) as waiting:
        assert waiting.stdout is not None
        assert waiting.stdout.readline() == "waits\n"
        waiting.send_signal(number)
        assert waiting.wait(20.0) == -number
    assert list(tmp_path.iterdir()) == []


def test_a_command_under_nohup_outlives_its_terminal() -> None:
    source = (
        "import click, signal\n"
        "from station.core.commands import run\n"
        "from station.core.service import stop_event\n"
        "@click.group(invoke_without_command=True)\n"
        "def stays():\n"
        "    stop = stop_event()\n"
        "    signal.raise_signal(signal.SIGHUP)\n"
        "    print('stopped' if stop.is_set() else 'stays')\n"
        "run(stays)\n"
    )
    ignoring = f"import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); exec({source!r})"
    said = [
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            preexec_fn=heard,
        ).stdout
        for code in (source, ignoring)
    ]
    assert said == ["stopped\n", "stays\n"]


def test_rendering_that_is_told_to_end_leaves_no_semaphores(tmp_path: Path) -> None:
    """Python complained of five of them after the command had ended."""
    command = [
        sys.executable,
        "-m",
        "station.cli",
        "record-virtual",
        "--out",
        str(tmp_path / "out"),
    ]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as rendering:
        wait_until(lambda: any(tmp_path.glob("out/*/d-*.pgm")), "a picture")
        rendering.terminate()
        _, told = rendering.communicate(timeout=60.0)
    assert rendering.returncode == -signal.SIGTERM
    assert told == b""


def test_a_calibration_is_not_recorded_that_would_be_refused(tmp_path: Path) -> None:
    """A camera saw the ball too seldom in 10 s, which was told after minutes of rendering."""
    words = ["record-virtual", "--out", str(tmp_path), "--calibration", "10"]
    done = CliRunner().invoke(station_cli.station, words)
    assert done.exit_code == 2
    assert "10 is not from 16 up to 600 seconds" in done.output


@pytest.mark.parametrize("name", ["booth.toml", "true-calibration.json", "back-upper"])
def test_a_booth_is_not_recorded_over(tmp_path: Path, name: str) -> None:
    """Recordings and the configuration of another booth were replaced without a word."""
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=f"{name} exists already; name a new folder with --out"):
        CliRunner().invoke(
            station_cli.station, ["record-virtual", "--out", str(tmp_path)], catch_exceptions=False
        )
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_rendering_that_is_interrupted_says_what_is_left(tmp_path: Path) -> None:
    """As a terminal does, Ctrl-C goes to the renderers too: each showed a traceback."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "station.cli", "record-virtual", "--out", str(out)]
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heard,
    ) as rendering:
        wait_until(lambda: any(out.glob("*/d-*.pgm")), "a picture")
        os.killpg(rendering.pid, signal.SIGINT)
        _, told = rendering.communicate(timeout=60.0)
    assert rendering.returncode == -signal.SIGINT
    told, count = re.subn(r"\([0-3] of 4 recordings\)", "(some)", told)
    assert count == 1
    assert told == f"stopped; {out} is incomplete (some): delete it before you record there again\n"


def _listening(modules: Path, *arguments: str) -> subprocess.Popen[str]:
    """A Python process that hears Ctrl-C and finds the modules of a folder first."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": str(modules)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heard,
    )


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("click", ["-m", "station.cli"]),
        ("click", ["-m", "workers.cli"]),
        (
            "slow",
            [
                "-c",
                "from station.core.commands import LazyGroup, run; "
                "run(LazyGroup(lazy={'it': ('slow:it', '')}))",
                "it",
            ],
        ),
    ],
)
def test_a_command_that_is_interrupted_while_it_loads_is_silent(
    tmp_path: Path, module: str, command: list[str]
) -> None:
    """Ctrl-C in the first half second showed a traceback."""
    source = "import time\nprint('loads', flush=True)\ntime.sleep(60)\n"
    (tmp_path / f"{module}.py").write_text(source)
    with _listening(tmp_path, *command) as starting:
        assert starting.stdout is not None
        assert starting.stdout.readline() == "loads\n"
        starting.send_signal(signal.SIGINT)
        assert starting.communicate(timeout=20.0) == ("", "")
    # 130 in a shell.
    assert starting.returncode == -signal.SIGINT


@pytest.mark.parametrize("waits", ["time.sleep(60)", "click.confirm('Delete?')"])
def test_a_command_that_is_interrupted_is_silent(tmp_path: Path, waits: str) -> None:
    """Most ended with "Aborted!" and 1, as if something had failed."""
    source = (
        f"import click, time\n@click.command\ndef it():\n    click.echo('works')\n    {waits}\n"
    )
    (tmp_path / "slow.py").write_text(source)
    group = "run(LazyGroup(lazy={'it': ('slow:it', '')}))"
    words = f"from station.core.commands import *; {group}"
    with _listening(tmp_path, "-c", words, "it") as working:
        assert working.stdout is not None
        assert working.stdout.readline() == "works\n"
        time.sleep(0.5)
        working.send_signal(signal.SIGINT)
        assert working.communicate(timeout=20.0)[1] == ""
    assert working.returncode == -signal.SIGINT


def test_a_users_error_is_one_line_and_exit_code_1(tmp_path: Path) -> None:
    """A traceback once told an operator nothing about the file that was missing."""
    missing = tmp_path / "booth.toml"
    done = subprocess.run(
        [sys.executable, "-m", "station.cli", "capture", "front", "--config", str(missing)],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {missing} cannot be read")
    assert done.stderr.count("\n") == 1


def test_a_command_is_loaded_in_any_thread() -> None:
    """Only the main thread may change how Ctrl-C is handled: others ended with a ValueError."""
    with ThreadPoolExecutor(1) as threads:
        done = threads.submit(CliRunner().invoke, station_cli.station, ["list", "--help"]).result()
    assert done.exit_code == 0, done.output
