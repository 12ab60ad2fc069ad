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


def build(commit: str, out: Path, work: Path, nice: int) -> Path:
    """The Debian package of a commit, made with its wheel and source distribution in `out`."""
    python = ["nice", "-n", str(nice), sys.executable]
    command = [*python, str(ROOT / "deploy/package/build.py"), "--commit", commit]
    folders = ["--out", str(out), "--work", str(work), "--keep", str(WORK / "dependencies")]
    subprocess.run([*command, *folders], check=True, stdout=subprocess.DEVNULL)
    (package,) = out.glob("body-booth_*.deb")
    return package


def _package(revision: str, nice: int = 0) -> Path:
    words = ["git", "rev-parse", "--verify", revision]
    commit = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    out = WORK / "packages" / commit.stdout.strip()
    made = list(out.glob("body-booth_*.deb"))
    return made[0] if made else build(revision, out, WORK / "build" / out.name, nice)


@pytest.fixture(scope="session")
def builder() -> Iterator[ThreadPoolExecutor]:
    """A thread that builds one package after the other."""
    with ThreadPoolExecutor(1) as builds:
        yield builds


@pytest.fixture(scope="session")
def prepared(builder: ThreadPoolExecutor) -> Future[Path]:
    """The package of this commit, built while the machine is made."""
    return builder.submit(_package, "HEAD")


@pytest.fixture(scope="session")
def prepared_before(builder: ThreadPoolExecutor) -> Future[Path]:
    """The package of the commit before, built while tests wait for processes."""
    return builder.submit(_package, "HEAD~1", nice=19)


@pytest.fixture(scope="session")
def package(prepared: Future[Path]) -> Path:
    """The Debian package of this commit (what is not committed is not in it)."""
    return prepared.result()


@pytest.fixture(scope="session")
def package_before(prepared_before: Future[Path]) -> Path:
    """The Debian package of the commit before."""
    return prepared_before.result()


@pytest.fixture(scope="session")
def base(prepared: Future[Path]) -> Path:
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
