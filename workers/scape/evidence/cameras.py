"""Small rigid corrections of the cameras, estimated together with the body.

A camera may be slightly off its calibrated pose. All its points then move together,
p' = p + omega x (p - eye) + tau in world axes, to first order. A prior centred on the calibration
keeps the corrections small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import rigid, so3_exp
from station.core.rig import CameraCalibration, PredictedError
from workers.cloud.observed import CameraView, PointCloud
from workers.scape.model.kernels import transform_groups

Array = NDArray[np.float64]
Index = NDArray[np.integer]

_TURN_SIGMA_RAD = np.radians(0.015)
_SHIFT_SIGMA_M = 0.0003
"""Standard deviations of the prior where the calibration's cloud is exact."""
_FREEDOM = 0.5
"""Degrees of freedom of the prior, a Student t distribution: its heavy tails release a single
camera that was knocked."""


@dataclass(frozen=True, slots=True)
class CameraCorrections:
    """Corrections of C cameras, in the order of the cloud's names."""

    eyes: Array
    """(C, 3): calibrated positions of the cameras."""
    information: Array
    """(C, 6, 6): inverse covariance of the prior over xi, whose mean is 0."""
    xi: Array
    """(C, 6): omega in radians, tau in metres."""

    @classmethod
    def build(
        cls,
        cloud: PointCloud,
        views: Sequence[CameraView],
        predicted: PredictedError | None = None,
    ) -> CameraCorrections:
        """Zero corrections; none for a bare cloud, which has no cameras.

        Args:
            predicted: the calibration's statement of its cloud's error, by which the prior grows.
                Without it the covariances of the poses are added. These contain what the depth
                corrections make up for, and what moves all cameras together: poses that are known
                to 3 mm have clouds that are known to 0.1 mm.
        """
        by_name = {view.name: view.calibration for view in views}
        if not by_name:
            return cls(np.empty((0, 3)), np.empty((0, 6, 6)), np.empty((0, 6)))
        assert tuple(by_name) == cloud.camera_names, "views in the order of the cloud's cameras"
        believed = np.diag([_TURN_SIGMA_RAD**2] * 3 + [_SHIFT_SIGMA_M**2] * 3)
        if predicted is not None:
            believed *= 1.0 + (predicted.normal_rms_m / _SHIFT_SIGMA_M) ** 2
        eyes, information = [], []
        for name in cloud.camera_names:
            camera = by_name[name]
            covariance = believed.copy()
            if predicted is None and camera.covariance is not None:
                turn = np.kron(np.eye(2), camera.world_from_camera[:3, :3])
                covariance += turn @ camera.covariance @ turn.T
            eyes.append(camera.world_from_camera[:3, 3])
            information.append(np.linalg.inv(covariance))
        return cls(np.array(eyes), np.array(information), np.zeros((len(eyes), 6)))

    def __len__(self) -> int:
        return len(self.xi)

    def corrected(self, cloud: PointCloud) -> PointCloud:
        """Cloud with the corrections applied to its points and normals."""
        if not len(self):
            return cloud
        turns = so3_exp(self.xi[:, :3])
        normals = transform_groups(cloud.normals, cloud.camera, turns, np.zeros_like(self.eyes))
        return replace(cloud, points=self.apply(cloud.points, cloud.camera), normals=normals)

    def apply(self, points: Array, camera: Index) -> Array:
        """Points (n, 3) of cameras (n,) with the corrections applied."""
        if not self.xi.any():
            return points
        turns = so3_exp(self.xi[:, :3])
        shifts = self.eyes + self.xi[:, 3:] - np.einsum("cij,cj->ci", turns, self.eyes)
        return np.asarray(transform_groups(points, camera, turns, shifts))

    def poses(self, views: Sequence[CameraView]) -> list[Array]:
        """Corrected world_from_camera (4, 4) of the cloud's views."""
        found = []
        places, turns = self.eyes + self.xi[:, 3:], so3_exp(self.xi[:, :3])
        for view, turn, place in zip(views, turns, places, strict=True):
            pose = view.calibration.world_from_camera
            found.append(rigid(turn @ pose[:3, :3], place))
        return found

    def shifts_m(self, cloud: PointCloud) -> dict[str, float]:
        """Distance by which the corrections move the centroid of each camera's points."""
        if not len(self):
            return {}
        counts = np.bincount(cloud.camera, minlength=len(self))
        seeing = np.flatnonzero(counts).astype(cloud.camera.dtype)
        sums = [np.bincount(cloud.camera, along, len(self)) for along in cloud.points.T]
        middles = np.stack(sums, axis=1)[seeing] / counts[seeing, None]
        shifts = self.apply(middles, seeing) - middles
        return {
            cloud.camera_names[index]: float(np.linalg.norm(shift))
            for index, shift in zip(seeing, shifts, strict=True)
        }

    def derivative(self, points: Array, camera: Index, directions: Array) -> Array:
        """Derivatives (n, 6) of the points' positions along directions by their cameras' xi."""
        lever = np.cross(points - self.eyes[camera], directions)
        return np.concatenate([lever, directions], axis=1)

    def prior_information(self) -> Array:
        """Information (C, 6, 6) of the prior, reweighted by Student's t at the present corrections.

        One camera that was knocked is likelier than four that drifted.
        """
        square = np.einsum("ci,cij,cj->c", self.xi, self.information, self.xi)
        return self.information * ((_FREEDOM + 6.0) / (_FREEDOM + square))[:, None, None]

    def updated(self, change: Array) -> CameraCorrections:
        """Corrections after adding a change (C, 6)."""
        return replace(self, xi=self.xi + change)


@dataclass(frozen=True, slots=True)
class CameraEvidence:
    """Log-likelihood of the cameras' corrections xi by one scan, maximised over the body:
    vector . xi - xi . information xi / 2.

    It accumulates over people, with whom misfits of the body differ and a moved camera does not.
    """

    information: Array
    """(6 C, 6 C)."""
    vector: Array
    """(6 C,)."""

    def document(self, cameras: Sequence[CameraCalibration], calibration: str) -> dict[str, Any]:
        """JSON of format "booth-camera-evidence", in each camera's own frame.

        Args:
            cameras: in the order of the corrections.
            calibration: date of the calibration that the corrections refer to.
        """
        turns = [camera.world_from_camera[:3, :3] for camera in cameras]
        camera_from_world = np.zeros_like(self.information)
        for index, turn in enumerate(np.repeat(turns, 2, axis=0)):
            own = slice(3 * index, 3 * index + 3)
            camera_from_world[own, own] = turn.T
        turned = camera_from_world @ self.information @ camera_from_world.T
        return {
            "format": "booth-camera-evidence",
            "version": 1,
            "calibration": calibration,
            "cameras": [camera.name for camera in cameras],
            "information": np.round(turned, 3).tolist(),
            "vector": np.round(camera_from_world @ self.vector, 3).tolist(),
        }
