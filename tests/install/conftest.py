"""The package of this commit and of the one before, and a machine to install them on."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from install.bars import TABLE
from install.debian_root import base_root
from install.machine import Machine
from install.places import DEBIAN, ROOT, WORK, dependencies_of_package

_SUITE_BAR_S = 300.0
_BEGAN_S = time.monotonic()


def build(commit: str, out: Path, work: Path) -> Path:
    """The Debian package of a commit, made with its wheel and source distribution in `out`."""
    command = [sys.executable, str(ROOT / "deploy/package/build.py"), "--commit", commit]
    folders = ["--out", str(out), "--work", str(work), "--keep", str(WORK / "dependencies")]
    subprocess.run([*command, *folders], check=True, stdout=subprocess.DEVNULL)
    (package,) = out.glob("body-booth_*.deb")
    return package


def _package(revision: str) -> Path:
    words = ["git", "rev-parse", "--verify", revision]
    commit = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    out = WORK / "packages" / commit.stdout.strip()
    made = list(out.glob("body-booth_*.deb"))
    return made[0] if made else build(revision, out, WORK / "build" / out.name)


@pytest.fixture(scope="session")
def prepared() -> Iterator[tuple[Future[Path], Future[Path]]]:
    """Packages of this commit and of the one before, built while the machine is made."""
    with ThreadPoolExecutor(1) as builder:
        yield builder.submit(_package, "HEAD"), builder.submit(_package, "HEAD~1")


@pytest.fixture(scope="session")
def package(prepared: tuple[Future[Path], Future[Path]]) -> Path:
    """The Debian package of this commit (what is not committed is not in it)."""
    return prepared[0].result()


@pytest.fixture(scope="session")
def package_before(prepared: tuple[Future[Path], Future[Path]]) -> Path:
    """The Debian package of the commit before."""
    return prepared[1].result()


@pytest.fixture(scope="session")
def base(prepared: tuple[Future[Path], Future[Path]]) -> Path:
    """A minimal Debian with the package's dependencies and nothing of the booth."""
    assert prepared
    return base_root(DEBIAN, dependencies_of_package())


@pytest.fixture(scope="module")
def machine(base: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A fresh machine that has booted."""
    made = Machine(base, tmp_path_factory.mktemp("machine"))
    try:
        made.boot()
        yield made
    finally:
        made.close()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the bars."""
    TABLE.add("the whole suite", time.monotonic() - _BEGAN_S, _SUITE_BAR_S)
    terminalreporter.section("bars")
    terminalreporter.write_line(str(TABLE))
