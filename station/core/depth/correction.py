"""A depth camera's systematic error, and what undoes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from station.core.depth.field import DepthField
from station.core.depth.json_values import array_of

Array = NDArray[np.float64]

POLYNOMIAL, FIELD = "inverse-depth-poly", "inverse-depth-field"
"""Models of depth correction, beside "none"."""
_MAX_COEFFICIENTS = 16
"""The solution uses five; powers beyond cannot be told from rounding."""
_NEWTON = 3
"""Steps after which changes of a few per cent are undone to rounding."""
_DEPTHS_M = np.linspace(0.5, 4.0, 36)
"""At which a correction must leave readings: a booth's."""


@dataclass(frozen=True, slots=True)
class DepthCorrection:
    """A camera's systematic depth error, z in metres.

    1/z_true = sum_i a_i (1/z_measured)^i + g . (x, y) + f(x, y, 1/z_measured), with x and y from
    -1 to 1 over the image's width and height and a smooth field f.
    """

    coefficients: tuple[float, ...] = ()
    """(a0, a1, ...); empty = no correction."""
    image_gradient: tuple[float, float] = (0.0, 0.0)
    """(gx, gy), 1/m: change of the error from the image's middle to its edges."""
    field: DepthField | None = None

    def apply(self, depth_m: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Corrected depths, same shape and type; 0 (no reading) stays 0.

        Where there is an image gradient or a field, depth_m must be a whole image (h, w).
        """
        if not self.coefficients:
            return depth_m
        seen = depth_m > 0
        inverse = 1.0 / np.where(seen, depth_m, 1.0)
        corrected = np.polynomial.polynomial.polyval(inverse, self.coefficients)
        if any(self.image_gradient):
            height, width = depth_m.shape
            gx, gy = self.image_gradient
            corrected = corrected + gx * np.linspace(-1.0, 1.0, width, dtype=np.float32)
            corrected += gy * np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
        if self.field is not None:
            corrected = corrected + self.field.over(np.asarray(inverse, np.float32))
        # A correction extrapolated beyond its depths must not give points behind the camera.
        usable = seen & (corrected > 0)
        return np.where(usable, 1.0 / np.where(usable, corrected, 1.0), 0.0).astype(depth_m.dtype)

    def inverse_at(self, inverse: Array, x: Array, y: Array) -> Array:
        """Corrected inverse depths (n,) of measured ones at image positions x, y from -1 to 1."""
        if not self.coefficients:
            return inverse
        corrected = np.polynomial.polynomial.polyval(inverse, self.coefficients)
        corrected = corrected + self.image_gradient[0] * x + self.image_gradient[1] * y
        if self.field is not None:
            corrected = corrected + self.field.at(inverse, x, y)
        return np.asarray(corrected)

    def after(self, law: ArrayLike) -> DepthCorrection:
        """The correction of a sensor whose inverse depths w have changed since: this one of
        w + law[0] + law[1] w + ...

        A field is followed to first order between its knots; powers that no file may have are
        left out.
        """
        polynomial = np.polynomial.Polynomial
        before = polynomial([0.0, 1.0]) + polynomial(np.asarray(law))
        coefficients = polynomial(self.coefficients or (0.0, 1.0))(before).coef
        field = self.field
        if field is not None:
            knots = np.array(field.knots)
            for _ in range(_NEWTON):
                knots = knots - (before(knots) - field.knots) / before.deriv()(knots)
            field = replace(field, knots=tuple(knots.tolist()))
        return replace(
            self, coefficients=tuple(coefficients[:_MAX_COEFFICIENTS].tolist()), field=field
        )

    def to_json(self) -> dict[str, Any]:
        if not self.coefficients:
            return {"model": "none"}
        document: dict[str, Any] = {
            "model": POLYNOMIAL,
            "coefficients": list(self.coefficients),
        }
        if any(self.image_gradient):
            document["image_gradient"] = list(self.image_gradient)
        if self.field is not None:
            document["model"] = FIELD
            document["inverse_depth_per_m"] = list(self.field.knots)
            document["control_per_m"] = self.field.control.tolist()
        return document

    @classmethod
    def from_json(cls, fields: object) -> DepthCorrection:
        """The correction of a camera's depth_correction in calibration.json.

        Raises:
            KeyError: a key is missing.
            ValueError: its model is unknown, or no camera has such a correction.
        """
        if not isinstance(fields, Mapping):
            raise ValueError(
                'depth_correction must be an object with a model, as in {"model": "none"}'
            )
        model = fields.get("model")
        if model == "none":
            return cls()
        if model not in (POLYNOMIAL, FIELD):
            raise ValueError(
                f"depth_correction model {model!r} is unknown (known: none, {POLYNOMIAL}, {FIELD})"
            )
        found = array_of(fields["coefficients"])
        if (
            found is None
            or found.ndim != 1
            or not 0 < len(found) <= _MAX_COEFFICIENTS
            or not np.isfinite(found).all()
        ):
            raise ValueError(f"depth_correction needs 1 to {_MAX_COEFFICIENTS} finite coefficients")
        gradient = array_of(fields.get("image_gradient", (0.0, 0.0)))
        if gradient is None or gradient.shape != (2,) or not np.isfinite(gradient).all():
            raise ValueError("image_gradient must be two finite numbers")
        field = DepthField.from_json(fields) if model == FIELD else None
        coefficients = tuple(float(value) for value in found)
        correction = cls(coefficients, (float(gradient[0]), float(gradient[1])), field)
        edges = np.array([-1.0, 0.0, 1.0])
        inverse, x, y = (grid.ravel() for grid in np.meshgrid(1.0 / _DEPTHS_M, edges, edges))
        if not (correction.inverse_at(inverse, x, y) > 0.0).any():
            raise ValueError("depth_correction must leave readings between 0.5 and 4 m")
        return correction
