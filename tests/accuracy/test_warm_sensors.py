"""Girths of a body that is scanned by sensors warmer than when they were calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from violated_scans import measured

from station.calibration.detect.scene import static_view
from station.calibration.moves.look import Look, compared
from station.calibration.moves.reference import DriftReference
from station.core.bundle import Bundle, read_bundle
from station.core.kinect_v1 import DEPTH_SCALE_M, depth_of_raw
from station.core.rig import PredictedError, Rig
from station.simulation.scene import load_mesh
from station.simulation.sensor import SimulatedBooth, VirtualCamera, render_bundle
from workers.measure.body import Measurement
from workers.measure.definitions import DEFINITIONS
from workers.scape.model.body_model import load_model

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ben.npz"
GIRTHS = {row.name for row in DEFINITIONS if row.quantity in ("girth", "large girth")}


def _girths(bundle: Bundle, rig: Rig) -> dict[str, Measurement]:
    rows = measured(load_model(), bundle, rig)[0].rows
    return {row.name: row for row in rows if row.name in GIRTHS}


def test_girths_are_corrected_and_their_intervals_hold(tmp_path: Path) -> None:
    """They were 5 to 18 mm off, stated to 6."""
    booth = SimulatedBooth(seed=3)
    rig = replace(booth.rig, predicted=PredictedError(4e-4, 8e-4, 2e-4, 5e-4))
    warm = replace(booth, warmth=1.5e-3)
    body = load_mesh(BODY)
    cold = _girths(read_bundle(render_bundle(body, tmp_path / "cold", booth)), rig)
    bundle = read_bundle(render_bundle(body, tmp_path / "warm", warm))
    looks = {}
    for name, camera in rig.cameras.items():
        frames = VirtualCamera(booth, name, None).frames(20)
        empty = static_view((depth_of_raw(frame.raw) for frame in frames), DEPTH_SCALE_M)
        taken = list(bundle.depth_stack(name))
        looks[name] = Look.of(DriftReference.prepare(camera, empty), empty, taken, DEPTH_SCALE_M)
    changed, _ = compared(looks, rig.cameras)
    assert changed is not None
    corrected = _girths(bundle, changed.corrected(rig))
    off_mm = 1e3 * np.mean([corrected[n].value_m - cold[n].value_m for n in cold])
    assert abs(off_mm) < 3.0
    held = [
        row.interval95_m[0] <= cold[name].value_m <= row.interval95_m[1]
        for name, row in corrected.items()
    ]
    assert np.mean(held) > 0.9
