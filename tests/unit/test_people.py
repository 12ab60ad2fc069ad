"""Scans of many people name the camera that drifted, and nobody's misfit names one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from station.booth.health import booth_health
from station.calibration.drift.check_cli import check
from station.calibration.drift.kept import FOLDER, problem_in_words, use_correction
from station.calibration.drift.people import ENOUGH, Drift, Evidence, corrected, find_drift
from station.calibration.guide.session import Session
from station.calibration.guide.store import CalibrationStore
from station.calibration.moves.motion import LEVER_M
from station.core.config import BoothConfig
from station.core.config_file import load_config
from station.core.errors import CalibrationError
from station.core.geometry import se3_exp
from station.core.rig import PredictedError, Rig
from station.simulation.scene import default_rig
from workers.reconstruct.pool import CAMERAS, keep_evidence
from workers.scape.evidence.cameras import CameraEvidence

Array = NDArray[np.float64]

RIG = default_rig()
NAMES = tuple(RIG.cameras)
SCALE = np.array([LEVER_M] * 3 + [1.0] * 3)
TURNED = np.array([0.0, np.radians(0.2), 0.0, 0.0, 0.0, 0.003])
"""0.2 degrees to the right and 3 mm forward."""


def _people(
    count: int, moved: dict[str, Array], misfit_m: float = 0.001, seed: int = 1
) -> list[Evidence]:
    """Evidence whose errors are those of bodies: correlated between directions, new in every scan,
    and much larger than the information claims."""
    rng = np.random.default_rng(seed)
    size = 6 * len(NAMES)
    true = np.concatenate([moved.get(name, np.zeros(6)) for name in NAMES])
    found = []
    for _ in range(count):
        rows = rng.standard_normal((4 * size, size)) * np.tile(SCALE, len(NAMES)) / 1e-3
        information = rows.T @ rows
        error = misfit_m * rng.standard_normal(size) / np.tile(SCALE, len(NAMES))
        found.append(Evidence(NAMES, information, information @ (true + error)))
    return found


@pytest.mark.parametrize("camera", NAMES)
def test_the_camera_that_drifted_is_named_with_its_move(camera: str) -> None:
    drift = find_drift(_people(24, {camera: TURNED}))
    assert drift is not None
    assert drift.camera == camera
    assert drift.confirmed
    assert np.abs((drift.xi - TURNED) * SCALE).max() < 0.0015
    millimetres = round(1e3 * float(np.linalg.norm(drift.xi[3:])))
    assert drift.words() == (
        f"camera {camera} seems to have moved since it was calibrated, as the scans of the last "
        f"people say: by about {millimetres} mm (mostly forward) and 0.2 degrees (mostly to the "
        "right); run station check --correct"
    )


def test_nothing_is_said_without_cause() -> None:
    assert all(find_drift(_people(24, {}, seed=seed)) is None for seed in range(40))
    assert find_drift(_people(ENOUGH - 1, {"back-upper": TURNED})) is None
    # All cameras ask for the same: the bodies are to blame, or the room.
    assert find_drift(_people(24, dict.fromkeys(NAMES, TURNED))) is None


def test_a_few_strange_people_do_not_move_a_camera() -> None:
    people = _people(24, {})
    strange = _people(3, {"front-lower": 10.0 * TURNED}, seed=2)
    assert find_drift(people[:-3] + strange) is None


def test_a_drift_that_half_of_the_people_deny_is_not_corrected() -> None:
    half = _people(12, {"front-lower": TURNED})
    others = _people(12, {"front-lower": -0.2 * TURNED}, seed=3)
    mixed = [scan for pair in zip(half, others, strict=True) for scan in pair]
    drift = find_drift(mixed)
    assert drift is None or not drift.confirmed


@pytest.fixture
def config(tmp_path: Path) -> BoothConfig:
    """A booth with a stored calibration in use."""
    cameras = "".join(
        f'[[cameras]]\nname = "{name}"\nserial = "V{index}"\n'
        f'driver = "recorded"\nrecording = "{name}"\n'
        for index, name in enumerate(NAMES)
    )
    path = tmp_path / "booth.toml"
    path.write_text(cameras)
    config = load_config(path)
    store = CalibrationStore.of(config)
    Session.begin(store.unfinished, "2026", 0.1, RIG.cameras)
    store.finish(replace(RIG, created="2026-11-01T10:00:00Z"), {})
    store.use("20261101T100000Z")
    return config


def _keep(config: BoothConfig, people: list[Evidence], created: str) -> None:
    """As a worker does."""
    turn = np.zeros((6 * len(NAMES),) * 2)
    for index, name in enumerate(np.repeat(NAMES, 2)):
        own = slice(3 * index, 3 * index + 3)
        turn[own, own] = RIG.cameras[name].world_from_camera[:3, :3]
    for scan in people:
        evidence = CameraEvidence(turn @ scan.information @ turn.T, turn @ scan.vector)
        keep_evidence(
            evidence.document(list(RIG.cameras.values()), created), config.spool.folder / CAMERAS
        )


def test_a_correction_is_a_dated_calibration_in_use(config: BoothConfig) -> None:
    assert CAMERAS == FOLDER
    _keep(config, _people(24, {"back-upper": TURNED}), "2026-11-01T10:00:00Z")
    [said] = problem_in_words(config)
    assert "camera back-upper seems to have moved" in said
    assert said in booth_health(config).problems
    done = CliRunner().invoke(
        check, ["--config", str(config.calibration.parent / "booth.toml"), "--correct"]
    )
    assert done.exit_code == 0, done.output
    assert "camera back-upper is now taken to stand where" in done.output
    rig = Rig.load(config.calibration)
    wanted = RIG.cameras["back-upper"].world_from_camera @ se3_exp(TURNED)
    assert np.abs(rig.cameras["back-upper"].world_from_camera - wanted).max() < 0.001
    for name in set(NAMES) - {"back-upper"}:
        assert np.array_equal(
            rig.cameras[name].world_from_camera, RIG.cameras[name].world_from_camera
        )
    store = CalibrationStore.of(config)
    assert len(store.entries()) == 2
    # What was said of the old calibration says nothing of the new one.
    assert problem_in_words(config) == []
    with pytest.raises(CalibrationError, match="in the scans of 0 people"):
        use_correction(config, "2026-11-03T10:00:00Z")


def test_a_corrected_calibration_is_known_as_well_as_people_tell_it() -> None:
    stated = PredictedError(0.001, 0.0005, 0.0001, 0.001)
    covariance = np.diag([1e-3**2] * 3 + [0.002**2] * 3)
    drift = Drift("back-upper", TURNED, covariance, confirmed=True)
    found = corrected(replace(RIG, predicted=stated), drift, "2026").predicted
    assert found is not None
    # Two millimetres, and a milliradian at two metres for two of three axes.
    assert 0.0022 < found.normal_rms_m < 0.003
    assert found.girth_sigma_m > 2.0 * found.normal_rms_m
    assert found.tilt_sigma_rad == stated.tilt_sigma_rad


def test_nothing_is_corrected_without_cause(config: BoothConfig) -> None:
    _keep(config, _people(24, {}), "2026-11-01T10:00:00Z")
    assert problem_in_words(config) == []
    with pytest.raises(CalibrationError, match="scans of 24 people agree with the calibration"):
        use_correction(config, "2026-11-02T10:00:00Z")


def test_what_is_kept_names_nobody_and_is_bounded(config: BoothConfig) -> None:
    _keep(config, _people(2, {}), "2026-11-01T10:00:00Z")
    folder = config.spool.folder / CAMERAS
    for path in folder.iterdir():
        document = json.loads(path.read_text())
        assert set(document) == {
            "format", "version", "calibration", "cameras", "information", "vector",
        }  # fmt: skip
    for number in range(70):
        keep_evidence({"format": "booth-camera-evidence", "version": 1}, folder)
        assert len(list(folder.iterdir())) <= 60, number
    # Files without content are passed over.
    assert problem_in_words(config) == []
