"""The normal equations of all measurements: poses, sensors, clock offsets, the path, surfaces.

Gauss-Newton over all measurements, each patch of pixels weighed by the sensor's noise. The unknowns
are two groups. The path's control points touch only their neighbours, so their normal matrix is
banded. All others border it. Factoring the band and taking the Schur complement gives the exact
step, and the border's covariance with the path marginalised.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.sparse import bsr_matrix, csr_matrix

from station.calibration.adjust.ball_shape import SHAPE, shape_turn
from station.calibration.adjust.contacts import Contacts
from station.calibration.adjust.equations import (
    BallEquations,
    ball_equations,
    plane_equations,
)
from station.calibration.adjust.priors import priors
from station.calibration.adjust.problem import (
    BOW_SIZE,
    POSE_AND_CLOCK,
    Indices,
    Layout,
    Problem,
    Sightings,
    State,
    Surface,
)
from station.calibration.adjust.residuals import DetectionResiduals
from station.calibration.adjust.trajectory import path_points
from station.core.geometry import skew
from station.core.kinect_v1 import FROZEN_SHARE

Array = NDArray[np.float64]


class NormalEquations:
    """The normal equations at a state; ``scale`` is the ball's observed over its expected noise."""

    def __init__(self, problem: Problem, layout: Layout, state: State, scale: float = 1.0) -> None:
        self._problem, self._layout, self._state = problem, layout, state
        self._trust = scale**-2.0
        count = state.grid.count
        self._border = np.zeros((layout.size, layout.size))
        self._gradient = np.zeros(layout.size)
        self._coupling = np.zeros((layout.size, 3 * count))
        self._band = np.zeros((12, 3 * count))
        self._path_gradient = np.zeros(3 * count)
        self._smooth()
        self._priors()
        for seen in problem.waved.values():
            self._add_waved(seen)
        for place, sightings in problem.resting.items():
            for seen in sightings:
                self._add_resting(place, seen)
        for surface in problem.surfaces:
            self._add_surface(surface)
        self._add_contacts()

    def solve(self) -> tuple[Array, Array, float]:
        """Steps of the border (m,) and the path (count, 3); the border's in standard deviations."""
        information, gradient = self.reduced()
        step = np.asarray(-cho_solve(cho_factor(information, check_finite=False), gradient))
        path = -self._band_solve(self._path_gradient + self._coupling.T @ step)
        return step, path.reshape(-1, 3), float(np.sqrt(step @ information @ step))

    def reduced(self) -> tuple[Array, Array]:
        """The border's information (m, m) and gradient (m,), the path marginalised."""
        self._factor = cholesky_banded(self._band)
        # D = U^T U: half of the solution is enough for the symmetric E D^-1 E^T.
        half, fault = dtbtrs(self._factor, self._coupling.T, uplo="U", trans="T")
        if fault:
            raise np.linalg.LinAlgError("the path is not determined")
        reduced = self._border - half.T @ half
        gradient = self._gradient - self._coupling @ self._band_solve(self._path_gradient)
        return np.asarray(0.5 * (reduced + reduced.T)), gradient

    def _band_solve(self, right: Array) -> Array:
        return np.asarray(cho_solve_banded((self._factor, False), right))

    def _smooth(self) -> None:
        band = self._state.grid.smoothness()
        for offset in range(3):
            # One axis' neighbours are three columns apart once the axes are interleaved.
            self._band[11 - 3 * offset] += np.repeat(band[2 - offset], 3)
        path = self._state.controls
        bend = path[2:] - 2.0 * path[1:-1] + path[:-2]
        weight = band[2, 0]
        gradient = np.zeros_like(path)
        gradient[2:] += bend
        gradient[1:-1] -= 2.0 * bend
        gradient[:-2] += bend
        self._path_gradient += weight * gradient.ravel()
        self._band[11] += 1e-6 * weight

    def _priors(self) -> None:
        for prior in priors(self._problem, self._layout, self._state):
            self._border[np.ix_(prior.index, prior.index)] += prior.information
            self._gradient[prior.index] += prior.information @ prior.values

    def _balls(self, seen: Sightings, residuals: DetectionResiduals, trust: Array) -> BallEquations:
        problem = self._problem
        return ball_equations(
            seen, problem.cameras[seen.camera], problem.model, residuals.rows, trust
        )

    def _add_waved(self, seen: Sightings) -> None:
        if not len(seen.times_s):
            return
        state, layout, name = self._state, self._layout, seen.camera
        pose = state.poses[name]
        residuals = DetectionResiduals.along_path(self._problem, state, seen)
        first, value, centers = residuals.first, residuals.value, residuals.centers
        trust = self._trust * residuals.robust
        balls = self._balls(seen, residuals, trust).moved(centers - residuals.near)
        balls = balls.marginalised(self._problem.radius_m, trust)

        chain = np.zeros((len(centers), 4, POSE_AND_CLOCK + 1))
        chain[:, :3, :3] = skew(centers)
        chain[:, :3, 3:6] = -np.eye(3)
        chain[:, :3, 6] = path_points(state.controls, first, residuals.rate) @ pose[:3, :3]
        chain[:, 3, 7] = 1.0
        index = np.concatenate([layout.camera(name)[:POSE_AND_CLOCK], layout.radius])
        sensor = layout.sensor(name)
        path = _spline_rows(first, value, pose[:3, :3].T, state.grid.count)
        if self._problem.shape_grid.count:
            self._add_shape(seen, balls, chain, index, path)
        balls = balls.of_sphere()
        self._add_balls(balls, chain, index, sensor)
        carried = balls.matrix @ chain
        border = np.concatenate([carried[:, :3], balls.mixed[:, :3]], axis=2)
        coupling = path.T @ border.reshape(-1, border.shape[2])
        columns = np.concatenate([index, sensor])
        kept = columns >= 0
        self._coupling[columns[kept]] += coupling.T[kept]
        self._path_gradient += path.T @ balls.gradient[:, :3].ravel()
        self._add_band(first, value, pose[:3, :3] @ balls.matrix[:, :3, :3] @ pose[:3, :3].T)

    def _add_shape(
        self, seen: Sightings, balls: BallEquations, chain: Array, index: Indices, path: csr_matrix
    ) -> None:
        """The waved ball's shape, with its products with all else."""
        layout, state, name = self._layout, self._state, seen.camera
        grid, own = self._problem.shape_grid, layout.waved_shape
        first, value, _ = grid.basis(seen.times_s + state.clock_s[name])
        turn = shape_turn(state.poses[name][:3, :3].T)
        rows = _spline_rows(first, value, turn, grid.count)
        self._border[own, own] += (rows.T @ _blocks(balls.matrix[:, 4:, 4:]) @ rows).toarray()
        self._gradient[own] += rows.T @ balls.gradient[:, 4:].ravel()
        kept, sensor = index >= 0, layout.sensor(name)
        columns = np.concatenate([index[kept], sensor])
        carried = balls.matrix[:, 4:, :4] @ chain[..., kept]
        mixed = np.concatenate([carried, balls.mixed[:, 4:]], axis=2)
        product = rows.T @ mixed.reshape(-1, mixed.shape[2])
        self._border[own, columns] += product
        self._border[columns, own] += product.T
        self._coupling[own] += (rows.T @ _blocks(balls.matrix[:, 4:, :3]) @ path).toarray()

    def _add_band(self, first: Indices, value: Array, matrix: Array) -> None:
        """Information (n, 3, 3) of points on the path, reference frame."""
        for j in range(4):
            for k in range(j, 4):
                block = (value[:, j] * value[:, k])[:, None, None] * matrix
                for a in range(3):
                    for b in range(3):
                        offset = 3 * (k - j) + b - a
                        if offset >= 0:
                            column = 3 * (first + k) + b
                            np.add.at(self._band[11 - offset], column, block[:, a, b])

    def _add_resting(self, place: str, seen: Sightings) -> None:
        state, layout, name = self._state, self._layout, seen.camera
        pose, detections = state.poses[name], len(seen.times_s)
        center = (state.places[place] - pose[:3, 3]) @ pose[:3, :3]
        centers = np.repeat(center[None], detections, axis=0)
        turn = shape_turn(pose[:3, :3].T)
        shape = turn @ state.place_shapes.get(place, np.zeros(SHAPE))
        shapes = np.repeat(shape[None], detections, axis=0)
        residuals = DetectionResiduals.at_rest(self._problem, state, seen, centers, shapes)
        # Detections of a still ball share the part of the noise that does not change.
        trust = self._trust * residuals.robust / (FROZEN_SHARE * detections + 1.0 - FROZEN_SHARE)
        balls = self._balls(seen, residuals, trust).summed()
        balls = balls.marginalised(self._problem.radius_m, np.array([self._trust]))
        chain = np.zeros((1, 4 + SHAPE, 6 + 3 + 1 + SHAPE))
        chain[0, :3, :3], chain[0, :3, 3:6] = skew(center), -np.eye(3)
        chain[0, :3, 6:9] = pose[:3, :3].T
        chain[0, 3, 9] = 1.0
        chain[0, 4:, 10:] = turn
        index = np.concatenate(
            [
                layout.camera(name)[:6],
                layout.triple(place),
                layout.radius,
                layout.place_shape(place),
            ]
        )
        self._add_balls(balls, chain, index, layout.sensor(name))

    def _add_balls(
        self, balls: BallEquations, chain: Array, index: Indices, sensor: Indices
    ) -> None:
        kept = index >= 0
        chain, index = chain[..., kept], index[kept]
        carried = balls.matrix @ chain
        self._border[np.ix_(index, index)] += np.einsum("nij,nik->jk", chain, carried)
        self._gradient[index] += np.einsum("nij,ni->j", chain, balls.gradient)
        mixed = np.einsum("nij,niu->ju", chain, balls.mixed, optimize=True)
        self._add_sensor(mixed, index, sensor, balls.theta_matrix, balls.theta_gradient)

    def _add_sensor(
        self, mixed: Array, index: Indices, sensor: Indices, matrix: Array, gradient: Array
    ) -> None:
        # A sensor's parameters follow one another: slices cost a tenth of what indices do.
        own = slice(int(sensor[0]), int(sensor[-1]) + 1)
        self._border[index, own] += mixed
        self._border[own, index] += mixed.T
        self._border[own, own] += matrix
        self._gradient[own] += gradient

    def _add_surface(self, surface: Surface) -> None:
        problem, layout, state = self._problem, self._layout, self._state
        name = surface.camera
        pose, q = state.poses[name], state.planes[surface.surface]
        rotation, shift = pose[:3, :3], pose[:3, 3]
        m = rotation.T @ q / (1.0 - q @ shift)
        view = plane_equations(
            surface, problem.cameras[name], problem.model, m, state.sensors[name], state.bow
        )
        chain = np.zeros((3 + BOW_SIZE, 6 + 3 + BOW_SIZE))
        chain[:3, :3], chain[:3, 3:6] = skew(m), np.outer(m, m)
        chain[:3, 6:9] = rotation.T / (1.0 - q @ shift) + np.outer(m, shift) / (1.0 - q @ shift)
        chain[3:, 9:] = np.eye(BOW_SIZE)
        index = np.concatenate(
            [layout.camera(name)[:6], layout.triple(surface.surface), layout.bow]
        )
        kept = index >= 0
        chain, index = chain[:, kept], index[kept]
        self._border[np.ix_(index, index)] += chain.T @ view.matrix @ chain
        self._gradient[index] += chain.T @ view.gradient
        self._add_sensor(
            chain.T @ view.mixed, index, layout.sensor(name), view.theta_matrix, view.theta_gradient
        )

    def _add_contacts(self) -> None:
        """The ball rests on the floor or at a measured height above it, or hangs plumb."""
        contacts = Contacts.of(self._problem, self._layout, self._state)
        weighed = contacts.rows * contacts.weight[:, None]
        self._border += contacts.rows.T @ weighed
        self._gradient += weighed.T @ contacts.off_m


def _spline_rows(first: Indices, value: Array, turn: Array, count: int) -> csr_matrix:
    """Derivatives (d n, d count) of values (n, d), turned by a matrix (d, d), by control points."""
    size = len(turn)
    data = value[:, None, :, None] * turn[None, :, None, :]
    column = size * first[:, None, None, None] + np.arange(4 * size).reshape(1, 1, 4, size)
    column = np.broadcast_to(column, data.shape)
    rows, every = size * len(first), 4 * size
    return csr_matrix(
        (data.ravel(), column.ravel(), np.arange(0, every * rows + 1, every)),
        shape=(rows, size * count),
    )


def _blocks(matrices: Array) -> bsr_matrix:
    """Matrices (n, a, b) along a diagonal."""
    count, high, wide = matrices.shape
    return bsr_matrix(
        (np.ascontiguousarray(matrices), np.arange(count), np.arange(count + 1)),
        shape=(count * high, count * wide),
    )
