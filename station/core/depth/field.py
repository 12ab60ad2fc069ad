"""A smooth field over a depth image and inverse depth, and the B-splines that it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.core.depth.images import Image
from station.core.depth.json_values import array_of

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
_MAX_CONTROL_POINTS = 64
"""Along an axis of a depth field; the solution uses less than twenty."""
_MAX_PER_M = 100.0
"""Size of a control point: a reading 1 cm away, which no sensor gives, is 100 per metre."""


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

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> DepthField:
        """The field of a camera's depth_correction in calibration.json.

        Raises:
            KeyError: a key is missing.
            ValueError: it is no field of finite numbers, or has too many.
        """
        knots = array_of(fields["inverse_depth_per_m"])
        control = array_of(fields["control_per_m"])
        if (
            knots is None
            or knots.ndim != 1
            or len(knots) < 2
            or not np.isfinite(knots).all()
            or not (np.diff(knots) > 0.0).all()
        ):
            raise ValueError("inverse_depth_per_m must be two or more increasing numbers")
        if (
            control is None
            or control.ndim != 3
            or len(control) != len(knots)
            or min(control.shape[1:]) < 3
            or max(control.shape) > _MAX_CONTROL_POINTS
            or not (np.abs(control) < _MAX_PER_M).all()
        ):
            raise ValueError(
                f"control_per_m must have for each of inverse_depth_per_m 3 to "
                f"{_MAX_CONTROL_POINTS} rows of 3 to {_MAX_CONTROL_POINTS} numbers within "
                f"{_MAX_PER_M:g} of 0"
            )
        return cls(tuple(float(knot) for knot in knots), control)

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
