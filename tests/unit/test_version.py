"""The version names the commit, of a checkout and of what is built."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner

import station
from station.cli import station as station_command
from workers.cli import reconstruct

ROOT = Path(__file__).parents[2]


def _told(folder: Path, **environment: str) -> str:
    """Version of the programs in a folder."""
    told = subprocess.check_output(
        [sys.executable, "-c", "import station; print(station.version())"],
        env={**os.environ, "PYTHONPATH": str(folder), **environment}, cwd=folder, text=True,
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


def test_a_checkout_names_its_own_commit_whatever_is_set_for_git(tmp_path: Path) -> None:
    """In a hook of another repository it named a commit of that one; where `git log` shows
    signatures, nothing that asks for the version worked."""
    other, git = tmp_path / "other", tmp_path / "bin/git"
    subprocess.run(["git", "init", "-q", other], check=True)
    git.parent.mkdir()
    git.write_text(
        '#!/bin/sh\ncase "$*" in *log*) echo "No signature" ;; esac\n'
        f'exec {shutil.which("git")} "$@"\n'
    )
    git.chmod(0o755)
    path = f"{git.parent}:{os.environ['PATH']}"
    assert _told(ROOT, GIT_DIR=f"{other}/.git", PATH=path) == station.version()
    assert "+git" in station.version()
    # Without git.
    assert _told(ROOT, PATH=str(other)) == station.__version__
