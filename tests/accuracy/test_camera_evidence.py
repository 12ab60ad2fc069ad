"""Rendered scans ask for the motion that a camera made, whatever the body's misfit.

The same person before and after one camera was moved: the misfit is the same, and what remains is
the motion. The rendered person comes from the training family, the sensor's noise from another
model than the fit assumes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from station.calibration.drift.people import Evidence
from station.core.bundle import read_bundle
from station.simulation.scene import bumped, load_mesh
from station.simulation.sensor import SimulatedBooth, render_bundle
from workers.cloud.preprocess import preprocess
from workers.scape.fit.fit import fit_overlapping
from workers.scape.model.blas import single_threaded_blas
from workers.scape.model.body_model import load_model

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ben.npz"
SHIFT_M, TURN_RAD = -0.003, float(np.radians(-0.2))


def _motions(folder: Path, moved: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    booth = SimulatedBooth(seed=77, moved_cameras=moved)
    bundle = read_bundle(render_bundle(load_mesh(BODY), folder, booth))
    scan = preprocess(bundle, None)
    with single_threaded_blas():
        fit = fit_overlapping(load_model(), scan, "joint", lambda *_: None, lambda *_: None)
    assert fit.evidence is not None
    document = fit.evidence.document([view.calibration for view in scan.views], "2026")
    found = Evidence.from_json(document)
    motions: dict[str, NDArray[np.float64]] = {}
    for index, name in enumerate(found.cameras):
        own = slice(6 * index, 6 * index + 6)
        motion = np.linalg.solve(found.information[own, own], found.vector[own])
        motions[name] = np.asarray(motion, np.float64)
    return motions


def test_a_moved_camera_asks_for_its_motion(tmp_path: Path) -> None:
    before = _motions(tmp_path / "before", {})
    after = _motions(tmp_path / "after", {"front-upper": bumped(SHIFT_M, TURN_RAD)})
    change = after["front-upper"] - before["front-upper"]
    assert abs(change[0] - TURN_RAD) < np.radians(0.05)
    assert np.abs(change[1:3]).max() < np.radians(0.05)
    assert abs(change[3] - SHIFT_M) < 0.001
    assert np.abs(change[4:]).max() < 0.0015
