"""The programs of a package as one compressed image that is mounted read-only.

A third of the disk that its files would take, and an upgrade replaces it as a whole. The same lock
file and wheel give the same bytes.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

DEBIAN_PYTHON = Path("/usr/bin/python3.11")
SITE = Path("lib/python3.11/site-packages")

_NOT_SHIPPED = ("tests", "test")
_NOT_SHIPPED_FILES = ("*.pyi", "*.h", "*.hpp", "*.cuh", "*.pxd", "*.pyx", "*.a", "*.lib")
_COMPILE = ("-m", "compileall", "-q", "-f", "--invalidation-mode", "unchecked-hash")
_LAUNCHER = """#!/opt/booth/bin/python -I
import sys

from {} import main

sys.exit(main())
"""
_ZSTD = ("-comp", "zstd", "-Xcompression-level", "9")
_SQUASHFS = (*_ZSTD, "-all-root", "-noappend", "-no-xattrs", "-no-progress")


def install(lock: Path, target: Path) -> None:
    """Install exactly what a lock file says, without running anything of it."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--no-deps", "--no-compile", "--target", str(target), "--upgrade"]
    command += ["--require-hashes", "-r", str(lock)]
    subprocess.run([*command, "--only-binary", ":all:"], check=True, stderr=_quiet())
    # Programs of the dependencies stay out.
    shutil.rmtree(target / "bin", ignore_errors=True)


def _quiet() -> int | None:
    return None if sys.stderr.isatty() else subprocess.DEVNULL


def slim(site: Path) -> None:
    """Leave out the dependencies' own tests, headers and type stubs."""
    for folder in [f for f in site.rglob("*") if f.is_dir() and f.name in _NOT_SHIPPED]:
        shutil.rmtree(folder, ignore_errors=True)
    for pattern in _NOT_SHIPPED_FILES:
        for path in site.rglob(pattern):
            path.unlink()


def dependencies(lock: Path, mounted: Path, folder: Path) -> Path:
    """Install, slim and compile what a lock file says, once for each lock file.

    Args:
        mounted: the folder's name on the machine that runs it.
        folder: where the result is kept.
    """
    site = folder / hashlib.sha256(lock.read_bytes()).hexdigest()[:16]
    if not site.exists():
        fresh = folder / f".{site.name}.{os.getpid()}"
        install(lock, fresh)
        slim(fresh)
        compile_all(fresh, mounted)
        fresh.rename(site)
    return site


def compile_all(folder: Path, mounted: Path) -> None:
    """Compile to byte code that holds by content, since times say nothing.

    Each package has a process of its own: what a process has compiled before shows in the bytes.
    """
    command = [str(DEBIAN_PYTHON), *_COMPILE, "-s", str(folder), "-p", str(mounted)]

    def run(path: Path) -> None:
        subprocess.run([*command, path], check=True)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(run, sorted(p for p in folder.iterdir() if p.is_dir() or p.suffix == ".py")))


def squash(folder: Path, image: Path, seconds: int) -> None:
    """Compress a folder into one file in which every time is `seconds`."""
    environment = {k: v for k, v in os.environ.items() if k != "SOURCE_DATE_EPOCH"}
    times = ["-mkfs-time", str(seconds), "-all-time", str(seconds)]
    subprocess.run(
        ["mksquashfs", folder, image, *_SQUASHFS, *times],
        env=environment,
        stdout=subprocess.DEVNULL,
        check=True,
    )


def virtual_environment(folder: Path) -> None:
    """A relocatable environment on Debian's Python, with the two commands."""
    programs = folder / "bin"
    programs.mkdir(parents=True)
    (programs / "python").symlink_to(DEBIAN_PYTHON)
    (folder / "pyvenv.cfg").write_text(
        "home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.11\n"
    )
    for name, module in (("station", "station.cli"), ("reconstruct", "workers.cli")):
        program = programs / name
        program.write_text(_LAUNCHER.format(module))
        program.chmod(0o755)
