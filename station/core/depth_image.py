"""Depth images: inverse depth, discontinuities, and smooth fields over image and inverse depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
JUMP_RATIO = 0.02
"""Neighbouring readings of one surface differ by less than this share of their depth a pixel."""


def inverse_depth(depth_m: Image) -> Image:
    """1/z of depths (h, w) in metres; 0 (no reading) stays 0."""
    return np.divide(np.float32(1.0), depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)


def jumps(depth_m: Image, radius_px: int = 2) -> NDArray[np.bool_]:
    """Pixels within a radius of a depth discontinuity, where readings mix two surfaces."""
    # Loaded here: a process that only reads the calibration does without OpenCV's 60 MB.
    import cv2

    window = np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)
    seen = depth_m > 0
    far = cv2.dilate(depth_m, window)
    near = cv2.erode(np.where(seen, depth_m, np.float32(99.0)), window)
    return np.asarray(seen & (far - near > JUMP_RATIO * radius_px * depth_m))


def quadratic_basis(at: Array, count: int) -> tuple[Indices, Array]:
    """First control point (n,) and the weights (n, 3) of it and the next two, at -1 to 1."""
    t = np.clip(0.5 * (at + 1.0), 0.0, 1.0) * (count - 2)
    first = np.minimum(t.astype(np.int64), count - 3)
    s = t - first
    return first, np.stack([0.5 * (1.0 - s) ** 2, 0.5 + s - s * s, 0.5 * s * s], axis=-1)


def linear_basis(at: Array, knots: Array) -> tuple[Indices, Array]:
    """First knot (n,) and the weights (n, 2) of it and the next one."""
    first = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    s = np.clip((at - knots[first]) / (knots[first + 1] - knots[first]), 0.0, 1.0)
    return first, np.stack([1.0 - s, s], axis=-1)


@dataclass(frozen=True, slots=True)
class DepthField:
    """A smooth field in 1/m, a tensor product of B-splines.

    f(x, y, w) = sum_kji c[k, j, i] L_k(w) Q_j(y) Q_i(x), with uniform quadratic B-splines Q over
    x, y from -1 to 1 (the image's width and height) and linear B-splines L with given knots in
    inverse depth w, constant beyond the outermost knots.
    """

    knots: tuple[float, ...]
    """(k,) inverse depths, 1/m, increasing; at least two."""
    control: Array
    """(k, j, i), 1/m."""

    def at(self, inverse: Array, x: Array, y: Array) -> Array:
        """Values (n,) at inverse depths and image positions (n,)."""
        k, weight_k = linear_basis(inverse, np.array(self.knots))
        j, weight_j = quadratic_basis(y, self.control.shape[1])
        i, weight_i = quadratic_basis(x, self.control.shape[2])
        total = np.zeros(np.shape(inverse))
        for a in range(2):
            for b in range(3):
                for c in range(3):
                    weight = weight_k[..., a] * weight_j[..., b] * weight_i[..., c]
                    total += weight * self.control[k + a, j + b, i + c]
        return total

    def over(self, inverse: Image) -> Image:
        """Values (h, w) at a whole image of inverse depths."""
        layers = _layers(self.control.tobytes(), self.control.shape, *inverse.shape)
        total = np.zeros_like(inverse)
        knots = self.knots
        for k, layer in enumerate(layers):
            # The hat function of knot k, constant beyond the ends.
            weight = np.ones_like(inverse)
            if k > 0:
                weight = np.clip((inverse - knots[k - 1]) / (knots[k] - knots[k - 1]), 0.0, 1.0)
            if k + 1 < len(knots):
                falling = (knots[k + 1] - inverse) / (knots[k + 1] - knots[k])
                weight = np.minimum(weight, np.clip(falling, 0.0, 1.0))
            total += weight * layer
        return np.asarray(total, np.float32)


@lru_cache(maxsize=16)
def _layers(control: bytes, shape: tuple[int, int, int], height: int, width: int) -> Image:
    """The field at each knot over the whole image, (k, height, width)."""
    values = np.frombuffer(control).reshape(shape)
    across, down = _basis_matrix(width, shape[2]), _basis_matrix(height, shape[1])
    return np.asarray(np.einsum("vj,kji,ui->kvu", down, values, across, optimize=True), np.float32)


def _basis_matrix(pixels: int, count: int) -> Array:
    first, weight = quadratic_basis(np.linspace(-1.0, 1.0, pixels), count)
    matrix = np.zeros((pixels, count))
    for k in range(3):
        matrix[np.arange(pixels), first + k] = weight[:, k]
    return matrix
