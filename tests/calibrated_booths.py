"""Booths of `synthetic_calibration` solved, and how far their cameras are off each other."""

from __future__ import annotations

import numpy as np
import synthetic_calibration as synthetic
from numpy.typing import NDArray

from station.calibration.detect.detections import Observations
from station.calibration.solve.solution import Solution
from station.calibration.solve.solving import solve
from station.calibration.solve.world import WorldPoses, relative_poses
from station.core.geometry import invert, twist_between
from station.core.rig import Rig

Array = NDArray[np.float64]

REFERENCE, FRONT = "front-upper", ("front-upper", "front-lower")


def solved(rig: Rig, seen: Observations, radius_m: float = 0.1) -> Solution:
    """The calibration of a booth's factory sensors from its detections."""
    return solve(
        seen, synthetic.factory(rig), radius_m=radius_m, reference=REFERENCE,
        front_cameras=FRONT, created="2026-01-01T00:00:00Z",
    )  # fmt: skip


def pair_errors(rig: Rig, world_poses: WorldPoses) -> Array:
    """Twists (n, 6) by which every pair of cameras is off the true rig's."""
    names = list(rig.cameras)
    return np.concatenate(
        [_errors(rig, world_poses, a, names[i + 1 :])[0] for i, a in enumerate(names[:-1])]
    )


def reference_errors(rig: Rig, world_poses: WorldPoses) -> tuple[Array, Array]:
    """Twists (n, 6) of all other cameras relative to the reference, and their covariance."""
    others = [name for name in rig.cameras if name != REFERENCE]
    return _errors(rig, world_poses, REFERENCE, others)


def normalised_square(rig: Rig, world_poses: WorldPoses) -> float:
    """Squared error of all cameras relative to the reference, by its covariance."""
    twists, covariance = reference_errors(rig, world_poses)
    away = twists.ravel()
    return float(away @ np.linalg.solve(covariance, away))


def _errors(rig: Rig, world_poses: WorldPoses, a: str, others: list[str]) -> tuple[Array, Array]:
    found, covariance = relative_poses(world_poses, a, others)
    base = invert(rig.cameras[a].world_from_camera)
    twists = [
        twist_between(a_from_b, base @ rig.cameras[b].world_from_camera)
        for b, a_from_b in zip(others, found, strict=True)
    ]
    return np.stack(twists), covariance
