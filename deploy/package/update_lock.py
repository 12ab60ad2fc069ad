"""`make lock`: pin every dependency of the booth, with hashes, in deploy/lock/."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy" / "lock"
PYTHON = "3.11"
"""Debian 12's, which the package runs on."""
BUILD = "build>=1.2\nsetuptools>=77\nwheel>=0.45\n"
"""Packages that turn the source into a wheel and a source distribution."""


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    _compile("booth.txt", "pyproject.toml")
    _compile("simulation.txt", "pyproject.toml", "--extra", "simulation")
    _compile("build.txt", "-", text=BUILD)


def _compile(name: str, source: str, *options: str, text: str | None = None) -> None:
    """Resolve anew: versions are chosen as if there were no lock file."""
    output = FOLDER / name
    output.unlink(missing_ok=True)
    command = [sys.executable, "-m", "uv", "pip", "compile", source, *options]
    command += ["--generate-hashes", "--python-version", PYTHON, "--quiet"]
    command += ["--custom-compile-command", "make lock", "--output-file", str(output)]
    subprocess.run(command, cwd=ROOT, input=text, text=True, check=True)
    pinned = sum("==" in line for line in output.read_text().splitlines())
    print(f"{output.relative_to(ROOT)}: {pinned} packages")


if __name__ == "__main__":
    main()
