"""The version names the commit, of a checkout and of what is built."""

import os
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner

import station
from station.cli import station as station_command
from workers.cli import reconstruct

ROOT = Path(__file__).parents[2]


def _told(folder: Path) -> str:
    """Version of the programs in a folder."""
    told = subprocess.check_output(
        [sys.executable, "-c", "import station; print(station.version())"],
        env={**os.environ, "PYTHONPATH": str(folder)}, cwd=folder, text=True,
    )  # fmt: skip
    return told.strip()


def test_the_version_names_the_commit() -> None:
    """It was 0.1.0 whatever was installed."""
    head = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=ROOT, text=True)
    for command in (station_command, reconstruct):
        told = CliRunner().invoke(command, ["--version"]).output.strip()
        assert told.startswith(f"{command.name}, version {station.__version__}+git20")
        assert told.endswith(f".{head[:7]}")


def test_what_is_built_names_the_commit_that_it_is_of(tmp_path: Path) -> None:
    archive = ["git", "archive", "HEAD", "station/__init__.py"]
    packed = subprocess.check_output(archive, cwd=ROOT)
    subprocess.run(["tar", "-x", "-C", tmp_path], input=packed, check=True)
    assert _told(tmp_path) == station.version()
    # A copy that git did not make.
    (tmp_path / "station/__init__.py").write_bytes((ROOT / "station/__init__.py").read_bytes())
    assert _told(tmp_path) == station.__version__
