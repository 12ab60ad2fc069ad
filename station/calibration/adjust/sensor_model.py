"""The errors of one sensor that a calibration solves for: depth and lens.

Inverse depth: 1/z_true = w + p0 + p1 w + p2 (w - w0)^2 + p3 x + p4 y + p5 L(w) + f(x, y, w), with
w = 1/z_measured and x, y from -1 to 1 over the image. p0 is a shift of the disparity, p1 a wrong
baseline, p3 and p4 a projector that is turned against its camera, p5 L a share of the difference
between two laws by which raw readings become depths; f is a smooth field of tensor
B-splines (`station.core.depth.field`) with a Gaussian-process prior. Lens: the focal length's
relative error, the principal point's shift (pixels) and the radial coefficient k1. Ball: how much
flatter the side of it that the camera sees is than a sphere, a share of its radius.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
from numpy.typing import NDArray

from station.core.depth.correction import DepthCorrection
from station.core.depth.field import DepthField, linear_basis, quadratic_basis
from station.core.kinect_v1 import registration_law
from station.core.lens import pixel_rays, project
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POLYNOMIAL, LENS, BALL = 6, 4, 1
LAW = 5
"""Index of p5."""
MIDDLE = 0.6
"""w0, 1/m: the middle of a booth's depths."""
TOLERANCE = np.array([5e-3, np.inf, 1.5e-3, 2e-3, 2e-3, np.inf])
"""Standard deviations of p0..p4 among sensors as they leave the factory; of the gain p1, and of the
lens, see `station.calibration.adjust.widths`; of p5, which all sensors share but for a little, see
`LAW_SIGMA`."""
LAW_SIGMA, LAW_DIFFERENCE = 1.0, 0.02
"""Standard deviations of p5, and of its difference from one sensor to another: it is 0 by the
tangent law and 1 by that of libfreenect's registration, whose constants units state alike."""
TAIL = 4.0
"""Degrees of freedom (Student's t) of the polynomial's prior."""
_COLUMNS, _ROWS = 9, 7
"""Control points across and down: a knot every 90 px."""
_KNOTS = (0.35, 0.6, 0.85, 1.15)
"""1/m: 2.9 to 0.9 m, where a booth's cameras see the person."""
FIELD = len(_KNOTS) * _ROWS * _COLUMNS
_WIDTH_OF = np.array([0, 1, 2, 2, 3, 4])
"""Class of gain, focal length, centre (twice), k1 and flattening."""
_FIELD_REACH, _FIELD_REACH_W = 0.35, 0.5
"""Correlation lengths: of a half image (110 px), and of inverse depth (1/m)."""


def _law_difference() -> Array:
    """Coefficients of L(w), a polynomial in w that is exact to 3e-6 1/m from 0.5 to 4 m."""
    inverse = np.linspace(0.25, 2.0, 100)
    return np.asarray(
        np.polynomial.polynomial.polyfit(inverse, registration_law(inverse) - inverse, 4)
    )


_LAW = _law_difference()


def image_place(camera: CameraCalibration, pixels: Array) -> Array:
    """Positions (..., 2) from -1 to 1 over the image of pixels (..., 2)."""
    return np.asarray(2.0 * pixels / (camera.width - 1, camera.height - 1) - 1.0)


@dataclass(frozen=True)
class SensorModel:
    """A choice of unknowns of a sensor: the polynomial always, lens and field optional."""

    lens: bool = True
    field: bool = True

    @property
    def size(self) -> int:
        """Number of parameters of a sensor: polynomial, lens, ball, field."""
        return self.field_start + (FIELD if self.field else 0)

    @property
    def field_start(self) -> int:
        return POLYNOMIAL + (LENS + BALL if self.lens else 0)

    @cached_property
    def field_precision(self) -> Array:
        """Prior information (FIELD, FIELD) of control points whose field has unit variance.

        Matern 3/2 over image and inverse depth.
        """
        inverses = [
            np.linalg.inv(_matern(np.array(_KNOTS), _FIELD_REACH_W)),
            np.linalg.inv(_matern(2.0 * np.arange(_ROWS) / (_ROWS - 2), _FIELD_REACH / 0.75)),
            np.linalg.inv(_matern(2.0 * np.arange(_COLUMNS) / (_COLUMNS - 2), _FIELD_REACH)),
        ]
        return np.asarray(np.kron(inverses[0], np.kron(inverses[1], inverses[2])))

    @property
    def widths_at(self) -> Indices:
        """Indices of the parameters whose widths are uncertain: gain, lens, ball."""
        lens = range(POLYNOMIAL, POLYNOMIAL + LENS + BALL) if self.lens else ()
        return np.array([1, *lens], np.int64)

    def prior(self, parameters: Array, widths: Array, field_per_m: float) -> Array:
        """Prior information (U, U) at parameters (U,); ``widths`` (5,) of the classes.

        The polynomial's prior has heavy tails (Student's t), so that it hardly restrains a sensor
        whose errors are large.
        """
        information = np.zeros((self.size, self.size))
        off = parameters[:POLYNOMIAL] / TOLERANCE
        inner = np.arange(POLYNOMIAL)
        information[inner, inner] = TOLERANCE**-2.0 * TAIL / (TAIL + off**2)
        uncertain = self.widths_at
        information[uncertain, uncertain] = widths[_WIDTH_OF[: len(uncertain)]] ** -2.0
        if self.field:
            start = self.field_start
            information[start:, start:] = self.field_precision / field_per_m**2
        return information

    def expanded(self, parameters: Array, model: SensorModel) -> Array:
        """Parameters of another, larger model with what it adds at zero."""
        whole = np.zeros(model.size)
        whole[: self.field_start] = parameters[: self.field_start]
        if self.field:
            whole[model.field_start :] = parameters[self.field_start :]
        return whole

    def polynomial_design(self, inverse: Array, place: Array) -> Array:
        """Derivatives (n, 6) of corrected inverse depths by p0..p5.

        To be taken at expected inverse depths: noise on both sides of an equation biases it.
        """
        return np.stack(
            [
                np.ones_like(inverse),
                inverse,
                (inverse - MIDDLE) ** 2,
                place[..., 0],
                place[..., 1],
                np.polynomial.polynomial.polyval(inverse, _LAW),
            ],
            axis=-1,
        )

    def field_design(self, inverse: Array, place: Array) -> tuple[Indices, Array]:
        """Indices (n, 18) of control points and their weights at inverse depths and positions."""
        k, weight_k = linear_basis(inverse, np.array(_KNOTS))
        i, weight_i = quadratic_basis(place[..., 0], _COLUMNS)
        j, weight_j = quadratic_basis(place[..., 1], _ROWS)
        index = (
            (k[:, None, None, None] + np.arange(2)[:, None, None]) * _ROWS * _COLUMNS
            + (j[:, None, None, None] + np.arange(3)[:, None]) * _COLUMNS
            + (i[:, None, None, None] + np.arange(3))
        )
        weight = (
            weight_k[:, :, None, None] * weight_j[:, None, :, None] * weight_i[:, None, None, :]
        )
        return index.reshape(len(inverse), -1), weight.reshape(len(inverse), -1)

    def change(self, parameters: Array, inverse: Array, place: Array) -> Array:
        """Change (n,) of inverse depths by the parameters."""
        total = self.polynomial_design(inverse, place) @ parameters[:POLYNOMIAL]
        if self.field:
            control = parameters[self.field_start :].reshape(len(_KNOTS), _ROWS, _COLUMNS)
            _add_field(total, inverse, place, np.array(_KNOTS), control)
        return np.asarray(total)

    def camera(self, believed: CameraCalibration, parameters: Array) -> CameraCalibration:
        """The camera with the lens of the parameters."""
        if not self.lens:
            return believed
        focal, cx, cy, k1 = parameters[POLYNOMIAL : POLYNOMIAL + LENS]
        K, distortion = believed.K.copy(), believed.distortion.copy()
        K[0, 0] *= 1.0 + focal
        K[1, 1] *= 1.0 + focal
        K[:2, 2] += (cx, cy)
        distortion[0] += k1
        return replace(believed, K=K, distortion=distortion)

    def seen_through(self, believed: CameraCalibration, parameters: Array, centers: Array) -> Array:
        """Places (n, 3), at the same depths, of what the believed lens puts at ``centers``."""
        if not self.lens or not len(centers):
            return centers
        ray = pixel_rays(self.camera(believed, parameters), project(believed, centers))
        return np.column_stack([ray, np.ones(len(ray))]) * centers[:, 2:]

    def lens_design(self, camera: CameraCalibration, ray: Array) -> Array:
        """Derivatives (n, 2, 4) of rays x, y by focal length, principal point and k1.

        To first order in k1: x_undistorted = x (1 - k1 r^2).
        """
        square = np.sum(ray**2, axis=-1)
        design = np.zeros((*ray.shape[:-1], 2, LENS))
        design[..., 0] = -ray
        design[..., 0, 1] = -1.0 / camera.K[0, 0]
        design[..., 1, 2] = -1.0 / camera.K[1, 1]
        design[..., 3] = -ray * square[..., None]
        return design

    def flattening(self, parameters: Array) -> float:
        """Flattening of the ball as this camera sees it."""
        return float(parameters[POLYNOMIAL + LENS]) if self.lens else 0.0

    def correction(self, parameters: Array) -> DepthCorrection:
        """The depth correction as the calibration file has it."""
        p0, p1, p2, gx, gy, p5 = (float(value) for value in parameters[:POLYNOMIAL])
        field = None
        if self.field:
            control = parameters[self.field_start :].reshape(len(_KNOTS), _ROWS, _COLUMNS)
            field = DepthField(_KNOTS, control.copy())
        coefficients = p5 * _LAW
        coefficients[:3] += (p0 + p2 * MIDDLE**2, 1.0 + p1 - 2.0 * p2 * MIDDLE, p2)
        return DepthCorrection(tuple(coefficients.tolist()), (gx, gy), field)


@numba.njit(cache=True, nogil=True)
def _add_field(total, inverse, place, knots, control):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the field's values (n,); see ``station.core.depth.field``, whose bases these are."""
    layers, rows, columns = control.shape
    for n in range(len(inverse)):
        k = 0
        while k < layers - 2 and inverse[n] >= knots[k + 1]:
            k += 1
        s = min(max((inverse[n] - knots[k]) / (knots[k + 1] - knots[k]), 0.0), 1.0)
        x = min(max(0.5 * (place[n, 0] + 1.0), 0.0), 1.0) * (columns - 2)
        y = min(max(0.5 * (place[n, 1] + 1.0), 0.0), 1.0) * (rows - 2)
        i, j = min(int(x), columns - 3), min(int(y), rows - 3)
        x, y = x - i, y - j
        across = (0.5 * (1.0 - x) ** 2, 0.5 + x - x * x, 0.5 * x * x)
        down = (0.5 * (1.0 - y) ** 2, 0.5 + y - y * y, 0.5 * y * y)
        for b in range(3):
            for c in range(3):
                near = (1.0 - s) * control[k, j + b, i + c] + s * control[k + 1, j + b, i + c]
                total[n] += down[b] * across[c] * near


COARSE, FULL = SensorModel(lens=False, field=False), SensorModel()


def _matern(at: Array, reach: float) -> Array:
    apart = np.sqrt(3.0) * np.abs(at[:, None] - at) / reach
    return np.asarray((1.0 + apart) * np.exp(-apart) + 1e-6 * np.eye(len(at)))
