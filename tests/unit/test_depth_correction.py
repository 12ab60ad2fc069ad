"""A camera's systematic depth error is taken out of its images."""

import numpy as np

from station.core.depth.correction import DepthCorrection
from station.core.depth.field import DepthField


def test_depth_correction_acts_on_inverse_depth() -> None:
    correction = DepthCorrection((0.01, 1.02))
    depth = np.array([0.0, 0.8, 2.0], dtype=np.float32)
    corrected = correction.apply(depth)
    assert corrected[0] == 0.0
    assert np.allclose(1.0 / corrected[1:], 0.01 + 1.02 / depth[1:], rtol=1e-6)
    assert corrected.dtype == np.float32
    assert DepthCorrection().apply(depth) is depth


def test_a_gradient_over_the_image_goes_from_edge_to_edge() -> None:
    correction = DepthCorrection((0.01, 1.0), (0.02, -0.03))
    corrected = correction.apply(np.full((3, 5), 2.0))
    expected = 0.51 + 0.02 * np.linspace(-1, 1, 5) - 0.03 * np.linspace(-1, 1, 3)[:, None]
    assert np.allclose(1.0 / corrected, expected)
    assert not DepthCorrection((-1.0, 1.0)).apply(np.full(4, 2.0)).any()


def test_images_and_single_readings_are_corrected_alike() -> None:
    control = np.random.default_rng(3).normal(0.0, 1e-3, (3, 4, 5))
    correction = DepthCorrection((0.0, 1.0), (0.0, 0.0), DepthField((0.4, 0.7, 1.0), control))
    depth = np.full((12, 16), 1.6, np.float32)
    y, x = np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-1, 1, 16), indexing="ij")
    at = correction.inverse_at(1.0 / depth.ravel().astype(float), x.ravel(), y.ravel())
    assert np.allclose(1.0 / correction.apply(depth).ravel(), at, atol=1e-6)
