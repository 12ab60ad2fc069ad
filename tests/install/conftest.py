"""The package of this commit and of the one before, and a machine to install them on."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from install.machine import Machine, base_root

ROOT = Path(__file__).parents[2]
BODY = ROOT / "station/simulation/bodies/ann.npz"
_WORK = Path(os.environ.get("BOOTH_TEST_INSTALL", ROOT / "build/test-install"))
"""Folder in which roots, packages and recordings are kept between two calls."""


def _package(commit: str) -> Path:
    name = subprocess.run(
        ["git", "rev-parse", commit], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    out = _WORK / "packages" / name
    if not list(out.glob("body-booth_*.deb")):
        build = [sys.executable, str(ROOT / "deploy/package/build.py"), "--commit", name]
        folders = ["--out", str(out), "--work", str(_WORK / "build")]
        subprocess.run([*build, *folders], check=True)
    (package,) = out.glob("body-booth_*.deb")
    return package


@pytest.fixture(scope="session")
def package() -> Path:
    """The Debian package of this commit (what is not committed is not in it)."""
    return _package("HEAD")


@pytest.fixture(scope="session")
def package_before() -> Path:
    """The Debian package of the commit before."""
    return _package("HEAD~1")


@pytest.fixture(scope="session")
def recordings() -> Path:
    """A virtual booth with a person and its calibration."""
    folder = _WORK / "recordings"
    if not (folder / "calibration.json").exists():
        record = [sys.executable, "-m", "station.cli", "record-virtual"]
        options = ["--body", str(BODY), "--out", str(folder), "--frames", "12", "--passes", "150"]
        subprocess.run([*record, *options], check=True, stdout=subprocess.DEVNULL)
    return folder


@pytest.fixture(scope="session")
def base() -> Path:
    """A minimal Debian with the package's dependencies and nothing of the booth."""
    control = (ROOT / "deploy/package/body-booth/control").read_text()
    (depends,) = re.findall(r"^Depends: (.*)$", control, re.MULTILINE)
    names = [re.split(r"[ (|]", entry.strip())[0] for entry in depends.split(",")]
    return base_root(_WORK / "debian", names)


@pytest.fixture(scope="module")
def machine(base: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A fresh machine that has booted."""
    made = Machine(base, tmp_path_factory.mktemp("machine"))
    try:
        made.boot()
        yield made
    finally:
        made.close()
