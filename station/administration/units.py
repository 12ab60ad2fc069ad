"""The booth's systemd units: whether they are installed, and starting them."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

from station.core.errors import BoothError
from station.core.files import is_held
from station.core.service import STATION_LOCK

TARGET = "booth.target"
_STOPPING_S = 30.0
"""More than any service's TimeoutStopSec."""
_ALIVE = (
    "list-units", "--plain", "--no-legend", "--type=service",
    "--state=active,activating,deactivating,reloading", "booth-*",
)  # fmt: skip
_PLACE = Path("/usr/lib/systemd/system") / TARGET


def installed() -> bool:
    """Whether this machine runs systemd and the package has installed the booth's units."""
    return Path("/run/systemd/system").is_dir() and _PLACE.exists()


def running() -> bool:
    """Whether the booth's target is up; services that are still stopping are waited for."""
    if not installed():
        return False
    if _systemctl("--quiet", "is-active", TARGET).returncode == 0:
        return True
    # `systemctl stop` of a target returns before its services have ended.
    deadline_s = time.monotonic() + _STOPPING_S
    while busy := _systemctl(*_ALIVE).stdout.strip():
        if time.monotonic() > deadline_s:
            break
        time.sleep(0.1)
    return bool(busy)


def check_stopped(runtime_folder: Path) -> None:
    """Refuse what a running booth would spoil.

    Raises:
        BoothError: its services are up, or `station run` is.
    """
    if running():
        raise BoothError("the booth is running; first run: systemctl stop booth.target")
    if is_held(runtime_folder / STATION_LOCK):
        raise BoothError("the booth is running (station run); first end it: Ctrl-C in its terminal")


def start(*, afresh: bool) -> None:
    """Enable the target for every boot and start it.

    Args:
        afresh: whether booth.toml has changed, so that running units must be restarted.

    Raises:
        BoothError: systemd's own words.
    """
    _must("daemon-reload")
    _must("--quiet", "enable", TARGET)
    if afresh:
        _must("stop", TARGET)
    _must("start", TARGET)


def _must(*words: str) -> None:
    done = _systemctl(*words)
    if done.returncode:
        raise BoothError(f"systemctl {' '.join(words)}: {done.stderr.strip()}")


def _systemctl(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["systemctl", *words], capture_output=True, text=True, check=False)
