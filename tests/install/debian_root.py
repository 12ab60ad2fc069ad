"""A minimal Debian root made from the packages that this machine has installed.

Files are copied, as dpkg lists them, with dpkg's own records; what packages make only when they are
configured (accounts, alternatives, the linker's cache) is made anew. What this machine lacks is
fetched by apt inside the new root. A tenth of debootstrap's time, and hardly any network.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

_DPKG = Path("var/lib/dpkg")
_SEED = ("apt", "dbus", "debconf", "debian-archive-keyring", "man-db", "systemd", "systemd-sysv")
_MERGED = ("bin", "sbin", "lib", "lib32", "lib64", "libx32")
"""Links to the folders of the same name in /usr."""
_SOURCES = """deb http://deb.debian.org/debian bookworm main
deb http://deb.debian.org/debian bookworm-updates main
deb http://deb.debian.org/debian-security bookworm-security main
"""
ENVIRONMENT = (
    "PATH=/usr/sbin:/usr/bin:/sbin:/bin",
    "TERM=dumb",
    "LANG=C.UTF-8",
    "DEBIAN_FRONTEND=noninteractive",
)


def base_root(folder: Path, packages: Iterable[str]) -> Path:
    """A Debian with systemd and these packages; made once for each list."""
    root, mark = folder / "root", folder / "packages.txt"
    wanted = sorted({*_SEED, *packages})
    if mark.exists() and mark.read_text().split() == wanted:
        return root
    shutil.rmtree(folder, ignore_errors=True)
    root.mkdir(parents=True)
    records = _installed()
    _copy_packages(root, [records[name] for name in _closure(wanted, records)])
    _configure(root)
    missing = [name for name in wanted if name not in records]
    if missing:
        _fetch(root, missing)
    mark.write_text(" ".join(wanted))
    return root


class _Record(dict[str, str]):
    """A package's paragraph of dpkg's status file."""

    @property
    def text(self) -> str:
        return self["text"]

    def names(self, *fields: str) -> list[str]:
        """Packages that fields name; of alternatives, all."""
        words = ",".join(self.get(field, "") for field in fields)
        return [re.split(r"[ (:]", entry.strip())[0] for entry in re.split(r"[,|]", words)]


def _installed() -> dict[str, _Record]:
    """Name, or provided name -> the installed package."""
    found: dict[str, _Record] = {}
    provided: dict[str, _Record] = {}
    for text in Path("/", _DPKG, "status").read_text().split("\n\n"):
        fields = re.findall(r"^(\S+): *(.*(?:\n .*)*)", text, re.MULTILINE)
        record = _Record(fields, text=text)
        if record.get("Status") == "install ok installed":
            found[record["Package"]] = record
            provided |= {name: record for name in record.names("Provides") if name}
    return provided | found


def _closure(names: Iterable[str], records: dict[str, _Record]) -> list[str]:
    """Everything essential, these packages, and what all of them need."""
    essential = [r["Package"] for r in records.values() if r.get("Essential") == "yes"]
    found: set[str] = set()
    waiting = [*essential, *names]
    while waiting:
        name = waiting.pop()
        if name in records and records[name]["Package"] not in found:
            record = records[name]
            found.add(record["Package"])
            waiting += record.names("Pre-Depends", "Depends")
    return sorted(found)


def _copy_packages(root: Path, records: list[_Record]) -> None:
    for name in _MERGED:
        (root / "usr" / name).mkdir(parents=True)
        (root / name).symlink_to(f"usr/{name}")
    info = root / _DPKG / "info"
    info.mkdir(parents=True)
    paths: set[str] = set()
    for record in records:
        name = record["Package"]
        for source in Path("/", _DPKG, "info").glob(f"{name}[.:]*"):
            if source.name.startswith((f"{name}.", f"{name}:{record['Architecture']}.")):
                shutil.copy2(source, info)
                if source.suffix == ".list":
                    paths |= {_merged(path) for path in source.read_text().split("\n")}
    paths = {path for path in paths if path.strip("/.") and os.path.lexists(path)}
    pack = ["tar", "-C", "/", "--no-recursion", "--null", "-T", "-", "-cf", "-"]
    listed = "\0".join(f".{path}" for path in sorted(paths)).encode()
    packed = subprocess.run(pack, input=listed, capture_output=True, check=True).stdout
    subprocess.run(["tar", "-C", str(root), "-xpf", "-"], input=packed, check=True)
    (root / _DPKG / "status").write_text("".join(f"{r.text.strip()}\n\n" for r in records))
    for name in ("available", "diversions", "statoverride"):
        (root / _DPKG / name).touch()
    for name in ("updates", "triggers", "parts"):
        (root / _DPKG / name).mkdir(exist_ok=True)


def _merged(path: str) -> str:
    """The path in /usr of a file that a package lists under its former place."""
    first = path.split("/", 2)[1] if path.count("/") else ""
    return f"/usr{path}" if first in _MERGED and path != f"/{first}" else path


def _configure(root: Path) -> None:
    """Do what the packages' scripts would: accounts, alternatives, the linker's cache."""
    for folder in ("dev", "proc", "sys", "run", "root", "opt", "srv", "media", "var/lib/apt/lists"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    # Debian's own timers, which are not enabled here, leave their stamps in it.
    (root / "var/lib/systemd/timers").mkdir(parents=True, exist_ok=True)
    (root / "tmp").chmod(0o1777)
    for name in ("passwd", "group"):
        shutil.copy(root / f"usr/share/base-passwd/{name}.master", root / f"etc/{name}")
    for source in ("libc-bin/nsswitch.conf", "base-files/profile"):
        shutil.copy(root / "usr/share" / source, root / "etc")
    alternatives = root / "etc/alternatives"
    alternatives.mkdir(exist_ok=True)
    for place in ("usr/bin", "usr/sbin"):
        for link in Path("/", place).iterdir():
            if link.is_symlink() and str(link.readlink()).startswith("/etc/alternatives/"):
                target = link.readlink().readlink()
                if os.path.lexists(root / str(target).lstrip("/")):
                    (alternatives / link.name).symlink_to(target)
                    (root / place / link.name).symlink_to(link.readlink())
    subprocess.run(["systemd-sysusers", f"--root={root}"], check=True, capture_output=True)
    subprocess.run(["ldconfig", "-r", str(root)], check=True)
    (root / "etc/machine-id").touch()
    (root / "etc/hostname").write_text("booth\n")
    (root / "etc/apt/sources.list").write_text(_SOURCES)


def _fetch(root: Path, packages: list[str]) -> None:
    shutil.copy("/etc/resolv.conf", root / "etc/resolv.conf")
    for words in (["update"], ["install", "-y", "--no-install-recommends", *packages]):
        apt = ["env", "-i", *ENVIRONMENT, "apt-get", "-q", "-o", "APT::Sandbox::User=root", *words]
        done = subprocess.run(
            ["chroot", str(root), *apt], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"apt-get {' '.join(words)}:\n{done.stdout}\n{done.stderr}")
    shutil.rmtree(root / "var/lib/apt/lists")
    (root / "var/lib/apt/lists").mkdir()
