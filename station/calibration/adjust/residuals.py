"""Residuals of the ball detections at a state, their squared deviations and robust weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.equations import (
    BallEquations,
    BallRows,
    ball_rows,
    center_equations,
)
from station.calibration.adjust.problem import Indices, Problem, Sightings, State, seen_shape
from station.calibration.adjust.trajectory import path_points

Array = NDArray[np.float64]

_NEAR_M = 0.05
"""Depth errors that are not corrected yet shift a ball along its ray, by less than that."""
_BESIDE_M = 0.015
"""The equations are linear enough within this distance beside the detected centre."""
_GATE = 11.3
"""Squared deviation of three numbers that one in a hundred exceeds; what is beyond counts less."""
_REJECT = 60.0
_MIN_TYPICAL = 0.2
"""Least typical deviation, as a share of the noise's variance."""
MEDIAN = 2.366
"""Median of chi-square with three degrees of freedom."""


@dataclass(frozen=True, slots=True)
class DetectionResiduals:
    """Residuals and derivatives of one camera's n detections at a state."""

    centers: Array
    """(n, 3) of the ball, camera frame."""
    near: Array
    """(n, 3), where the equations are linearised."""
    rows: BallRows
    deviation: Array
    """(n,): squared distance of each detection's own centre from the one assumed."""
    robust: Array
    """(n,): weights, 0 for what is no ball."""
    first: Indices
    """(n,): first of four control points of the path, nothing for a ball at rest, ..."""
    value: Array
    """... their weights (n, 4) ..."""
    rate: Array
    """... and the rates of these."""

    @classmethod
    def along_path(cls, problem: Problem, state: State, seen: Sightings) -> DetectionResiduals:
        """Detections of the waved ball."""
        pose = state.poses[seen.camera]
        basis = state.grid.basis(seen.times_s + state.clock_s[seen.camera])
        centers = (path_points(state.controls, *basis[:2]) - pose[:3, 3]) @ pose[:3, :3]
        camera, sensor = problem.cameras[seen.camera], state.sensors[seen.camera]
        near = _near(centers, problem.model.seen_through(camera, sensor, seen.centers))
        shape = seen_shape(problem, state, seen.camera, seen.times_s)
        rows = _rows(problem, state, seen, near, shape)
        balls = _without_sensor(seen, rows).moved(centers - near)
        deviation = _deviation(balls.marginalised(problem.radius_m, np.ones(len(centers))))
        return cls(centers, near, rows, deviation, robust_weight(deviation), *basis)

    @classmethod
    def at_rest(
        cls, problem: Problem, state: State, seen: Sightings, centers: Array, shape: Array
    ) -> DetectionResiduals:
        """Detections of a ball that rests; its shape (n, 5) in the camera's frame."""
        rows = _rows(problem, state, seen, centers, shape)
        deviation = _deviation(_without_sensor(seen, rows))
        basis = (np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros((0, 4)))
        return cls(centers, centers, rows, deviation, robust_weight(deviation), *basis)


@dataclass(frozen=True, slots=True)
class FitQuality:
    """Agreement of the waved detections with a state."""

    deviations: Mapping[str, Array]
    scale: float
    """Observed over expected standard deviation of the detections' centres."""

    @classmethod
    def of(cls, problem: Problem, state: State) -> FitQuality:
        deviations, cost, count = {}, 0.0, 0.0
        share = np.zeros(state.grid.count)
        for name, seen in problem.waved.items():
            if not len(seen.times_s):
                continue
            residuals = DetectionResiduals.along_path(problem, state, seen)
            deviations[name] = residuals.deviation
            cost += float(np.sum(residuals.robust * np.minimum(residuals.deviation, _GATE)))
            count += float(np.sum(residuals.robust))
            for k in range(4):
                np.add.at(share, residuals.first + k, 0.25 * residuals.robust)
        unknowns = 3.0 * np.sum(np.abs(share) > 0.5) + 12 * len(problem.cameras)
        return cls(deviations, float(np.sqrt(cost / max(3.0 * count - unknowns, 1.0))))


def _rows(
    problem: Problem, state: State, seen: Sightings, centers: Array, shape: Array
) -> BallRows:
    name = seen.camera
    return ball_rows(
        seen, problem.cameras[name], problem.model, centers, state.sensors[name], state.radius_m,
        shape,
    )  # fmt: skip


def _without_sensor(seen: Sightings, rows: BallRows) -> BallEquations:
    matrix, gradient = center_equations(seen, rows)
    return BallEquations(
        matrix, gradient, np.zeros((len(matrix), 4, 0)), np.zeros((0, 0)), np.zeros(0)
    )


def _deviation(balls: BallEquations) -> Array:
    inner, right = balls.matrix[:, :3, :3], balls.gradient[:, :3]
    solved = np.linalg.solve(inner, right[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", right, solved))


def _near(centers: Array, detected: Array) -> Array:
    """Points of linearisation (n, 3): as far as the centres, but where the rays meet the ball.

    The image of a ball does not tell how well a place decimetres away agrees with it.
    """
    ray = detected / np.linalg.norm(detected, axis=1, keepdims=True)
    off = centers - detected
    farther_m = np.einsum("ni,ni->n", off, ray)
    beside_m = np.linalg.norm(off - farther_m[:, None] * ray, axis=1)
    near = detected + np.clip(farther_m, -_NEAR_M, _NEAR_M)[:, None] * ray
    usable = (beside_m < _BESIDE_M) & (np.abs(farther_m) < _NEAR_M)
    return np.asarray(np.where(usable[:, None], centers, near))


def robust_weight(deviation: Array) -> Array:
    """Weights (n,) that leave out what deviates far more than most do.

    Deviations are relative to the typical one: before the depth errors are corrected, all
    detections deviate and none may be left out for it. Afterwards most deviate by less than the
    assumed noise, so that fingers over the ball stand out even within that noise.
    """
    typical = max(float(np.median(deviation)) / MEDIAN, _MIN_TYPICAL)
    deviation = deviation / typical
    far = np.minimum(1.0, _GATE / np.maximum(deviation, _GATE))
    return np.where(deviation < _REJECT, far, 0.0)
