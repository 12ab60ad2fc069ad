"""Has a camera drifted? What the scans of many people say together.

The fit of each scan says which small motion of each camera its points ask for, whatever the body
(`booth-camera-evidence`). Bodies differ and their misfits with them; a camera that moved asks for
the same motion with everyone. The mean over people is therefore compared with its scatter over
people, and a correction counts only if it also helps with people whom it was not computed from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.calibration.moves.motion import LEVER_M, move_words
from station.core.geometry import invert, se3_exp, skew, transform
from station.core.rig import Rig

Array = NDArray[np.float64]

FORMAT, VERSION = "booth-camera-evidence", 1
_LARGEST = 1e15
"""Information of 50,000 points that are known to 0.1 mm: 5e12 1/m^2."""
ENOUGH = 20
"""Scans before anything is said."""
_NAMED_M = 0.0015
_NAMED_RAD = float(np.radians(0.1))
"""Smaller drifts are not told: misfits that all bodies share ask for as much."""
_CERTAINTY = 8.0
"""Standard deviations, from the scatter over people, beyond which a drift is named. Hotelling's T
(1931) of six numbers from 20 scans exceeds it once in 5,000 times."""
_OTHERS = 1.5
"""The named camera must explain this many times more than any other could alone."""
_HELPED = 2.5
"""A correction must fit held-out scans better by so many standard errors of the mean gain ..."""
_GAINED = 0.5
"""... and by this share of what these scans could gain at best."""
_PRIOR_SIGMA_M = 0.02
_STRANGE = 2.0
"""A scan that disagrees more than so many times the median one counts less."""
_ROUNDS = 8
_TRUNK_M = 1.1
"""Height of the middle of a trunk."""
_SCALE = np.array([LEVER_M] * 3 + [1.0] * 3)


@dataclass(frozen=True, slots=True)
class Evidence:
    """One scan's log-likelihood of its cameras' motions: vector . xi - xi . information xi / 2."""

    cameras: tuple[str, ...]
    information: Array
    """(6 C, 6 C), each camera's xi in its own frame."""
    vector: Array
    """(6 C,)."""

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Evidence:
        """Read one; the format has been checked.

        Raises:
            ValueError: a number is missing or not usable.
        """
        cameras = tuple(str(name) for name in document["cameras"])
        information = np.asarray(document["information"], np.float64)
        vector = np.asarray(document["vector"], np.float64)
        size = 6 * len(cameras)
        if information.shape != (size, size) or vector.shape != (size,):
            raise ValueError("wrong shape")
        if not (np.abs(information) < _LARGEST).all() or not (np.abs(vector) < _LARGEST).all():
            raise ValueError("not finite")
        return cls(cameras, information, vector)


@dataclass(frozen=True, slots=True)
class Drift:
    """A camera that the people do not fit."""

    camera: str
    xi: Array
    """(6,): it stands at world_from_camera @ se3_exp(xi) now."""
    covariance: Array
    """(6, 6), from the scatter over people."""
    confirmed: bool
    """Each half of the scans confirms the correction computed from the other."""

    def words(self) -> str:
        """For the operator: what seems to have happened, and what to do."""
        remedy = (
            "run station check --correct" if self.confirmed else "calibrate with station calibrate"
        )
        return (
            f"camera {self.camera} seems to have moved since it was calibrated, as the scans of "
            f"the last people say: {move_words(self.xi)}; {remedy}"
        )


def find_drift(scans: Sequence[Evidence]) -> Drift | None:
    """The camera that has drifted, if one has: none is named on fewer scans than ENOUGH, for a
    drift within what bodies' misfits cause, or if another camera may be to blame as well."""
    if len(scans) < ENOUGH:
        return None
    cameras = scans[0].cameras
    motions = [_motion(*_of_camera(scans, index)) for index in range(len(cameras))]
    gains = [motion.gain for motion in motions]
    best = int(np.argmax(gains))
    found = motions[best]
    others = max((gain for index, gain in enumerate(gains) if index != best), default=0.0)
    if found.gain < _OTHERS * others or found.sigmas < _CERTAINTY or not _told(found.xi):
        return None
    first, second = _of_camera(scans[::2], best), _of_camera(scans[1::2], best)
    confirmed = _helps(first, second) and _helps(second, first)
    return Drift(cameras[best], found.xi, found.covariance, confirmed)


def corrected(rig: Rig, drift: Drift, created: str) -> Rig:
    """A calibration in which the camera stands where the people saw it, and is known as well as
    they tell it.

    Args:
        created: date of the new calibration, UTC, ISO 8601.
    """
    camera = rig.cameras[drift.camera]
    before = np.zeros((6, 6)) if camera.covariance is None else camera.covariance
    moved = replace(
        camera,
        world_from_camera=camera.world_from_camera @ se3_exp(drift.xi),
        covariance=before + drift.covariance,
    )
    predicted = rig.predicted
    if predicted is not None:
        off_m = _sigma_at_mark(moved.world_from_camera, drift.covariance)
        predicted = predicted.widened(off_m)
    cameras = {**rig.cameras, drift.camera: moved}
    return replace(rig, created=created, cameras=cameras, predicted=predicted)


def _sigma_at_mark(world_from_camera: Array, covariance: Array) -> float:
    """Standard deviation (m) along one axis of where a camera of an uncertain pose (6, 6) sees a
    trunk above the mark."""
    seen = transform(invert(world_from_camera), np.array([0.0, 0.0, _TRUNK_M]))
    by_pose = np.concatenate([-skew(seen), np.eye(3)], axis=1)
    return float(np.sqrt(np.trace(by_pose @ covariance @ by_pose.T) / 3.0))


@dataclass(frozen=True, slots=True)
class _Motion:
    xi: Array
    covariance: Array
    gain: float
    """Increase of the log-likelihood."""
    sigmas: float
    """Its Mahalanobis length."""


def _of_camera(scans: Sequence[Evidence], index: int) -> tuple[Array, Array]:
    """Information (n, 6, 6) and vectors (n, 6) of one camera, the others where calibrated."""
    own = slice(6 * index, 6 * index + 6)
    information = np.stack([scan.information[own, own] for scan in scans])
    return information, np.stack([scan.vector[own] for scan in scans])


def _motion(information: Array, vector: Array) -> _Motion:
    """The motion on which n scans agree, robustly: a scan that disagrees with all others counts
    less. Its covariance is the sandwich of the scans' scores (White 1980)."""
    count = len(vector)
    prior = np.diag(np.square(_SCALE / _PRIOR_SIGMA_M))
    weights = np.ones(count)
    for _ in range(_ROUNDS):
        total = np.einsum("k,kij->ij", weights, information) + prior
        xi = np.linalg.solve(total, weights @ vector)
        scores = vector - np.einsum("kij,j->ki", information, xi)
        misfit = np.einsum("ki,kij,kj->k", scores, np.linalg.pinv(information), scores)
        size = np.sqrt(np.maximum(misfit, 0.0) / max(float(np.median(misfit)), 1e-12))
        weights = 1.0 / np.maximum(1.0, size / _STRANGE) ** 2
    weighted = weights[:, None] * scores
    bread = np.linalg.inv(total)
    freedom = max(1, count - len(xi))
    covariance = bread @ (weighted.T @ weighted) @ bread * (count / freedom)
    floor = np.diag(np.square(1e-5 / _SCALE))
    gain = float(xi @ (weights @ vector) - 0.5 * xi @ total @ xi)
    sigmas = float(np.sqrt(xi @ np.linalg.solve(covariance + floor, xi)))
    return _Motion(xi, covariance, gain, sigmas)


def _told(xi: Array) -> bool:
    return bool(np.linalg.norm(xi[:3]) > _NAMED_RAD or np.linalg.norm(xi[3:]) > _NAMED_M)


def _helps(fitted: tuple[Array, Array], held_out: tuple[Array, Array]) -> bool:
    """Whether the correction from some scans fits others better: surely, and by a good part of what
    these could gain at best."""
    xi = _motion(*fitted).xi
    information, vector = held_out
    gains = vector @ xi - 0.5 * np.einsum("i,kij,j->k", xi, information, xi)
    best = _motion(information, vector).gain
    error = gains.std(ddof=1) / np.sqrt(len(gains))
    return bool(gains.mean() > _HELPED * error and gains.sum() > _GAINED * best)
