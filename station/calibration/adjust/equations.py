"""Normal equations of one camera's sightings and surfaces, its sensor's parameters included.

Each patch of pixels gives one residual r = w + D theta - w_expected, with the measured inverse
depth w, the sensor's parameters theta (`sensor_model`) and the expected inverse depth of a ball
(centre c, radius R) or a plane along the patch's ray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.ball_shape import SHAPE, shape_terms
from station.calibration.adjust.problem import Sightings, Surface
from station.calibration.adjust.sensor_model import SensorModel
from station.calibration.detect.ball_image import ball_inverse_depth
from station.core.geometry import level_axes
from station.core.lens import pixel_rays
from station.core.rig import CameraCalibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

TREMOR_M = 2e-4
"""Standard deviation along each axis of a hand's tremor about a path that bends every tenth of a
second."""
ROUNDNESS = 3e-3
"""Standard deviation of the radius of a play ball from one side to another, relative."""
_NO_TRUST = 1e-9
_HUBER = 3.0
"""Patches of a surface beyond so many standard deviations count less (Huber)."""


@dataclass(frozen=True, slots=True)
class BallEquations:
    """Normal equations of (centre, radius, shape; theta) of n detections, H (n, 9, 9) and so on.

    Centre and shape are in the camera's frame. ``theta_matrix`` (U, U) and ``theta_gradient``
    (U,) are summed over the detections.
    """

    matrix: Array
    gradient: Array
    mixed: Array
    """(n, 9, U)"""
    theta_matrix: Array
    theta_gradient: Array

    def of_sphere(self) -> BallEquations:
        """The equations (n, 4, 4) without the shape."""
        return replace(
            self,
            matrix=self.matrix[:, :4, :4],
            gradient=self.gradient[:, :4],
            mixed=self.mixed[:, :4],
        )

    def summed(self) -> BallEquations:
        """The sum over all detections, for a ball at rest."""
        return BallEquations(
            self.matrix.sum(axis=0)[None],
            self.gradient.sum(axis=0)[None],
            self.mixed.sum(axis=0)[None],
            self.theta_matrix,
            self.theta_gradient,
        )

    def marginalised(self, radius_m: float, trust: Array) -> BallEquations:
        """The equations with a tremor and a radius error of each detection marginalised.

        The four nuisance parameters d with prior information L are eliminated: H becomes
        H - H_d^T (H_dd + L)^-1 H_d with the rows H_d of centre and radius, and so on. ``trust``
        (n,) is what the equations were weighed by.
        """
        prior = np.diag(np.array([*[TREMOR_M] * 3, ROUNDNESS * radius_m]) ** -2.0)
        weighed = np.maximum(trust, _NO_TRUST)[:, None, None] * prior
        matrix, gradient, mixed = self.matrix[:, :4], self.gradient[:, :4], self.mixed[:, :4]
        inverse = np.linalg.inv(matrix[:, :, :4] + weighed)
        taken = np.swapaxes(matrix, 1, 2) @ inverse
        root = np.swapaxes(np.linalg.cholesky(inverse), 1, 2)
        half = (root @ mixed).reshape(4 * len(root), mixed.shape[-1])
        return BallEquations(
            self.matrix - taken @ matrix,
            self.gradient - np.einsum("nij,nj->ni", taken, gradient),
            self.mixed - taken @ mixed,
            self.theta_matrix - half.T @ half,
            self.theta_gradient - half.T @ (root @ gradient[..., None]).ravel(),
        )

    def moved(self, shift: Array) -> BallEquations:
        """The equations about centres that lie elsewhere by shifts (n, 3)."""
        return BallEquations(
            self.matrix,
            self.gradient + np.einsum("nij,nj->ni", self.matrix[..., :3], shift),
            self.mixed,
            self.theta_matrix,
            self.theta_gradient + np.einsum("niu,ni->u", self.mixed[:, :3], shift),
        )


def center_equations(seen: Sightings, rows: BallRows) -> tuple[Array, Array]:
    """H (n, 4, 4) and gradient (n, 4) of centre and radius, without the sensor's parameters."""
    jacobian = rows.jacobian[..., :4]
    weighted = jacobian * seen.weight[..., None]
    return (
        np.swapaxes(weighted, 1, 2) @ jacobian,
        np.einsum("nki,nk->ni", weighted, rows.residual),
    )


def ball_equations(
    seen: Sightings, camera: CameraCalibration, model: SensorModel, rows: BallRows, trust: Array
) -> BallEquations:
    """All equations, each detection weighed by its trust (n,)."""
    weight = seen.weight * trust[:, None]
    weighted = rows.jacobian * weight[..., None]
    patches = seen.inverse.shape[1]
    design = _design(
        model, camera, rows.expected.ravel(), seen.place.reshape(-1, 2),
        rows.ray.reshape(-1, 2), rows.by_ray.reshape(-1, 2), rows.by_flattening.ravel(),
    )  # fmt: skip
    return BallEquations(
        np.swapaxes(weighted, 1, 2) @ rows.jacobian,
        np.einsum("nki,nk->ni", weighted, rows.residual),
        *design.products(
            model.size,
            rows.jacobian.reshape(-1, 4 + SHAPE),
            weight.ravel(),
            rows.residual.ravel(),
            patches,
        ),
    )


def corrected_centers(
    seen: Sightings, camera: CameraCalibration, model: SensorModel, parameters: Array,
    radius_m: float, shape: Array,
) -> Array:  # fmt: skip
    """Centres (n, 3) of the detections, each estimated alone, with the sensor's corrections.

    ``shape`` (n, 5) is the ball's in the camera's frame.
    """
    centers = model.seen_through(camera, parameters, seen.centers).copy()
    ray = pixel_rays(model.camera(camera, parameters), seen.pixels)
    for _ in range(4):
        rows = _rows_along(ray, seen, model, centers, parameters, radius_m, shape)
        matrix, gradient = center_equations(seen, rows)
        centers -= np.linalg.solve(matrix[:, :3, :3], gradient[:, :3, None])[..., 0]
    return centers


@dataclass(frozen=True, slots=True)
class BallRows:
    """Residuals (n, k) of the patches of n detections, and their derivatives."""

    residual: Array
    expected: Array
    """Measured inverse depth as it is expected."""
    jacobian: Array
    """(n, k, 9) by centre, radius and shape."""
    ray: Array
    by_ray: Array
    """(n, k, 2): derivative of the ball's inverse depth."""
    by_flattening: Array
    """(n, k)"""


def ball_rows(
    seen: Sightings, camera: CameraCalibration, model: SensorModel, centers: Array,
    parameters: Array, radius_m: float, shape: Array,
) -> BallRows:  # fmt: skip
    """Rows of balls with centres (n, 3), through a sensor with its parameters (U,).

    ``shape`` (n, 5) is the ball's in the camera's frame.
    """
    ray = pixel_rays(model.camera(camera, parameters), seen.pixels)
    return _rows_along(ray, seen, model, centers, parameters, radius_m, shape)


def _rows_along(
    ray: Array, seen: Sightings, model: SensorModel, centers: Array, parameters: Array,
    radius_m: float, shape: Array,
) -> BallRows:  # fmt: skip
    w, gradient = ball_inverse_depth(centers, ray, radius_m)
    # A side that is flatter by k stands k R (1 - cos^2) higher where it is so far off its middle.
    towards = np.concatenate([ray, np.ones((*ray.shape[:2], 1))], axis=2) / w[..., None]
    normals = (towards - centers[:, None]) / radius_m
    cosine = np.einsum("nki,ni->nk", normals, centers) / np.linalg.norm(centers, axis=1)[:, None]
    higher = gradient[..., 3] * radius_m
    flatter = higher * (1.0 - np.minimum(cosine**2, 1.0))
    shaped = higher[..., None] * shape_terms(normals)
    w = w + model.flattening(parameters) * flatter + np.einsum("nkm,nm->nk", shaped, shape)
    place = seen.place.reshape(-1, 2)
    flat = w.ravel()
    expected = flat - model.change(parameters, flat, place)
    change = model.change(parameters, expected, place).reshape(w.shape)
    return BallRows(
        seen.inverse + change - w,
        expected.reshape(w.shape),
        -np.concatenate([gradient[..., :4], shaped], axis=2),
        ray,
        gradient[..., 4:],
        flatter,
    )


@dataclass(frozen=True, slots=True)
class PlaneEquations:
    """Normal equations of (plane m, bow) (12) and theta (U) of one view of a surface."""

    matrix: Array
    """(12, 12)"""
    gradient: Array
    """(12,)"""
    mixed: Array
    """(12, U)"""
    theta_matrix: Array
    theta_gradient: Array


def plane_equations(
    surface: Surface, camera: CameraCalibration, model: SensorModel, plane: Array,
    parameters: Array, bow: Array,
) -> PlaneEquations:  # fmt: skip
    """Equations at a plane m (3,) and a bow (9,), which only floors have."""
    ray = pixel_rays(model.camera(camera, parameters), surface.pixels)
    towards = np.column_stack([ray, np.ones(len(ray))])
    w = towards @ plane
    # What stands h out of a plane at the distance d raises the inverse depth by w h / d.
    raised = np.zeros((len(ray), len(bow)))
    if surface.bow_terms is not None:
        raised = surface.bow_terms * (w * np.linalg.norm(plane))[:, None]
    expected = w + raised @ bow
    measured = expected - model.change(parameters, expected, surface.place)
    change = model.change(parameters, measured, surface.place)
    residual = surface.inverse + change - expected
    squared = surface.weight * residual**2
    spread = max(1.0, float(np.median(squared) / _MEDIAN_SQUARE))
    size = np.sqrt(squared / spread)
    weight = surface.weight / spread * np.minimum(1.0, _HUBER / np.maximum(size, _HUBER))
    jacobian = np.concatenate([-towards, -raised], axis=1)
    by_ray = np.broadcast_to(plane[:2], ray.shape)
    nothing = np.zeros(len(ray))
    design = _design(model, camera, measured, surface.place, ray, by_ray, nothing)
    weighted = jacobian * weight[:, None]
    mixed, theta_matrix, theta_gradient = design.products(
        model.size, jacobian, weight, residual, len(weight)
    )
    return PlaneEquations(
        weighted.T @ jacobian,
        weighted.T @ residual,
        mixed[0],
        theta_matrix,
        theta_gradient,
    )


_MEDIAN_SQUARE = 0.4549
"""Median of the square of a standard normal number."""


@dataclass(frozen=True, slots=True)
class _Design:
    """Derivatives of n residuals by the sensor's parameters, most of which are zero."""

    dense: Array
    """(n, d) by the first d parameters."""
    index: Indices
    """(n, s) of the others that count, increasing, and ..."""
    value: Array
    """... the derivatives by them."""

    def products(
        self, size: int, jacobian: Array, weight: Array, residual: Array, rows: int
    ) -> tuple[Array, Array, Array]:
        """J^T W D of every so many rows (n / rows, j, size), D^T W D and D^T W r."""
        mixed = np.zeros((len(weight) // max(rows, 1), jacobian.shape[1], size))
        matrix, gradient = np.zeros((size, size)), np.zeros(size)
        _accumulate(
            self.dense, self.index, self.value, np.ascontiguousarray(jacobian), weight, residual,
            rows, mixed, matrix, gradient,
        )  # fmt: skip
        return mixed, matrix + np.triu(matrix, 1).T, gradient


@numba.njit(cache=True, nogil=True)
def _accumulate(dense, index, value, jacobian, weight, residual, rows, mixed, matrix, gradient):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the products of all rows; of the symmetric one its upper triangle."""
    first, others = dense.shape[1], index.shape[1]
    place = np.empty(first + others, np.int64)
    share = np.empty(first + others)
    for n in range(len(weight)):
        if weight[n] == 0.0:
            continue
        for a in range(first):
            place[a], share[a] = a, dense[n, a]
        for a in range(others):
            place[first + a], share[first + a] = index[n, a], value[n, a]
        for a in range(first + others):
            scaled = weight[n] * share[a]
            if scaled == 0.0:
                continue
            gradient[place[a]] += scaled * residual[n]
            for b in range(a, first + others):
                matrix[place[a], place[b]] += scaled * share[b]
            for j in range(jacobian.shape[1]):
                mixed[n // rows, j, place[a]] += scaled * jacobian[n, j]


def _design(
    model: SensorModel, camera: CameraCalibration, measured: Array, place: Array, ray: Array,
    by_ray: Array, by_flattening: Array,
) -> _Design:  # fmt: skip
    """Derivatives of residuals by the sensor's parameters."""
    columns = [model.polynomial_design(measured, place)]
    if model.lens:
        columns.append(-np.einsum("ni,nij->nj", by_ray, model.lens_design(camera, ray)))
        columns.append(-by_flattening[:, None])
    dense = np.concatenate(columns, axis=1)
    if not model.field:
        return _Design(dense, np.zeros((len(dense), 0), np.int64), np.zeros((len(dense), 0)))
    index, value = model.field_design(measured, place)
    return _Design(dense, index + model.field_start, value)


def bow_terms(points: Array, mark: Array, up: Array) -> Array:
    """Terms (n, 9) of the floor's bow at points (n, 3), about the mark.

    The linear ones are what the floor leans at the mark from the plane. Only a plumb line tells
    them from the plane's own slope, which is otherwise known no better than a bowed floor leans.
    """
    first, second = level_axes(up)
    away = points - mark
    x, y = away @ first, away @ second
    return np.stack([x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], axis=-1)
