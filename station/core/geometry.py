"""Rotations and rigid transforms.

A transform ``a_from_b`` is a 4x4 matrix that takes points of frame b to frame a. A twist ``xi`` is
(rotation vector, translation): ``a_from_b @ se3_exp(xi)`` perturbs it in frame b.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_RIGID_TOLERANCE = 1e-4


def skew(vector: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(a) @ b == cross(a, b)``."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def level_axes(up: Array) -> Array:
    """Two perpendicular unit vectors (2, 3) across a unit vector (3,), which is not along x."""
    first = np.cross(up, (1.0, 0.0, 0.0))
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])


def so3_exp(rotation_vector: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    v = np.asarray(rotation_vector, dtype=np.float64)
    angle_sq = np.sum(v * v, axis=-1)[..., None, None]
    angle = np.sqrt(angle_sq)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle_sq / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle_sq / 24.0, (1.0 - np.cos(safe)) / safe**2)
    k = skew(v)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def so3_log(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3) in radians, of length at most pi, of matrices (..., 3, 3).

    Goes through the quaternion's largest component, so that it stays exact close to pi.
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(r, axis1=-2, axis2=-1)
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    quadratic = np.empty((*r.shape[:-2], 4, 4))
    off = [
        (r[..., 2, 1] - r[..., 1, 2]),
        (r[..., 0, 2] - r[..., 2, 0]),
        (r[..., 1, 0] - r[..., 0, 1]),
    ]
    quadratic[..., 0, 0] = 1.0 + trace
    for i in range(3):
        quadratic[..., 0, i + 1] = quadratic[..., i + 1, 0] = off[i]
        for j in range(3):
            quadratic[..., i + 1, j + 1] = r[..., i, j] + r[..., j, i]
        quadratic[..., i + 1, i + 1] = 1.0 + 2.0 * diagonal[..., i] - trace
    best = np.argmax(np.diagonal(quadratic, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(quadratic, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    half = np.arctan2(sine, q[..., 0])
    scale = np.where(sine < 1e-9, 2.0, 2.0 * half / np.where(sine < 1e-9, 1.0, sine))
    return np.asarray(q[..., 1:] * scale[..., None])


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm (SVD)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)


def is_rigid(matrix: Array) -> bool:
    """Whether a matrix (4, 4) is a rigid transform, but for rounding to a few digits."""
    rotation = matrix[:3, :3]
    return bool(
        np.abs(rotation @ rotation.T - np.eye(3)).max() <= _RIGID_TOLERANCE
        and np.linalg.det(rotation) > 0
        and np.abs(matrix[3] - (0, 0, 0, 1)).max() <= _RIGID_TOLERANCE
    )


def rigid(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """The 4x4 transform with a 3x3 rotation and a translation in metres."""
    transform_ = np.eye(4)
    transform_[:3, :3] = rotation
    transform_[:3, 3] = translation
    return transform_


def se3_exp(xi: ArrayLike) -> Array:
    """The 4x4 transform of (rotation vector, translation); the two are not coupled."""
    twist = np.asarray(xi, dtype=np.float64)
    return rigid(so3_exp(twist[:3]), twist[3:])


def twist_between(a_from_b: ArrayLike, a_from_c: ArrayLike) -> Array:
    """The twist xi (6,) of ``a_from_c = a_from_b @ se3_exp(xi)``, in frame b."""
    difference = invert(a_from_b) @ np.asarray(a_from_c, dtype=np.float64)
    return np.concatenate([so3_log(difference[:3, :3]), difference[:3, 3]])


def adjoint(b_from_a: ArrayLike) -> Array:
    """The matrix (6, 6) that takes a small twist of frame a to the same motion in frame b."""
    transform_ = np.asarray(b_from_a, dtype=np.float64)
    rotation, shift = transform_[:3, :3], transform_[:3, 3]
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = rotation
    matrix[3:, :3] = skew(shift) @ rotation
    return matrix


def invert(a_from_b: ArrayLike) -> Array:
    """b_from_a of a rigid a_from_b, 4x4."""
    matrix = np.asarray(a_from_b, dtype=np.float64)
    return rigid(matrix[:3, :3].T, -matrix[:3, :3].T @ matrix[:3, 3])


def transform(a_from_b: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 3) of frame b in frame a."""
    matrix = np.asarray(a_from_b, dtype=np.float64)
    return np.asarray(np.asarray(points, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3])


def rotate(a_from_b: ArrayLike, directions: ArrayLike) -> Array:
    """Directions (..., 3) of frame b in frame a."""
    matrix = np.asarray(a_from_b, dtype=np.float64)
    return np.asarray(np.asarray(directions, dtype=np.float64) @ matrix[:3, :3].T)


def rigid_fit(target: Array, source: Array, weights: Array | None = None) -> Array:
    """target_from_source, 4x4, of least weighted squared distance between paired points (n, 3).

    Closed form after Umeyama (1991) without scale.
    """
    w = np.ones(len(source)) if weights is None else weights
    w = w / w.sum()
    mean_t, mean_s = w @ target, w @ source
    covariance = (target - mean_t).T @ ((source - mean_s) * w[:, None])
    rotation = nearest_rotation(covariance)
    return rigid(rotation, mean_t - rotation @ mean_s)
