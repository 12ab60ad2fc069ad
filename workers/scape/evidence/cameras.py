"""Small rigid corrections of the cameras, estimated with the body and bound to the calibration.

Each camera may stand a little off where the calibration has it: its points then move together,
p' = p + omega x (p - eye) + tau, world axes, to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import rigid, so3_exp
from workers.cloud.observed import CameraView, PointCloud
from workers.scape.model.kernels import moved

Array = NDArray[np.float64]
Index = NDArray[np.integer]

_TURN_SIGMA_RAD = np.radians(0.015)
_SHIFT_SIGMA_M = 0.0003
_FREEDOM = 0.5
"""The calibration is believed by so much at first; its own covariance comes on top. Heavy tails
(_FREEDOM, of Student's t) let one camera go that was knocked."""


@dataclass(frozen=True, slots=True)
class CameraCorrections:
    """C cameras, in the order of the cloud's names."""

    eyes: Array
    """(C, 3): where the cameras stand."""
    information: Array
    """(C, 6, 6): of the prior over xi, whose mean is 0."""
    xi: Array
    """(C, 6): omega in radians, tau in metres."""

    @classmethod
    def build(cls, cloud: PointCloud, views: Sequence[CameraView]) -> CameraCorrections:
        """No correction yet; a bare cloud, which has no cameras, has none to correct."""
        by_name = {view.name: view.calibration for view in views}
        if not by_name:
            return cls(np.empty((0, 3)), np.empty((0, 6, 6)), np.empty((0, 6)))
        assert tuple(by_name) == cloud.camera_names, "views in the order of the cloud's cameras"
        believed = np.diag([_TURN_SIGMA_RAD**2] * 3 + [_SHIFT_SIGMA_M**2] * 3)
        eyes, information = [], []
        for name in cloud.camera_names:
            camera = by_name[name]
            covariance = believed.copy()
            if camera.covariance is not None:
                turn = np.kron(np.eye(2), camera.world_from_camera[:3, :3])
                covariance += turn @ camera.covariance @ turn.T
            eyes.append(camera.world_from_camera[:3, 3])
            information.append(np.linalg.inv(covariance))
        return cls(np.array(eyes), np.array(information), np.zeros((len(eyes), 6)))

    def __len__(self) -> int:
        return len(self.xi)

    def corrected(self, cloud: PointCloud) -> PointCloud:
        """The cloud where the corrections have it."""
        if not len(self):
            return cloud
        turns = so3_exp(self.xi[:, :3])
        normals = moved(cloud.normals, cloud.camera, turns, np.zeros_like(self.eyes))
        return replace(cloud, points=self.moved(cloud.points, cloud.camera), normals=normals)

    def moved(self, points: Array, camera: Index) -> Array:
        """Points (n, 3) of cameras (n,) where the corrections have them."""
        if not self.xi.any():
            return points
        turns = so3_exp(self.xi[:, :3])
        shifts = self.eyes + self.xi[:, 3:] - np.einsum("cij,cj->ci", turns, self.eyes)
        return np.asarray(moved(points, camera, turns, shifts))

    def poses(self, views: Sequence[CameraView]) -> list[Array]:
        """world_from_camera (4, 4) of the cloud's views where the corrections have them."""
        found = []
        for view, eye, xi in zip(views, self.eyes, self.xi, strict=True):
            turn = so3_exp(xi[None, :3])[0]
            pose = view.calibration.world_from_camera
            found.append(rigid(turn @ pose[:3, :3], eye + xi[3:]))
        return found

    def shifts_m(self, cloud: PointCloud) -> dict[str, float]:
        """How far the corrections move each camera's points, in the middle of them."""
        found = {}
        for index, name in enumerate(cloud.camera_names[: len(self)]):
            mine = cloud.points[cloud.camera == index]
            if len(mine):
                middle = mine.mean(axis=0)[None]
                moved = self.moved(middle, np.full(1, index, cloud.camera.dtype))
                found[name] = float(np.linalg.norm(moved - middle))
        return found

    def derivative(self, points: Array, camera: Index, directions: Array) -> Array:
        """(n, 6): how far each point goes along its direction for a unit of its camera's xi."""
        lever = np.cross(points - self.eyes[camera], directions)
        return np.concatenate([lever, directions], axis=1)

    def bound(self) -> Array:
        """(C, 6, 6): the prior's information, less for a camera that has left it (Student's t):
        one camera that was knocked is likelier than four that drifted."""
        square = np.einsum("ci,cij,cj->c", self.xi, self.information, self.xi)
        return self.information * ((_FREEDOM + 6.0) / (_FREEDOM + square))[:, None, None]

    def stepped(self, change: Array) -> CameraCorrections:
        """The corrections (C, 6) further."""
        return replace(self, xi=self.xi + change)
