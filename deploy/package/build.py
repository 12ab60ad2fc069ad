"""`make package`: the Debian packages, the wheel and the source distribution of one commit.

The same commit gives the same bytes: everything comes from `git archive` and hashed lock files, and
every time is the commit's. The virtual environment is one compressed image that systemd mounts
read-only on /opt/booth: a third of the disk, and an upgrade replaces it as a whole.
"""

from __future__ import annotations

import argparse
import gzip
import os
import shutil
import subprocess
import sys
import tarfile
import time
from dataclasses import dataclass
from pathlib import Path

from image import (
    DEBIAN_PYTHON,
    SITE,
    compile_all,
    dependencies,
    install,
    slim,
    squash,
    virtual_environment,
)

from station import version_of_commit

ROOT = Path(__file__).parents[2]
BOOTH, SIMULATION = "body-booth", "body-booth-simulation"
MOUNTED = {BOOTH: Path("/opt/booth"), SIMULATION: Path("/opt/booth.simulation")}
"""Package -> where its image is mounted; a .pth file of the booth names the simulation's."""
DRIVERS = Path("/usr/local/lib/body-booth")
"""Folder for drivers of a shop's own sensors, which no upgrade replaces."""

_NOT_SHIPPED_OPEN3D = ("open3d_tf_ops.so", "open3d_torch_ops.so")
"""For machine learning frameworks that a booth has not."""
_COMPRESSION = ("-Zgzip", "-z1")
"""The large part of the Debian package is compressed already: more costs a minute, for nothing."""
_TOOLS = {"dpkg-deb": "dpkg", "mksquashfs": "squashfs-tools"}
"""Program -> the Debian package that it is in."""
_MOUNT_UNIT = "opt-booth.simulation.mount"


@dataclass(frozen=True, slots=True)
class Commit:
    """The commit that is built, and its time."""

    name: str
    seconds: int

    @property
    def version(self) -> str:
        return version_of_commit(self.seconds, self.name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commit", default="HEAD", help="what to package; default: HEAD")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the files")
    parser.add_argument("--work", type=Path, default=ROOT / "build/package", help="scratch folder")
    parser.add_argument("--simulation", action="store_true", help=f"also {SIMULATION}")
    parser.add_argument(
        "--keep", type=Path, help="folder that keeps compiled dependencies for the next build"
    )
    arguments = parser.parse_args()
    _check_tools()
    seconds, name = _git("log", "-1", "--format=%ct %H", arguments.commit).split()
    commit = Commit(name, int(seconds))
    os.environ |= {"SOURCE_DATE_EPOCH": seconds, "PYTHONHASHSEED": "0", "TZ": "UTC"}
    os.umask(0o022)
    out, work = arguments.out.resolve(), arguments.work.resolve()
    out.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(work, ignore_errors=True)
    source = _export(commit, work / "source")
    wheel = build_python(source, work, out)
    kept = arguments.keep or work / "dependencies"
    site = dependencies(source / "deploy/lock/booth.txt", MOUNTED[BOOTH] / SITE, kept)
    print(f"{_relative(build_booth(commit, source, wheel, site, work / BOOTH, out))}", flush=True)
    if arguments.simulation:
        tree = work / SIMULATION
        print(f"{_relative(build_simulation(commit, source, tree, out))}", flush=True)


def build_python(source: Path, work: Path, out: Path) -> Path:
    """The wheel and the source distribution; returns the wheel."""
    tools, made = work / "tools", work / "python"
    install(source / "deploy/lock/build.txt", tools)
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", made, source],
        env={**os.environ, "PYTHONPATH": str(tools)},
        stdout=subprocess.DEVNULL,
        check=True,
    )
    (wheel,), (sdist,) = made.glob("*.whl"), made.glob("*.tar.gz")
    _normalise(sdist)
    for path in (wheel, sdist):
        print(_relative(Path(shutil.copy(path, out))), flush=True)
    return wheel


def build_booth(
    commit: Commit, source: Path, wheel: Path, installed: Path, tree: Path, out: Path
) -> Path:
    """The booth's package: a virtual environment, units, rules, manuals."""
    root = tree.with_suffix(".image")
    site = root / SITE
    shutil.copytree(installed, site, symlinks=True)
    # pip would note the path that it came from.
    known = set(site.iterdir())
    shutil.unpack_archive(wheel, site, "zip")
    (site / "booth.pth").write_text(f"{MOUNTED[SIMULATION]}\n{DRIVERS}\n")
    for package in sorted(set(site.iterdir()) - known):
        if package.is_dir():
            compile_all(package, MOUNTED[BOOTH] / SITE / package.name)
    virtual_environment(root)
    _squash(BOOTH, root, tree, commit)
    _copy_table(source, tree)
    _manuals(source, tree, commit)
    return _debian_package(BOOTH, commit, source, tree, out)


def build_simulation(commit: Commit, source: Path, tree: Path, out: Path) -> Path:
    """The package that virtual booths and bare point clouds need: open3d and what it imports."""
    root = tree.with_suffix(".image")
    lock = tree.with_suffix(".txt")
    lock.write_text(_difference(source / "deploy/lock/simulation.txt", source / "deploy/lock"))
    install(lock, root)
    for name in _NOT_SHIPPED_OPEN3D:
        (root / "open3d" / name).unlink(missing_ok=True)
    slim(root)
    compile_all(root, MOUNTED[SIMULATION])
    _squash(SIMULATION, root, tree, commit)
    units = tree / "usr/lib/systemd/system"
    units.mkdir(parents=True)
    shutil.copyfile(source / "systemd" / _MOUNT_UNIT, units / _MOUNT_UNIT)
    return _debian_package(SIMULATION, commit, source, tree, out)


def _check_tools() -> None:
    if not DEBIAN_PYTHON.exists():
        sys.exit(f"error: {DEBIAN_PYTHON} is missing; packages are built on Debian 12")
    for program, package in _TOOLS.items():
        if shutil.which(program) is None:
            sys.exit(f"error: {program} is missing; apt-get install {package}")


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()


def _relative(path: Path) -> Path:
    return path.relative_to(ROOT) if path.is_relative_to(ROOT) else path


def _export(commit: Commit, folder: Path) -> Path:
    """The commit's files alone, with the commit's time: nothing of the working copy slips in."""
    folder.mkdir(parents=True)
    archive = subprocess.Popen(["git", "archive", commit.name], cwd=ROOT, stdout=subprocess.PIPE)
    subprocess.run(["tar", "-x", "-C", folder], stdin=archive.stdout, check=True)
    if archive.wait():
        sys.exit(f"error: git archive {commit.name} failed")
    return folder


def _difference(lock: Path, folder: Path) -> str:
    """The entries of one lock file that the booth's own does not have."""
    known = {_name(entry) for entry in _entries(folder / "booth.txt")}
    return "".join(entry for entry in _entries(lock) if _name(entry) not in known)


def _entries(lock: Path) -> list[str]:
    entries: list[str] = []
    for line in lock.read_text().splitlines(keepends=True):
        if line[:1].isalnum():
            entries.append(line)
        elif entries and not line.startswith("#"):
            entries[-1] += line
    return entries


def _name(entry: str) -> str:
    return entry.split("==")[0]


def _squash(name: str, root: Path, tree: Path, commit: Commit) -> None:
    place = tree / "usr/lib/body-booth"
    place.mkdir(parents=True)
    squash(root, place / f"{name}.squashfs", commit.seconds)


def _copy_table(source: Path, tree: Path) -> None:
    """Copy what deploy/package/install.txt lists: source, target, one a line."""
    for line in (source / "deploy/package/install.txt").read_text().splitlines():
        words = line.split("#")[0].split()
        if not words:
            continue
        pattern, target, *mode = words
        found = sorted(source.glob(pattern))
        if not found:
            sys.exit(f"error: deploy/package/install.txt names {pattern}, which is not there")
        for path in found:
            place = tree / target / path.name if target.endswith("/") else tree / target
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)
            place.chmod(int(mode[0], 8) if mode else 0o644)


def _manuals(source: Path, tree: Path, commit: Commit) -> None:
    """Manual pages and shell completion, made from the commands themselves."""
    subprocess.run(
        [sys.executable, source / "deploy/package/manuals.py", tree / "usr/share", commit.version],
        env={**os.environ, "PYTHONPATH": str(source)},
        check=True,
    )


def _debian_package(name: str, commit: Commit, source: Path, tree: Path, out: Path) -> Path:
    folder = source / "deploy/package" / name
    documents = tree / "usr/share/doc" / name
    documents.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / "deploy/package/copyright", documents / "copyright")
    _compress(_changelog(name, commit), documents / "changelog.gz")
    overrides = folder / "lintian-overrides"
    if overrides.exists():
        place = tree / "usr/share/lintian/overrides"
        place.mkdir(parents=True)
        shutil.copyfile(overrides, place / name)
    control = tree / "DEBIAN"
    control.mkdir()
    for path in folder.iterdir():
        if path.name in ("preinst", "postinst", "prerm", "postrm", "config"):
            (control / path.name).write_text(path.read_text())
            (control / path.name).chmod(0o755)
        elif path.name in ("templates", "triggers"):
            shutil.copyfile(path, control / path.name)
    fields = (folder / "control").read_text().replace("@VERSION@", commit.version)
    (control / "control").write_text(fields + f"Installed-Size: {_kilobytes(tree)}\n")
    _write_sums(tree, control / "md5sums")
    package = out / f"{name}_{commit.version}_amd64.deb"
    subprocess.run(
        ["dpkg-deb", "--root-owner-group", *_COMPRESSION, "--build", tree, package],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return package


def _changelog(name: str, commit: Commit) -> str:
    date = time.strftime("%a, %d %b %Y %H:%M:%S +0000", time.gmtime(commit.seconds))
    maintainer = "Body booth <maintainers@body-booth.example>"
    return (
        f"{name} ({commit.version}) unstable; urgency=medium\n\n"
        f"  * Commit {commit.name}; see CHANGELOG.md.\n\n -- {maintainer}  {date}\n"
    )


def _compress(text: str, path: Path) -> None:
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def _kilobytes(tree: Path) -> int:
    """Installed size as dpkg counts it: files rounded up to 1 KiB, a KiB for each other entry."""
    total = 0
    for path in tree.rglob("*"):
        if "DEBIAN" not in path.relative_to(tree).parts:
            plain = path.is_file() and not path.is_symlink()
            total += -(-path.stat().st_size // 1024) if plain else 1
    return total


def _write_sums(tree: Path, path: Path) -> None:
    files = sorted(f for f in tree.rglob("*") if f.is_file() and not f.is_symlink())
    names = [str(f.relative_to(tree)) for f in files if f.relative_to(tree).parts[0] != "DEBIAN"]
    with path.open("w") as sums:
        subprocess.run(["md5sum", *names], cwd=tree, stdout=sums, check=True)


def _normalise(sdist: Path) -> None:
    """Write a source distribution anew: members in order, one owner, the commit's time."""
    seconds = int(os.environ["SOURCE_DATE_EPOCH"])
    with tarfile.open(sdist) as archive:
        members = [
            (m, archive.extractfile(m) if m.isfile() else None)
            for m in sorted(archive.getmembers(), key=lambda member: member.name)
        ]
        plain = sdist.with_suffix("")
        with tarfile.open(plain, "w", format=tarfile.PAX_FORMAT) as fresh:
            for member, content in members:
                member.mtime, member.uid, member.gid = seconds, 0, 0
                member.uname = member.gname = ""
                member.pax_headers = {}
                fresh.addfile(member, content)
    sdist.write_bytes(gzip.compress(plain.read_bytes(), mtime=seconds))


if __name__ == "__main__":
    main()
