"""The booth's state, from its processes' own reports and from the spool.

No process has to respond: a hung one is recognised by the age of its report. `station status`
prints it, control's `status` command returns it, and the metrics are made from it.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from station.booth.collection import check_words, silence_in_words
from station.booth.supervisor import services
from station.calibration.drift.kept import problem_in_words
from station.calibration.guide.store import CalibrationStore
from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.errors import BoothError
from station.core.files import Version, version_of
from station.core.rig import Rig
from station.core.scans import CANCELLED, STATES, count_scans, failure_reason, scans_of
from station.core.service import NOTHING_RUNS, read_health
from station.sensors.identity import calibrated_serials, configured_serials, mismatch

MAX_AGE_S = 3.0
"""A process reports four times a second; an older report means that it hangs or is gone."""
_STARTING_S = 15.0
"""Time after the first process has started in which others may be starting still."""
_CHANGED = (
    "booth.toml was changed after the booth was started, and is not in use yet: end station run "
    "and run it again, or for an installed booth: sudo systemctl restart booth.target"
)
_BESIDE_SCANS = ("console", "deliver")
"""Processes without which scans are taken and reconstructed all the same."""


@dataclass(frozen=True, slots=True)
class BoothHealth:
    """The booth at one moment."""

    processes: dict[str, dict[str, Any]]
    """Last report of each process, with `age_s`; {} for a process without a report, and for all of
    a booth that does not run."""
    sync: dict[str, Any]
    """Cameras, framesets and latencies; {"error"} while sync does not report."""
    spool: dict[str, int]
    """Scans in each folder; failed/ has the cancelled ones, too."""
    oldest_waiting_s: float
    stuck: list[str]
    """Claimed scans that should have ended."""
    free_bytes: int
    problems: list[str] = field(default_factory=list)
    """Problems with their remedies, the worst first; empty when there are none."""
    remarks: list[str] = field(default_factory=list)
    """Words on what scans are corrected for."""
    unusable: str = ""
    """Words on a calibration that the booth that runs takes no scans with; empty if it is sound."""
    cancelled: int = 0
    """Scans in failed/ that the operator cancelled."""


def booth_health(config: BoothConfig, path: Path | None = None) -> BoothHealth:
    """The booth as it is now; what cannot be read is a problem of its own.

    Args:
        path: the booth.toml that `config` was read from, if the booth that runs goes by `config`.
    """
    folder = config.runtime.folder
    processes = {service.name: read_health(folder, service.name) for service in services(config)}
    if not any(map(_lives, processes.values())):
        # Reports of a booth that was stopped a moment ago are as fresh as those of one that runs.
        processes = {name: {} for name in processes}
    # Else a remedy that changes booth.toml would seem not to help.
    problems = [_CHANGED] if path is not None and _changed(path, config) else []
    problems += _silent(processes)
    sync = processes["sync"]
    if not reports(sync):
        sync = {"error": "the sync process is not reporting on cameras and framesets"}
    hanging = {name for name in sync.get("silent", ()) if not reports(processes[f"capture {name}"])}
    wanted = bool(processes["control"].get("streaming"))
    problems += _cameras(sync, hanging, config.recorded, wanted=wanted)
    told = [content for content in processes.values() if reports(content)]
    problems += [str(problem) for content in told for problem in content.get("problems", [])]
    remarks = [str(remark) for content in told for remark in content.get("remarks", [])]
    words = unusable(config) if reports(processes["sync"]) else ""
    # Sync says the same of sensors that it has seen.
    if words and words not in problems:
        problems.append(words)
    problems += problem_in_words(config)
    spool, oldest_s, free = _disk(config, problems)
    # Workers count the time by a clock that nobody sets.
    workers = processes.get("workers", {})
    stuck = [str(name) for name in workers.get("stuck", [])] if reports(workers) else []
    problems += [f"scan {name} is stuck in work; see the workers' log" for name in stuck]
    cancelled = _cancelled(config.spool.folder / "failed", spool.get("failed", 0))
    return BoothHealth(
        processes, sync, spool, oldest_s, stuck, free, problems, remarks, words, cancelled
    )


def scans_by_outcome(spool: Mapping[str, int], cancelled: int) -> dict[str, int]:
    """Scans in each folder of the spool, the cancelled ones apart from those that failed."""
    failed = spool.get("failed", 0) - cancelled
    counts = {**spool, "failed": failed, "cancelled": cancelled}
    return {name: count for name, count in counts.items() if count > 0}


def _lives(content: Mapping[str, Any]) -> bool:
    """Whether the process lives that wrote a report."""
    try:
        os.kill(content["pid"], 0)
    except (KeyError, ProcessLookupError):
        return False
    except PermissionError:
        pass  # another user's
    return True


def reports(content: Mapping[str, Any]) -> bool:
    """A process's last report is fresh; what an older one says may have passed."""
    return bool(content) and content["age_s"] <= MAX_AGE_S


def starting(processes: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """Processes that have not reported since the booth was started, seconds ago."""
    starts_s = [content.get("started_s", 0.0) for content in processes.values() if reports(content)]
    began_s = min(starts_s, default=0.0)
    if time.monotonic() - began_s > _STARTING_S:
        return set()
    return {name for name, told in processes.items() if not told or told["told_s"] < began_s}


def can_scan(config: BoothConfig, status: Mapping[str, Any]) -> bool:
    """Whether nothing is in the way of a scan, from control's answer.

    Sensors that were stopped are expected to be silent.
    """
    sync = status["sync"]
    silent = sync.get("silent", ["unknown"]) if status["streaming"] else []
    troubled = any(camera["trouble"] for camera in sync.get("cameras", {}).values())
    # A booth that has never run has no spool yet.
    full = config.spool.folder.is_dir() and _is_full(config, status["free_bytes"])
    # booth.toml may have been edited since the booth was started.
    unfit = status.get("unusable") or unusable(config)
    disturbed = silent or troubled or full or sync.get("problems") or unfit
    needed = [told for name, told in status["processes"].items() if name not in _BESIDE_SCANS]
    return all(map(reports, needed)) and not disturbed


def unusable(config: BoothConfig) -> str:
    """Words on a calibration that no scan can be taken with; empty if it is sound."""
    path = config.calibration
    try:
        if not path.exists():
            return CalibrationStore.of(config).missing_words()
        calibrated = _calibrated(path, version_of(path))
    except (BoothError, OSError) as error:
        return str(error)
    return mismatch(calibrated, configured_serials(config.cameras))


@lru_cache(maxsize=1)
def _calibrated(path: Path, version: Version) -> dict[str, str]:  # noqa: ARG001
    """Cameras of a calibration and their serial numbers.

    Asked for every second, and read only when the file is another version of it.
    """
    return calibrated_serials(Rig.load(path).cameras)


def _changed(path: Path, config: BoothConfig) -> bool:
    """Whether a booth.toml says something else than the booth that runs goes by."""
    try:
        return _read(path, version_of(path)) != config
    except (BoothError, OSError):
        return True


@lru_cache(maxsize=1)
def _read(path: Path, version: Version) -> BoothConfig:  # noqa: ARG001
    """A booth.toml, read only when the file is another version of it."""
    return load_config(path)


def _silent(processes: dict[str, dict[str, Any]]) -> list[str]:
    """Messages about processes that do not report, with remedies."""
    if not any(map(reports, processes.values())):
        return [NOTHING_RUNS]
    begun = starting(processes)
    return [
        f"the {name} process has not reported for {content['age_s']:.0f} s; it is restarted "
        "automatically under station run or systemd"
        if content
        else f"the {name} process is not running; see journalctl -u 'booth-*', or the "
        "terminal of station run"
        for name, content in processes.items()
        if not reports(content) and name not in begun
    ]


def _cameras(
    sync: dict[str, Any], hanging: set[str], recorded: Set[str], *, wanted: bool
) -> list[str]:
    """Cameras whose frames are not what they should be.

    Args:
        hanging: cameras whose process does not report, which is told of the process.
        recorded: cameras that play recordings.
        wanted: the operator has started the sensors.
    """
    told: dict[str, dict[str, Any]] = sync.get("cameras", {})
    problems = [
        f"camera {name}: {camera['trouble']}" for name, camera in told.items() if camera["trouble"]
    ]
    silent: dict[str, str] = {}
    for name in sync.get("silent", []) if wanted else []:
        state = told.get(name, {}).get("state", "off")
        # A sensor that is being opened is not silent yet; the process says when it cannot be.
        if state in ("streaming", "lost") and name not in hanging:
            detail = told[name]["detail"]
            silent[name] = f" ({detail})" if detail else ""
    if silent:
        remedy = check_words(list(silent), recorded)
        problems.append(f"{silence_in_words(silent)}; {remedy}")
    return problems


def _cancelled(failed: Path, count: int) -> int:
    """Number of scans in failed/ that the operator cancelled."""
    try:
        return _count_cancelled(failed, failed.stat().st_mtime_ns, count) if count else 0
    except OSError:
        return 0


@lru_cache(maxsize=1)
def _count_cancelled(failed: Path, changed_ns: int, count: int) -> int:  # noqa: ARG001
    """As `_cancelled`; asked for every second, and counted only when the folder has changed."""
    return sum(failure_reason(folder) == CANCELLED for folder in failed.iterdir())


def _moments_s(folder: Path) -> list[float]:
    """Moments at which scans came into a folder, without those that leave it just now."""
    found = []
    for name in scans_of(folder):
        with suppress(FileNotFoundError):
            found.append((folder / name).stat().st_mtime)
    return found


def _is_full(config: BoothConfig, free_bytes: int) -> bool:
    """Whether scans are refused for the space that is left."""
    return free_bytes < config.spool.min_free_mb * 1e6


def _disk(config: BoothConfig, problems: list[str]) -> tuple[dict[str, int], float, int]:
    """Counts of scans, age of the oldest waiting one, free bytes."""
    folder = config.spool.folder
    if not folder.is_dir():
        return {}, 0.0, 0
    try:
        counts = count_scans(folder)
        now_s = time.time()
        waiting_s = max([0.0, *(now_s - moment_s for moment_s in _moments_s(folder / "queue"))])
        free = shutil.disk_usage(folder).free
    except OSError as error:
        problems.append(f"the spool cannot be read ({error}); check its disk")
        return {}, 0.0, 0
    if _is_full(config, free):
        problems.append(
            f"{folder} has {free / 1e6:.0f} MB free and scans are refused below "
            f"{config.spool.min_free_mb:.0f} MB; free some space or run: station purge --old"
        )
    return (
        {state: counts.get(state, 0) for state in STATES if counts.get(state)},
        waiting_s,
        free,
    )
