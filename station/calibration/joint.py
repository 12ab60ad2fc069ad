"""All cameras at once: poses, depth corrections, clock offsets, the ball's path, flat surfaces.

Gauss-Newton on everything that was seen, each patch of pixels weighed by the sensor's noise.
Unknowns are two groups. The path's control points touch only their neighbours: their normal matrix
is banded. All others (some sixty) border it. Factoring the band and taking the Schur complement
gives the exact step in milliseconds, and the border's covariance with the path marginalised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from station.calibration import depth_correction
from station.calibration.detections import FLOOR, BallDetection, PlaneObservation
from station.calibration.rig import CameraCalibration
from station.calibration.trajectory import TimeGrid, along
from station.geometry import se3_exp, skew

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ITERATIONS = 12
_SMALL_STEP = 2e-6
CLOCK_TOLERANCE_S = 0.005
"""Standard deviation of one camera's clock against another's, before it is solved for."""
CONTACT_M = 0.0005
"""How evenly a ball rests on a floor."""
_TAIL = 4.0
"""Of the prior of depth corrections: Student's t with about so many degrees of freedom."""
_GATE = 11.3
"""Squared deviation of three numbers that one in a hundred exceeds; what is beyond counts less."""
_REJECT = 60.0
_MEDIAN = 2.366
"""Of the squared deviation of three numbers."""
_FOOT = 7
"""Of a camera's unknowns, pose (6) and clock (1) come before the depth correction."""
_CAMERA = _FOOT + depth_correction.PARAMETERS


@dataclass(frozen=True, slots=True)
class Sightings:
    """One camera's detections as arrays; shorter patch lists are padded with weight zero."""

    camera: str
    times_s: Array
    """(n,)"""
    centers: Array
    """(n, 3), camera frame, as detected without depth correction."""
    ray: Array
    """(n, k, 2): x, y of rays (x, y, 1)."""
    inverse: Array
    """(n, k)"""
    weight: Array
    """(n, k): 1 / variance."""
    place: Array
    """(n, k, 2): x, y in the image, from -1 to 1."""

    @classmethod
    def of(cls, camera: CameraCalibration, detections: Sequence[BallDetection]) -> Sightings:
        longest = max((len(detection.patches) for detection in detections), default=1)
        patches = np.zeros((len(detections), longest, 4))
        patches[..., 2:] = (0.6, np.inf)
        for row, detection in zip(patches, detections, strict=True):
            row[: len(detection.patches)] = detection.patches
        return cls(
            camera=camera.name,
            times_s=np.array([detection.time_s for detection in detections]),
            centers=np.array([detection.center_m for detection in detections]).reshape(-1, 3),
            ray=_rays(camera, patches),
            inverse=patches[..., 2],
            weight=1.0 / patches[..., 3],
            place=depth_correction.image_place(camera, patches[..., :2]),
        )

    def take(self, chosen: NDArray[np.bool_]) -> Sightings:
        """Some of them."""
        return Sightings(
            self.camera, self.times_s[chosen], self.centers[chosen], self.ray[chosen],
            self.inverse[chosen], self.weight[chosen], self.place[chosen],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Surface:
    """One camera's view of a flat surface, as normal equations of (m, depth correction)."""

    camera: str
    surface: str
    normal: Array
    """(8, 8)"""
    pull: Array
    """(8,) at m = 0 and no correction."""

    @classmethod
    def of(cls, camera: CameraCalibration, seen: PlaneObservation, name: str) -> Surface:
        patches = seen.patches
        ray = np.concatenate([_rays(camera, patches), np.ones((len(patches), 1))], axis=1)
        weight = 1.0 / patches[:, 3]
        m = np.linalg.solve(ray.T @ (ray * weight[:, None]), ray.T @ (weight * patches[:, 2]))
        place = depth_correction.image_place(camera, patches[:, :2])
        rows = np.concatenate([-ray, depth_correction.design(ray @ m, place)], axis=1)
        weighted = rows / patches[:, 3:]
        return cls(camera.name, name, weighted.T @ rows, weighted.T @ patches[:, 2])

    @property
    def plane(self) -> Array:
        """m (3,) of 1/z = m . (x, y, 1) without correction."""
        return np.asarray(np.linalg.solve(self.normal[:3, :3], -self.pull[:3]))


@dataclass(frozen=True, slots=True)
class Problem:
    """What is to be brought into agreement."""

    cameras: Mapping[str, CameraCalibration]
    reference: str
    radius_m: float
    waved: Mapping[str, Sightings]
    resting: Mapping[str, Sequence[Sightings]]
    """Name of a place -> what each camera saw of the ball resting there."""
    surfaces: Sequence[Surface]


@dataclass(frozen=True)
class State:
    """A solution, or the way to it, in the reference camera's frame."""

    poses: Mapping[str, Array]
    """reference_from_camera, 4x4."""
    clock_s: Mapping[str, float]
    """What is added to a camera's times."""
    corrections: Mapping[str, Array]
    """(5,) each, ``depth_correction``'s parameters."""
    grid: TimeGrid
    controls: Array
    """(count, 3) of the ball's path."""
    places: Mapping[str, Array]
    """Where the ball rested, (3,)."""
    planes: Mapping[str, Array]
    """q (3,) of q . X = 1."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Of the border's unknowns, by ``Layout``."""
    deviations: Mapping[str, Array] = field(default_factory=dict)
    """Squared deviation (n,) of each waved detection's centre in units of its noise."""
    scale: float = 1.0
    """Observed over expected standard deviation."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the border's unknowns stand."""

    starts: Mapping[str, int]
    """Of each camera, place and plane; the reference camera has its depth correction alone."""
    size: int
    reference: str

    @classmethod
    def of(cls, problem: Problem) -> Layout:
        starts, size = {}, 0
        for name in problem.cameras:
            # The reference's missing pose and clock point before its start, and are left out.
            starts[name] = size - (_FOOT if name == problem.reference else 0)
            size += _CAMERA - (_FOOT if name == problem.reference else 0)
        # A floor that no camera sees is known by the places where the ball rests on it.
        surfaces = dict.fromkeys((FLOOR, *(seen.surface for seen in problem.surfaces)))
        for name in (*problem.resting, *surfaces):
            starts[name] = size
            size += 3
        return cls(starts, size, problem.reference)

    def camera(self, name: str) -> Indices:
        """Indices (12,) of pose, clock and correction; -1 where they are fixed."""
        index = np.arange(_CAMERA) + self.starts[name]
        if name == self.reference:
            index[:_FOOT] = -1
        return index

    def correction(self, name: str) -> Indices:
        """Indices (5,) of the depth correction."""
        return self.camera(name)[_FOOT:]

    def triple(self, name: str) -> Indices:
        """Indices (3,) of a place or plane."""
        return np.arange(3) + self.starts[name]


def ball_inverse_depth(center: Array, ray: Array, radius_m: float) -> tuple[Array, Array]:
    """Inverse depth (n, k) of balls (n, 3) along rays (n, k, 2), derivative (n, k, 3) by centre.

    See ``station.calibration.ball``; rays that miss are taken as if they touched.
    """
    x, y = ray[..., 0], ray[..., 1]
    cx, cy, cz = (center[:, None, i] for i in range(3))
    A = x * x + y * y + 1.0
    B = x * cx + y * cy + cz
    C = cx * cx + cy * cy + cz * cz - radius_m**2
    s = np.sqrt(np.maximum(B * B - A * C, 1e-4 * B * B * radius_m**2))
    w = (B + s) / C
    k, j = B / s, A / s
    gradient = np.stack(
        [
            (x + k * x - j * cx) / C - 2.0 * w * cx / C,
            (y + k * y - j * cy) / C - 2.0 * w * cy / C,
            (1.0 + k - j * cz) / C - 2.0 * w * cz / C,
        ],
        axis=-1,
    )
    return w, gradient


def local_equations(
    seen: Sightings, centers: Array, correction: Array, radius_m: float
) -> tuple[Array, Array]:
    """J'WJ (n, 8, 8) and J'Wr (n, 8) of (centre, depth correction) of each detection."""
    w, gradient = ball_inverse_depth(centers, seen.ray, radius_m)
    measured = w - depth_correction.design(w, seen.place) @ correction
    design = depth_correction.design(measured, seen.place)
    residual = seen.inverse + design @ correction - w
    rows = np.concatenate([-gradient, design], axis=-1)
    weighted = rows * seen.weight[..., None]
    return (
        np.swapaxes(weighted, 1, 2) @ rows,
        np.einsum("nki,nk->ni", weighted, residual),
    )


def solve_joint(problem: Problem, start: State) -> State:
    """The most likely state, its covariance, and each detection's deviation."""
    layout = Layout.of(problem)
    state = start
    for _ in range(_ITERATIONS):
        equations = _Equations(problem, layout, state)
        step, path_step = equations.solve()
        state = moved_state(problem, layout, state, step)
        state = replace(state, controls=state.controls + path_step)
        if max(np.abs(step).max(), np.abs(path_step).max()) < _SMALL_STEP:
            break
    equations = _Equations(problem, layout, state)
    scale = equations.scale()
    return replace(
        state,
        covariance=np.asarray(np.linalg.inv(equations.schur()) * scale**2),
        deviations=equations.deviations,
        scale=scale,
    )


class _Equations:
    """The normal equations at a state."""

    def __init__(self, problem: Problem, layout: Layout, state: State) -> None:
        self._size = layout.size
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

    def solve(self) -> tuple[Array, Array]:
        """Steps of the border (m,) and of the path (count, 3)."""
        schur = self.schur()
        pull = self._border_pull - self._coupling @ self._band_solve(self._path_pull)
        step = np.asarray(-np.linalg.solve(schur, pull))
        path = -self._band_solve(self._path_pull + self._coupling.T @ step)
        return step, path.reshape(-1, 3)

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
        normal, pull = local_equations(seen, centers, state.corrections[name], problem.radius_m)
        deviation = _deviation(normal, pull)
        self.deviations[name] = deviation
        robust = _robust_weight(deviation)
        normal, pull = normal * robust[:, None, None], pull * robust[:, None]
        self._cost += float(np.sum(robust * np.minimum(deviation, _GATE)))
        self._seen += float(np.sum(robust))
        for k in range(4):
            np.add.at(self._path_share, first + k, 0.25 * robust)

        turn = pose[:3, :3].T
        speed = along(state.controls, first, rate) @ pose[:3, :3]
        chain = np.zeros((len(centers), 8, _CAMERA + 12))
        chain[:, :3, :3] = skew(centers)
        chain[:, :3, 3:6] = -np.eye(3)
        chain[:, :3, 6] = speed
        chain[:, 3:, _FOOT:_CAMERA] = np.eye(depth_correction.PARAMETERS)
        for k in range(4):
            chain[:, :3, _CAMERA + 3 * k : _CAMERA + 3 * k + 3] = value[:, k, None, None] * turn
        carried = normal @ chain
        whole = np.swapaxes(chain, 1, 2) @ carried
        gradient = np.einsum("nij,ni->nj", chain, pull)

        index = layout.camera(name)
        kept = index >= 0
        columns = index[kept]
        camera, path = np.flatnonzero(kept), np.arange(_CAMERA, _CAMERA + 12)
        self._border[np.ix_(columns, columns)] += whole[:, camera][:, :, camera].sum(axis=0)
        self._border_pull[columns] += gradient[:, camera].sum(axis=0)
        column = 3 * first[:, None] + np.arange(12)
        np.add.at(self._path_pull, column, gradient[:, path])
        for i in range(12):
            for row, place in zip(columns, camera, strict=True):
                np.add.at(self._coupling[row], column[:, i], whole[:, place, _CAMERA + i])
            for j in range(i, 12):
                np.add.at(
                    self._band[11 - (j - i)], column[:, j], whole[:, _CAMERA + i, _CAMERA + j]
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
        robust = _robust_weight(_deviation(normal, pull))
        chain = np.zeros((8, _CAMERA + 3))
        chain[:3, :3], chain[:3, 3:6] = skew(center), -np.eye(3)
        chain[3:, _FOOT:_CAMERA] = np.eye(depth_correction.PARAMETERS)
        chain[:3, _CAMERA:] = pose[:3, :3].T
        index = np.concatenate([layout.camera(seen.camera), layout.triple(place)])
        self._add_border(
            index, chain, np.einsum("n,nij->ij", robust, normal), np.einsum("n,ni->i", robust, pull)
        )

    def _add_surface(self, surface: Surface, layout: Layout, state: State) -> None:
        pose, q = state.poses[surface.camera], state.planes[surface.surface]
        rotation, shift = pose[:3, :3], pose[:3, 3]
        m = rotation.T @ q / (1.0 - q @ shift)
        at = np.concatenate([m, state.corrections[surface.camera]])
        chain = np.zeros((8, _CAMERA + 3))
        chain[:3, :3], chain[:3, 3:6] = skew(m), np.outer(m, m)
        chain[3:, _FOOT:_CAMERA] = np.eye(depth_correction.PARAMETERS)
        chain[:3, _CAMERA:] = rotation.T / (1.0 - q @ shift) + np.outer(m, shift) / (
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


def _deviation(normal: Array, pull: Array) -> Array:
    """(n,): squared distance of each detection's own centre from the one assumed."""
    solved = np.linalg.solve(normal[:, :3, :3], pull[:, :3, None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", pull[:, :3], solved))


def _robust_weight(deviation: Array) -> Array:
    """Weights (n,) that leave out what deviates far more than most do.

    As long as depth errors are not yet corrected all deviate, and none may be left out for that.
    """
    typical = max(float(np.median(deviation)) / _MEDIAN, 1.0)
    deviation = deviation / typical
    far = np.minimum(1.0, _GATE / np.maximum(deviation, _GATE))
    return np.where(deviation < _REJECT, far, 0.0)


def _rays(camera: CameraCalibration, patches: Array) -> Array:
    """(..., 2): x, y of the rays (x, y, 1) through the patches' middles, the lens undone."""
    if not camera.distortion.any():
        K = camera.K
        return np.asarray((patches[..., :2] - (K[0, 2], K[1, 2])) / (K[0, 0], K[1, 1]))
    flat = patches[..., :2].reshape(-1, 1, 2)
    undone = cv2.undistortPoints(flat, camera.K, camera.distortion)
    return np.asarray(undone.reshape((*patches.shape[:-1], 2)), np.float64)


def moved_state(problem: Problem, layout: Layout, state: State, step: Array) -> State:
    """The state after a step of the border's unknowns."""
    poses, clocks, corrections = {}, {}, {}
    for name in problem.cameras:
        index = layout.camera(name)
        moved = name != layout.reference
        poses[name] = state.poses[name] @ se3_exp(step[index[:6]]) if moved else state.poses[name]
        clocks[name] = state.clock_s[name] + (float(step[index[6]]) if moved else 0.0)
        corrections[name] = state.corrections[name] + step[index[_FOOT:]]
    return replace(
        state,
        poses=poses,
        clock_s=clocks,
        corrections=corrections,
        places={name: at + step[layout.triple(name)] for name, at in state.places.items()},
        planes={name: q + step[layout.triple(name)] for name, q in state.planes.items()},
    )
