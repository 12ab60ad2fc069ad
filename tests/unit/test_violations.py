"""Simulated units err as they are said to, in forms that the calibration does not solve for."""

import numpy as np
import pytest
import synthetic_calibration as synthetic

from station.core.kinect_v1 import NO_READING, TABLE
from station.simulation import violations
from station.simulation.noise import raw_from_depth
from station.simulation.round_objects import ball, overlay
from station.simulation.scene import VirtualScene, box
from station.simulation.sensor import SimulatedUnit


def test_the_smooth_bias_is_as_large_as_it_says_and_differs_between_units() -> None:
    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 30))
    depth = np.full_like(x, 1.7)
    offsets = []
    for unit in range(4):
        bias = violations.smooth_bias(frozenset({violations.BIAS}), 7, unit)
        assert bias is not None
        offsets.append(bias.offset_m(x, y, depth))
        assert np.sqrt(np.mean(offsets[-1] ** 2)) == pytest.approx(1.5e-3, rel=0.1)
    assert np.abs(np.corrcoef([offset.ravel() for offset in offsets])[0, 1:]).max() < 0.95
    assert violations.smooth_bias(frozenset(), 7, 0) is None


def test_libfreenects_raw_law_differs_from_the_tangent_law_by_centimetres() -> None:
    depth = np.array([1.0, 1.7, 2.5])
    raw = raw_from_depth(depth, violations.ZeroPlane())
    assert (raw < NO_READING).all()
    off_m = 1e-4 * TABLE[raw] - depth
    assert 0.015 < abs(off_m[2]) < 0.035


def test_an_oval_ball_is_longer_along_its_axis() -> None:
    booth = synthetic.booth(1, 0.0)
    camera = SimulatedUnit.of(booth, "front-upper").camera
    view = VirtualScene([box((-2, 2, 0), (2, 2.1, 2))]).view(camera, camera.world_from_camera)
    forward = camera.world_from_camera[:3, 2]
    center = camera.world_from_camera[:3, 3] + 1.5 * forward
    nearest = []
    for stretch in (0.0, 0.01):
        drawn = overlay(view, camera, [ball(center, 0.1, forward, stretch)])
        assert drawn is not None
        nearest.append(float(drawn[0].depth_m[drawn[0].depth_m > 0].min()))
    assert nearest[0] - nearest[1] == pytest.approx(1e-3, abs=1e-4)


def test_switches_change_what_they_name_and_nothing_else() -> None:
    plain, lens = synthetic.booth(5), synthetic.booth(5, switches=(violations.LENS,))
    for name, believed in plain.rig.cameras.items():
        assert np.array_equal(SimulatedUnit.of(plain, name).camera.K, believed.K)
        unit = SimulatedUnit.of(lens, name)
        assert not np.array_equal(unit.camera.K, believed.K)
        assert unit.error == SimulatedUnit.of(plain, name).error
