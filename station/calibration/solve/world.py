"""The transform from the reference camera to the booth: z up from the floor, origin on the mark.

The person faces -y: towards where the ball rested in front of the mark, or else towards the middle
of the front cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from station.calibration.adjust.problem import Layout, Problem, State, moved_state
from station.calibration.detect.detections import FLOOR
from station.calibration.detect.step_names import FRONT, MARK
from station.core.geometry import adjoint, invert, rigid, so3_log

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WorldPoses:
    """The cameras' poses in the world frame and their joint covariance."""

    world_from_camera: Mapping[str, Array]
    covariance: Array
    """(6 n, 6 n) of all cameras' xi in world_from_camera @ se3_exp(xi), in their order."""
    mark_height_m: float
    """Height of the resting ball's centre above the floor."""
    slope_sigma_rad: float
    """Largest standard deviation of the floor's slope, as the reference camera sees it."""
    jacobian: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """(6 n, m): derivatives of all cameras' xi by the border's unknowns."""


def world_from_reference(state: State, front_cameras: Sequence[str]) -> Array:
    """4x4, from floor, mark and heading."""
    q = state.planes[FLOOR]
    up = -q / np.linalg.norm(q)
    mark = state.places[MARK]
    origin = mark - up * _above(state, mark)
    ahead = (
        state.places[FRONT]
        if FRONT in state.places
        else np.mean([state.poses[name][:3, 3] for name in front_cameras], axis=0)
    )
    facing = ahead - origin
    facing = facing - up * (facing @ up)
    y = -facing / np.linalg.norm(facing)
    rotation = np.stack([np.cross(y, up), y, up])
    return rigid(rotation, -rotation @ origin)


def poses_in_world(problem: Problem, state: State, front_cameras: Sequence[str]) -> WorldPoses:
    """Every camera's pose in the world and the joint covariance of all of them."""

    def poses(at: State) -> Array:
        world = world_from_reference(at, front_cameras)
        return world @ np.stack([at.poses[name] for name in problem.cameras])

    def twists(at: State) -> Array:
        moves = back @ poses(at)
        return np.concatenate([so3_log(moves[:, :3, :3]), moves[:, :3, 3]], axis=1).ravel()

    layout = Layout.of(problem)
    here = poses(state)
    back = np.stack([invert(pose) for pose in here])
    jacobian = np.zeros((6 * len(here), layout.size))
    sigma = np.sqrt(np.diag(state.covariance))
    for i in layout.geometry:
        step = np.zeros(layout.size)
        step[i] = 0.1 * sigma[i]
        ends = [twists(moved_state(problem, layout, state, sign * step)) for sign in (1.0, -1.0)]
        jacobian[:, i] = (ends[0] - ends[1]) / (0.2 * sigma[i])
    return WorldPoses(
        jacobian=jacobian,
        world_from_camera=dict(zip(problem.cameras, here, strict=True)),
        covariance=jacobian @ state.covariance @ jacobian.T,
        mark_height_m=_above(state, state.places[MARK]),
        slope_sigma_rad=_slope_sigma(layout, state),
    )


def _slope_sigma(layout: Layout, state: State) -> float:
    q = state.planes[FLOOR]
    index = layout.triple(FLOOR)
    up = q / np.linalg.norm(q)
    tilt = (np.eye(3) - np.outer(up, up)) / np.linalg.norm(q)
    covariance = tilt @ state.covariance[np.ix_(index, index)] @ tilt.T
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def relative_poses(
    world_poses: WorldPoses, a: str, others: Sequence[str]
) -> tuple[list[Array], Array]:
    """a_from_b (4, 4) of each other camera b, and the covariance (6 k, 6 k) of all their xi.

    xi is in camera b's frame: a_from_b @ se3_exp(xi).
    """
    names = list(world_poses.world_from_camera)
    i = names.index(a)
    found = []
    select = np.zeros((6 * len(others), 6 * len(names)))
    for row, b in enumerate(others):
        j = names.index(b)
        a_from_b = invert(world_poses.world_from_camera[a]) @ world_poses.world_from_camera[b]
        rows = np.s_[6 * row : 6 * row + 6]
        # exp(-xi_a) a_from_b exp(xi_b): what stands on the left is carried to the right side.
        select[rows, 6 * i : 6 * i + 6] -= adjoint(invert(a_from_b))
        select[rows, 6 * j : 6 * j + 6] += np.eye(6)
        found.append(a_from_b)
    return found, select @ world_poses.covariance @ select.T


def relative_pose(world_poses: WorldPoses, a: str, b: str) -> tuple[Array, Array]:
    """a_from_b (4, 4) and the covariance (6, 6) of its xi, in camera b's frame."""
    transforms, covariance = relative_poses(world_poses, a, [b])
    return transforms[0], covariance


def pose_sigma(world_poses: WorldPoses, reference: str, name: str) -> tuple[float, float]:
    """Largest standard deviations of a camera's place (m) and turn (rad) from the reference's."""
    if name == reference:
        return 0.0, 0.0
    _, covariance = relative_pose(world_poses, reference, name)
    return (
        float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])),
        float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
    )


def _above(state: State, point: Array) -> float:
    """Height of a point above the floor."""
    q = state.planes[FLOOR]
    return float((1.0 - q @ point) / np.linalg.norm(q))
