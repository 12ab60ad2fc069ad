"""Evidence of the last people's scans about the cameras, on disk, and the correction made from it.

The workers put one small file of each accepted scan into the spool's `cameras` folder. It bears
neither the scan's name nor its time, and holds sums from which no body can be rebuilt.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Sequence, Set
from functools import lru_cache
from pathlib import Path

from station.calibration.drift.people import (
    ENOUGH,
    FORMAT,
    VERSION,
    Drift,
    Evidence,
    corrected,
    find_drift,
)
from station.calibration.guide.session import SCENE
from station.calibration.guide.store import CALIBRATION, REPORT, CalibrationStore, Entry, dated
from station.core.config import BoothConfig
from station.core.errors import BoothError, CalibrationError
from station.core.files import private_folder, publish_folder, read_json, write_json
from station.core.rig import Rig

FOLDER = "cameras"
_LOG = logging.getLogger("people")


def drift_of(config: BoothConfig) -> Drift | None:
    """The camera that people's scans say has drifted since the calibration in use was made."""
    names = _names(config)
    if len(names) < ENOUGH or not config.calibration.is_file():
        return None
    rig = Rig.load(config.calibration)
    return _found(config.spool.folder / FOLDER, names, rig.created, frozenset(rig.cameras))


def problem_in_words(config: BoothConfig) -> list[str]:
    """For the booth's status: the drift in words; nothing where there is none."""
    try:
        drift = drift_of(config)
    except (BoothError, OSError) as error:
        _LOG.warning("what people's scans say of the cameras cannot be judged: %s", error)
        return []
    return [] if drift is None else [drift.words()]


def use_correction(config: BoothConfig, created: str) -> tuple[Drift, Entry]:
    """Store a corrected calibration beside the others, and put it into use.

    Args:
        created: its date, UTC, ISO 8601.

    Raises:
        CalibrationError: there is nothing to correct, or the correction does not hold for people
            whom it was not computed from.
    """
    store = CalibrationStore.of(config)
    with store.locked():
        rig = store.rig_in_use()
        folder, cameras = config.spool.folder / FOLDER, set(rig.cameras)
        used = len(_scans(folder, _names(config), rig.created, cameras))
        if used < ENOUGH:
            raise CalibrationError(
                f"the cameras have been compared in the scans of {used} people since the "
                f"calibration in use was made; {ENOUGH} are needed for a correction"
            )
        drift = drift_of(config)
        if drift is None:
            raise CalibrationError(
                f"the scans of {used} people agree with the calibration in use; nothing is "
                "corrected"
            )
        if not drift.confirmed:
            raise CalibrationError(
                f"{drift.words()}; a correction from one half of the scans does not fit the other "
                "half better, so none is made"
            )
        name = _publish(store, corrected(rig, drift, created), drift, used)
        return drift, store.use(name)


def _publish(store: CalibrationStore, rig: Rig, drift: Drift, scans: int) -> str:
    """A dated calibration with the empty booth's images of the one that it corrects."""
    name, before = dated(rig.created), store.name_in_use()
    final = store.folder / name
    temporary = private_folder(store.folder / f".{name}.{os.getpid()}")
    rig.save(temporary / CALIBRATION)
    write_json(
        temporary / REPORT,
        {
            "corrected_from": before,
            "camera": drift.camera,
            "xi": drift.xi.tolist(),
            "covariance": drift.covariance.tolist(),
            "scans": scans,
        },
    )
    if before and (store.folder / before / SCENE).is_dir():
        shutil.copytree(store.folder / before / SCENE, temporary / SCENE)
    try:
        publish_folder(temporary, final)
    except FileExistsError as cause:
        shutil.rmtree(temporary, ignore_errors=True)
        raise CalibrationError(f"{cause}; try again in a second") from None
    return name


def _names(config: BoothConfig) -> tuple[str, ...]:
    folder = config.spool.folder / FOLDER
    return tuple(sorted(path.name for path in folder.glob("*.json")))


@lru_cache(maxsize=2)
def _found(
    folder: Path, names: tuple[str, ...], created: str, cameras: frozenset[str]
) -> Drift | None:
    """Judged once for the same files and the same calibration."""
    return find_drift(_scans(folder, names, created, cameras))


def _scans(folder: Path, names: Sequence[str], created: str, cameras: Set[str]) -> list[Evidence]:
    """Readable evidence about a calibration's cameras; that about others is passed over."""
    found: list[Evidence] = []
    for name in names:
        try:
            document = read_json(folder / name, format=FORMAT, versions={VERSION})
            if document.get("calibration") != created:
                continue
            evidence = Evidence.from_json(document)
        except (BoothError, KeyError, TypeError, ValueError, ArithmeticError) as error:
            _LOG.warning("%s is left out: %s", name, error)
            continue
        if (
            set(evidence.cameras) == cameras
            and evidence.cameras == (found or [evidence])[0].cameras
        ):
            found.append(evidence)
    return found
