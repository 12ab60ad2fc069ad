"""All cameras at once: poses, depth corrections, clock offsets, the ball's path, flat surfaces.

Gauss-Newton on everything that was seen, each patch of pixels weighed by the sensor's noise.
Unknowns are two groups. The path's control points touch only their neighbours: their normal matrix
is banded. All others (some sixty) border it. Factoring the band and taking the Schur complement
gives the exact step in milliseconds, and the border's covariance with the path marginalised.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from station.calibration.detect.ball_image import ball_inverse_depth
from station.calibration.detect.detections import FLOOR
from station.calibration.solve import depth_correction
from station.calibration.solve.problem import (
    FOOT,
    PER_CAMERA,
    Indices,
    Layout,
    Problem,
    Sightings,
    State,
    Surface,
    moved_state,
)
from station.calibration.solve.trajectory import along
from station.core.geometry import skew

Array = NDArray[np.float64]

_ITERATIONS = 30
_SETTLED = 0.01
"""Step in standard deviations."""
CLOCK_TOLERANCE_S = 0.005
"""Standard deviation of one camera's clock against another's, before it is solved for."""
CONTACT_M = 0.0005
"""Standard deviation of a resting ball's height above the floor."""
TREMOR_M = 2e-4
"""By which a hand is off a path that bends every tenth of a second, along each axis."""
_TAIL = 4.0
"""Degrees of freedom of the prior of depth corrections (Student's t)."""
_NEAR_M = 0.05
"""Depth errors that are not corrected yet shift a ball along its ray, by less than that."""
_GATE = 11.3
"""Squared deviation of three numbers that one in a hundred exceeds; what is beyond counts less."""
_REJECT = 60.0
_LEAST_TYPICAL = 0.2
"""Least value of the noise's variance factor."""
MEDIAN = 2.366
"""Median of the squared deviation of three numbers."""


def local_equations(
    seen: Sightings, centers: Array, correction: Array, radius_m: float
) -> tuple[Array, Array]:
    """J'WJ (n, 8, 8) and J'Wr (n, 8) of (centre, depth correction) of each detection."""
    w, gradient = ball_inverse_depth(centers, seen.ray, radius_m)
    measured = w - depth_correction.design(w, seen.place) @ correction
    design = depth_correction.design(measured, seen.place)
    residual = seen.inverse + design @ correction - w
    rows = np.concatenate([-gradient[..., :3], design], axis=-1)
    weighted = rows * seen.weight[..., None]
    return (
        np.swapaxes(weighted, 1, 2) @ rows,
        np.einsum("nki,nk->ni", weighted, residual),
    )


def solve_joint(problem: Problem, start: State) -> State:
    """The most likely state, its covariance, and each detection's deviation.

    Where none is found, because what was seen contradicts itself, the last step is infinite.
    """
    try:
        with np.errstate(over="raise", invalid="raise"):
            return _settle(problem, start)
    except (np.linalg.LinAlgError, FloatingPointError, ValueError):
        return replace(start, last_step=np.inf)


def _settle(problem: Problem, start: State) -> State:
    layout = Layout.of(problem)
    state = start
    for _ in range(_ITERATIONS):
        equations = _Equations(problem, layout, state)
        step, path_step, size = equations.solve()
        state = moved_state(problem, layout, state, step)
        state = replace(state, controls=state.controls + path_step)
        if size < _SETTLED:
            break
    equations = _Equations(problem, layout, state)
    scale = equations.scale()
    # The detections tell how noisy they are, and nothing of priors and floors.
    information = _Equations(problem, layout, state, scale).schur()
    return replace(
        state,
        covariance=np.asarray(np.linalg.inv(information)),
        deviations=equations.deviations,
        scale=scale,
        last_step=size,
    )


class _Equations:
    """The normal equations at a state, with the ball's noise so many times what is expected."""

    def __init__(self, problem: Problem, layout: Layout, state: State, scale: float = 1.0) -> None:
        self._size = layout.size
        self._trust = scale**-2.0
        count = state.grid.count
        self._border = np.zeros((layout.size, layout.size))
        self._border_pull = np.zeros(layout.size)
        self._coupling = np.zeros((layout.size, 3 * count))
        self._band = np.zeros((12, 3 * count))
        self._path_pull = np.zeros(3 * count)
        self.deviations: dict[str, Array] = {}
        self._cost, self._seen = 0.0, 0.0
        self._path_share = np.zeros(count)
        self._smooth(state)
        self._priors(problem, layout, state)
        for name, seen in problem.waved.items():
            self._add_waved(name, seen, problem, layout, state)
        for place, sightings in problem.resting.items():
            for seen in sightings:
                self._add_resting(place, seen, problem, layout, state)
        for surface in problem.surfaces:
            self._add_surface(surface, layout, state)
        for place in problem.resting:
            self._add_contact(place, problem.radius_m, layout, state)

    def solve(self) -> tuple[Array, Array, float]:
        """Steps of the border (m,) and the path (count, 3); the border's in standard deviations."""
        schur = self.schur()
        pull = self._border_pull - self._coupling @ self._band_solve(self._path_pull)
        step = np.asarray(-np.linalg.solve(schur, pull))
        path = -self._band_solve(self._path_pull + self._coupling.T @ step)
        return step, path.reshape(-1, 3), float(np.sqrt(step @ schur @ step))

    def schur(self) -> Array:
        """The border's information, the path marginalised."""
        self._factor = cholesky_banded(self._band)
        reduced = self._border - self._coupling @ self._band_solve(self._coupling.T)
        return np.asarray(0.5 * (reduced + reduced.T))

    def scale(self) -> float:
        """Observed over expected deviation of the detections' centres."""
        unknowns = 3.0 * np.sum(np.abs(self._path_share) > 0.5) + self._size
        return float(np.sqrt(self._cost / max(3.0 * self._seen - unknowns, 1.0)))

    def _band_solve(self, right: Array) -> Array:
        return np.asarray(cho_solve_banded((self._factor, False), right))

    def _smooth(self, state: State) -> None:
        band = state.grid.smoothness()
        for offset in range(3):
            # One axis' neighbours are three columns apart once the axes are interleaved.
            self._band[11 - 3 * offset] += np.repeat(band[2 - offset], 3)
        path = state.controls
        bend = path[2:] - 2.0 * path[1:-1] + path[:-2]
        weight = band[2, 0]
        pull = np.zeros_like(path)
        pull[2:] += bend
        pull[1:-1] -= 2.0 * bend
        pull[:-2] += bend
        self._path_pull += weight * pull.ravel()
        self._band[11] += 1e-6 * weight

    def _priors(self, problem: Problem, layout: Layout, state: State) -> None:
        for name in problem.cameras:
            index = layout.correction(name)
            # Heavy tails: a sensor that the data say is far off is believed to be.
            off = state.corrections[name] / depth_correction.TOLERANCE
            information = depth_correction.TOLERANCE**-2.0 * _TAIL / (_TAIL + off**2)
            self._border[index, index] += information
            self._border_pull[index] += information * state.corrections[name]
            if name != layout.reference:
                clock = layout.camera(name)[6]
                self._border[clock, clock] += CLOCK_TOLERANCE_S**-2.0
                self._border_pull[clock] += state.clock_s[name] / CLOCK_TOLERANCE_S**2

    def _add_waved(
        self, name: str, seen: Sightings, problem: Problem, layout: Layout, state: State
    ) -> None:
        if not len(seen.times_s):
            return
        pose = state.poses[name]
        first, value, rate = state.grid.basis(seen.times_s + state.clock_s[name])
        centers = (along(state.controls, first, value) - pose[:3, 3]) @ pose[:3, :3]
        near = _near(centers, seen.centers)
        normal, pull = local_equations(seen, near, state.corrections[name], problem.radius_m)
        pull += np.einsum("nij,nj->ni", normal[..., :3], centers - near)
        normal, pull = trembling(normal, pull)
        deviation = _deviation(normal, pull)
        self.deviations[name] = deviation
        robust = _robust_weight(deviation)
        self._cost += float(np.sum(robust * np.minimum(deviation, _GATE)))
        self._seen += float(np.sum(robust))
        for k in range(4):
            np.add.at(self._path_share, first + k, 0.25 * robust)
        weight = self._trust * robust
        normal, pull = normal * weight[:, None, None], pull * weight[:, None]

        turn = pose[:3, :3].T
        speed = along(state.controls, first, rate) @ pose[:3, :3]
        chain = np.zeros((len(centers), 8, PER_CAMERA + 12))
        chain[:, :3, :3] = skew(centers)
        chain[:, :3, 3:6] = -np.eye(3)
        chain[:, :3, 6] = speed
        chain[:, 3:, FOOT:PER_CAMERA] = np.eye(depth_correction.PARAMETERS)
        for k in range(4):
            chain[:, :3, PER_CAMERA + 3 * k : PER_CAMERA + 3 * k + 3] = (
                value[:, k, None, None] * turn
            )
        carried = normal @ chain
        whole = np.swapaxes(chain, 1, 2) @ carried
        gradient = np.einsum("nij,ni->nj", chain, pull)

        index = layout.camera(name)
        kept = index >= 0
        columns = index[kept]
        camera, path = np.flatnonzero(kept), np.arange(PER_CAMERA, PER_CAMERA + 12)
        self._border[np.ix_(columns, columns)] += whole[:, camera][:, :, camera].sum(axis=0)
        self._border_pull[columns] += gradient[:, camera].sum(axis=0)
        column = 3 * first[:, None] + np.arange(12)
        np.add.at(self._path_pull, column, gradient[:, path])
        for i in range(12):
            for row, place in zip(columns, camera, strict=True):
                np.add.at(self._coupling[row], column[:, i], whole[:, place, PER_CAMERA + i])
            for j in range(i, 12):
                np.add.at(
                    self._band[11 - (j - i)], column[:, j], whole[:, PER_CAMERA + i, PER_CAMERA + j]
                )

    def _add_resting(
        self, place: str, seen: Sightings, problem: Problem, layout: Layout, state: State
    ) -> None:
        pose = state.poses[seen.camera]
        center = (state.places[place] - pose[:3, 3]) @ pose[:3, :3]
        centers = np.repeat(center[None], len(seen.times_s), axis=0)
        normal, pull = local_equations(
            seen, centers, state.corrections[seen.camera], problem.radius_m
        )
        weight = self._trust * _robust_weight(_deviation(normal, pull))
        chain = np.zeros((8, PER_CAMERA + 3))
        chain[:3, :3], chain[:3, 3:6] = skew(center), -np.eye(3)
        chain[3:, FOOT:PER_CAMERA] = np.eye(depth_correction.PARAMETERS)
        chain[:3, PER_CAMERA:] = pose[:3, :3].T
        index = np.concatenate([layout.camera(seen.camera), layout.triple(place)])
        self._add_border(
            index, chain, np.einsum("n,nij->ij", weight, normal), np.einsum("n,ni->i", weight, pull)
        )

    def _add_surface(self, surface: Surface, layout: Layout, state: State) -> None:
        pose, q = state.poses[surface.camera], state.planes[surface.surface]
        rotation, shift = pose[:3, :3], pose[:3, 3]
        m = rotation.T @ q / (1.0 - q @ shift)
        at = np.concatenate([m, state.corrections[surface.camera]])
        chain = np.zeros((8, PER_CAMERA + 3))
        chain[:3, :3], chain[:3, 3:6] = skew(m), np.outer(m, m)
        chain[3:, FOOT:PER_CAMERA] = np.eye(depth_correction.PARAMETERS)
        chain[:3, PER_CAMERA:] = rotation.T / (1.0 - q @ shift) + np.outer(m, shift) / (
            1.0 - q @ shift
        )
        index = np.concatenate([layout.camera(surface.camera), layout.triple(surface.surface)])
        self._add_border(index, chain, surface.normal, surface.pull + surface.normal @ at)

    def _add_contact(self, place: str, radius_m: float, layout: Layout, state: State) -> None:
        """The ball rests on the floor: its centre is a radius above the plane q . X = 1."""
        at, q = state.places[place], state.planes[FLOOR]
        length = np.linalg.norm(q)
        above = (1.0 - q @ at) / length
        row = np.concatenate([-q / length, -at / length - above * q / length**2])
        index = np.concatenate([layout.triple(place), layout.triple(FLOOR)])
        # A ball that lies on something else is refused later: it must not tilt the floor.
        off = (above - radius_m) / CONTACT_M
        weight = CONTACT_M**-2.0 * _TAIL / (_TAIL + off**2)
        self._border[np.ix_(index, index)] += weight * np.outer(row, row)
        self._border_pull[index] += weight * (above - radius_m) * row

    def _add_border(self, index: Indices, chain: Array, normal: Array, pull: Array) -> None:
        kept = index >= 0
        chain, index = chain[:, kept], index[kept]
        self._border[np.ix_(index, index)] += chain.T @ normal @ chain
        self._border_pull[index] += chain.T @ pull


def _near(centers: Array, detected: Array) -> Array:
    """Points of linearisation (n, 3): at the centres' distance, on the rays of the detections.

    What is seen of a ball says nothing of how well a place decimetres away agrees with it.
    """
    ray = detected / np.linalg.norm(detected, axis=1, keepdims=True)
    farther_m = np.einsum("ni,ni->n", centers - detected, ray)
    return np.asarray(detected + np.clip(farther_m, -_NEAR_M, _NEAR_M)[:, None] * ray)


def trembling(normal: Array, pull: Array) -> tuple[Array, Array]:
    """The equations (n, 8, 8), (n, 8) of a centre that is off the path by a tremor of its own."""
    free = np.linalg.solve(normal[:, :3, :3] + np.eye(3) / TREMOR_M**2, normal[:, :3])
    return (
        normal - np.swapaxes(normal[:, :3], 1, 2) @ free,
        pull - np.einsum("nij,ni->nj", free, pull[:, :3]),
    )


def _deviation(normal: Array, pull: Array) -> Array:
    """(n,): squared distance of each detection's own centre from the one assumed."""
    solved = np.linalg.solve(normal[:, :3, :3], pull[:, :3, None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", pull[:, :3], solved))


def _robust_weight(deviation: Array) -> Array:
    """Weights (n,) that leave out what deviates far more than most do.

    As long as depth errors are not yet corrected all deviate, and none may be left out for that.
    Once they are most deviate by less than the noise that is assumed: fingers over the ball then
    show, although they deviate by no more than that noise could.
    """
    typical = max(float(np.median(deviation)) / MEDIAN, _LEAST_TYPICAL)
    deviation = deviation / typical
    far = np.minimum(1.0, _GATE / np.maximum(deviation, _GATE))
    return np.where(deviation < _REJECT, far, 0.0)
