"""A fresh Debian machine under systemd-nspawn: systemd as PID 1, its own network and no way out.

Its root is an overlay on one that is made once. Killing PID 1 is the closest to a reset
that a container has: every process dies at once, but what the kernel holds in memory still reaches
the disk.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

from install.debian_root import ENVIRONMENT

_CGROUPS = Path("/sys/fs/cgroup")
_BOOT_S = 60.0
_COMMAND_S = 900.0
# systemd wants the unified hierarchy for itself; a host with the old one has it as well, but
# elsewhere, and nspawn looks in one place.
_IN_OWN_CGROUP = """
echo $$ > "$1/cgroup.procs"
umount --lazy /sys/fs/cgroup
mount -t cgroup2 none /sys/fs/cgroup
shift
exec "$@"
"""


class Machine:
    """One machine: its disk outlives its boots."""

    def __init__(self, base: Path, folder: Path) -> None:
        self.root = folder / "root"
        for name in ("root", "upper", "work"):
            (folder / name).mkdir(parents=True)
        layers = f"lowerdir={base},upperdir={folder / 'upper'},workdir={folder / 'work'}"
        subprocess.run(
            ["mount", "-t", "overlay", "overlay", "-o", layers, str(self.root)], check=True
        )
        self._process: subprocess.Popen[bytes] | None = None
        self._leader = 0
        unified = _CGROUPS / "unified"
        hierarchy = unified if unified.is_dir() else _CGROUPS
        self._cgroup = hierarchy / f"booth-{os.getpid()}-{folder.name}"
        self._console = folder / "console.log"

    def boot(self) -> None:
        """Start it and wait until systemd takes commands."""
        self._cgroup.mkdir(exist_ok=True)
        # The image of the programs is mounted through a loop device.
        devices = ["/dev/loop-control", *map(str, sorted(Path("/dev").glob("loop[0-9]*")))]
        nspawn = ["systemd-nspawn", "--register=no", "--keep-unit", "--private-network", "--quiet"]
        nspawn += [f"--bind={device}" for device in devices]
        nspawn += ["--console=passive", "--boot", "-D", str(self.root)]
        shell = ["unshare", "--mount", "sh", "-ec", _IN_OWN_CGROUP, "sh", str(self._cgroup)]
        with self._console.open("ab") as console:
            self._process = subprocess.Popen(
                [*shell, *nspawn],
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        deadline_s = time.monotonic() + _BOOT_S
        while not self._is_up():
            if self._process.poll() is not None or time.monotonic() > deadline_s:
                self.close()
                raise RuntimeError(f"it did not boot:\n{self._console.read_text()[-3000:]}")
            time.sleep(0.1)

    def _is_up(self) -> bool:
        assert self._process is not None
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
        words = children.read_text().split() if children.exists() else []
        if not words:
            return False
        self._leader = int(words[0])
        return self.run("systemctl", "is-system-running", check=False).returncode in (0, 1) and (
            self.run("systemctl", "is-active", "multi-user.target", check=False).returncode == 0
        )

    def run(self, *words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command as root on it."""
        done = subprocess.run(
            self._inside(words), capture_output=True, text=True, timeout=_COMMAND_S, check=False
        )
        if check and done.returncode:
            raise AssertionError(
                f"{' '.join(words)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
            )
        return done

    def begin(self, *words: str) -> subprocess.Popen[bytes]:
        """Run a command as root on it, and go on meanwhile."""
        return subprocess.Popen(
            self._inside(words), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def _inside(self, words: tuple[str, ...]) -> list[str]:
        enter = ["nsenter", "-t", str(self._leader), "-m", "-u", "-i", "-n", "-p", "-C"]
        return [*enter, "--", "env", "-i", *ENVIRONMENT, *words]

    def put(self, source: Path, target: str, *, owner: str = "root") -> None:
        """Copy a file or folder onto its disk."""
        place = self.root / target.lstrip("/")
        place.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["cp", "-a", str(source), str(place)], check=True)
        if owner != "root":
            self.run("chown", "-R", owner, target)

    def files(self) -> set[str]:
        """Every path on its disk that an installation may have changed."""
        skipped = (
            "proc",
            "sys",
            "dev",
            "run",
            "tmp",
            "var/tmp",
            "var/log",
            "var/cache/apt",
            "var/lib/apt",
        )
        found = set()
        for folder, folders, names in os.walk(self.root):
            inside = os.path.relpath(folder, self.root)
            if inside.startswith(skipped):
                folders.clear()
                continue
            found |= {os.path.normpath(os.path.join(inside, name)) for name in (*folders, *names)}
        return found

    def power_off(self) -> None:
        """Shut it down in good order."""
        assert self._process is not None
        self.run("systemctl", "poweroff", check=False)
        self._process.wait(timeout=60)

    def reset(self) -> None:
        """Kill PID 1, and with it everything, in the middle of whatever it does."""
        assert self._process is not None
        os.kill(self._leader, signal.SIGKILL)
        self._process.wait(timeout=30)

    def close(self) -> None:
        """Stop it and forget its disk."""
        if self._process is not None and self._process.poll() is None:
            if self._leader:
                self.reset()
            else:
                self._process.kill()
                self._process.wait()
        subprocess.run(["umount", "--lazy", str(self.root)], check=False)
        for folder in sorted(self._cgroup.rglob("*"), reverse=True):
            if folder.is_dir():
                folder.rmdir()
        if self._cgroup.is_dir():
            self._cgroup.rmdir()
