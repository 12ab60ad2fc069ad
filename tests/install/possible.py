"""Whether this machine can run the tests of an installed booth: exits with 1 and says why not.

A fresh Debian is made and booted, as the tests do; nothing else tells whether that works.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from install.debian_root import base_root
from install.machine import Machine
from install.places import DEBIAN, ROOT, dependencies_of_package

_PROGRAMS = {
    "systemd-nspawn": "systemd-container",
    "mksquashfs": "squashfs-tools",
    "lintian": "lintian",
}
"""Program -> the Debian package that it is in."""


def main() -> None:
    reason = _hindrance()
    if reason:
        sys.exit(f"the package is not tested on a machine of its own: {reason}")


def _hindrance() -> str:
    if os.geteuid() != 0:
        return "only root can boot one"
    if not Path("/usr/bin/python3.11").exists() or not Path("/var/lib/dpkg/status").exists():
        return "this is not Debian 12"
    before = ["git", "rev-parse", "--quiet", "--verify", "HEAD~1"]
    if subprocess.run(before, cwd=ROOT, capture_output=True, check=False).returncode:
        return "this clone does not hold the commit before, from which it is upgraded"
    if "squashfs" not in Path("/proc/filesystems").read_text():
        return "this kernel has no squashfs"
    lacking = [package for program, package in _PROGRAMS.items() if not shutil.which(program)]
    if lacking and not _installed(lacking):
        return f"apt-get could not install {' '.join(lacking)}"
    try:
        base = base_root(DEBIAN, dependencies_of_package())
    except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
        return f"no Debian root could be made ({error})"
    with tempfile.TemporaryDirectory() as folder:
        return _boots(base, Path(folder))


def _boots(base: Path, folder: Path) -> str:
    try:
        machine = Machine(base, folder)
    except (OSError, subprocess.CalledProcessError) as error:
        return f"its disk cannot be mounted ({error})"
    try:
        machine.boot()
        machine.run("losetup", "--find")
    except (RuntimeError, AssertionError, OSError) as error:
        return str(error)
    finally:
        machine.close()
    return ""


def _installed(packages: list[str]) -> bool:
    """Install what the tests need beside the package's own dependencies."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    install = ["install", "-y", "-qq", "--no-install-recommends", *packages]
    return all(
        subprocess.run(
            ["apt-get", *words], env=environment, capture_output=True, check=False
        ).returncode
        == 0
        for words in (["update", "-qq"], install)
    )


if __name__ == "__main__":
    main()
