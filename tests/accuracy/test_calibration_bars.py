"""The benchmarks of the calibration in a short form: one booth each, and the bars themselves.

`make bench-calibration` and `make bench-violations` run the same code on more booths. A file of its
own, so that one process solves booths while another fits bodies.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import synthetic_calibration as synthetic
from bench_calibration import judged
from calibrated_booths import normalised_square, solved
from scan_distortion import distortion

from station.simulation import violations
from station.simulation.procedure import VirtualProcedure
from station.simulation.scene import load_mesh

BODY = Path(__file__).parents[2] / "station/simulation/bodies/ann.npz"
RATE_HZ = 9.0
"""Detections a second: enough for the sensors' fields, and quickly solved."""


def test_a_calibrated_booth_keeps_the_bars() -> None:
    """The bars of the calibration on one booth, and what scans gain or lose by it.

    Detections are drawn directly: finding them in a minute of images takes minutes, and is tested
    with real processes in tests/e2e/test_replayed_calibration.py.
    """
    procedure = VirtualProcedure(synthetic.booth(1))
    row = judged(procedure, synthetic.observations(procedure, rate_hz=20.0))
    assert not isinstance(row, str), row
    assert len(row.shift_mm) == 6
    assert row.shift_mm.mean() < 1.0
    assert row.shift_mm.max() < 2.0
    assert row.turn_deg.mean() < 0.05
    assert row.turn_deg.max() < 0.1
    assert row.cylinder_mm < 1.5
    assert row.body_mm - row.body_true_mm < 0.5


@pytest.mark.parametrize(
    "switch", [violations.BIAS, violations.K1, violations.LENS, violations.OVAL]
)
def test_errors_of_another_form_are_found(switch: str) -> None:
    """Rings, bumps or a distorted lens once passed for a polynomial: girths were off by 12 mm."""
    procedure = VirtualProcedure(synthetic.booth(121, switches=(switch,)))
    seen = synthetic.observations(procedure, rate_hz=RATE_HZ, boards=True, stands=True)
    solution = solved(procedure.booth.rig, seen)
    found = distortion(procedure.booth, solution.rig, load_mesh(BODY))
    assert found.normal_rms_mm < 0.6
    assert abs(found.height_mm) < 2.5
    assert np.abs(found.girths_mm).max() < 5.0
    predicted = solution.rig.predicted
    assert predicted is not None
    assert 0.5 < found.normal_rms_mm / (1e3 * predicted.normal_rms_m) < 1.5


def test_what_it_says_of_its_own_errors_is_true() -> None:
    """Noise that entered both sides of an equation once biased the depth scale by 4 sigma."""
    total, unknowns = 0.0, 0
    for seed in (111, 112, 113, 114):
        procedure = VirtualProcedure(synthetic.booth(seed), waving_s=40.0)
        rig = procedure.booth.rig
        seen = synthetic.observations(procedure, rate_hz=RATE_HZ, boards=True, stands=True)
        total += normalised_square(rig, solved(rig, seen).world_poses)
        unknowns += 6 * (len(rig.cameras) - 1)
    # 72 unknowns: 99.9 % lie between 0.55 and 1.6 a piece.
    assert 0.55 < total / unknowns < 1.6
