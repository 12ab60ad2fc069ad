"""The noise that averaging has left, found in the averaged image itself."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from station.core.kinect_v1 import RANDOM_SIGMA
from workers.cloud.noise import noise_ratio

_SHAPE = (240, 160)
_FRAMES = 10


def _pattern(rng: np.random.Generator) -> NDArray[np.float64]:
    blurred = cv2.GaussianBlur(rng.standard_normal(_SHAPE), (0, 0), 1.6)
    return np.asarray(blurred / blurred.std())


def _averaged(frozen_share: float, size: float = 1.0, frames: int = _FRAMES) -> np.ndarray:
    """Mean of readings of a bulging trunk, with a part of the noise that stays."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[: _SHAPE[0], : _SHAPE[1]]
    body_m = 1.7 - 0.12 * np.sqrt(np.maximum(1.0 - ((x - 80) / 90.0) ** 2, 0.0)) + 2e-4 * y
    flicker = np.mean([_pattern(rng) for _ in range(frames)], axis=0)
    noise = np.sqrt(frozen_share) * _pattern(rng) + np.sqrt(1.0 - frozen_share) * flicker
    return (1.0 / (1.0 / body_m + size * RANDOM_SIGMA * noise)).astype(np.float32)


def _ratio(depth_m: np.ndarray, frames: int = _FRAMES) -> float:
    return noise_ratio(depth_m, depth_m > 0.0, np.full(_SHAPE, frames, np.uint16))


@pytest.mark.parametrize("frames", [1, 10, 30])
def test_independent_readings_have_the_usual_noise(frames: int) -> None:
    assert _ratio(_averaged(0.0, frames=frames), frames) < 1.15


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_noise_that_stays_shows_by_its_size(share: float) -> None:
    """Less than the whole: the usual share is of readings that are rounded, and of slanted skin."""
    expected = np.sqrt(share * _FRAMES + 1.0 - share)
    assert 0.75 * expected < _ratio(_averaged(share)) < 1.05 * expected


def test_a_noisy_sensor_shows_as_well() -> None:
    assert _ratio(_averaged(0.0, size=3.0)) == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize("shape", [(200, 18), (18, 200)])
def test_noise_shows_along_rows_and_columns(shape: tuple[int, int]) -> None:
    """A limb may be narrower than the differences reach."""
    noise = 3.0 * RANDOM_SIGMA / np.sqrt(_FRAMES) * np.random.default_rng(1).normal(size=shape)
    depth_m = (1.0 / (1.0 / 1.7 + noise)).astype(np.float32)
    ratio = noise_ratio(depth_m, depth_m > 0.0, np.full(shape, _FRAMES, np.uint16))
    assert ratio == pytest.approx(3.0, rel=0.15)


def test_what_is_not_the_person_does_not_count() -> None:
    depth_m = _averaged(0.0)
    background = np.zeros(_SHAPE, bool)
    background[:, :60] = True
    depth_m[background] += np.random.default_rng(0).normal(0.0, 0.05, _SHAPE)[background]
    readings = np.full(_SHAPE, _FRAMES, np.uint16)
    assert noise_ratio(depth_m, ~background, readings) < 1.15
    assert noise_ratio(depth_m, background, readings) > 5.0


@pytest.mark.parametrize("shape", [(3, 3), (200, 12), (0, 0)])
def test_a_few_pixels_say_nothing(shape: tuple[int, int]) -> None:
    depth_m = np.full(shape, 1.7, np.float32)
    assert noise_ratio(depth_m, depth_m > 0.0, np.ones(shape, np.uint16)) == 1.0
