"""Starting states of the fit: stature, position, heading and arms from a coarse cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.scape.model.body_model import BodyModel, BodyState
from workers.scape.model.kernels import trimmed_costs
from workers.scape.model.sampled import SampledBody

Array = NDArray[np.float64]

_NEUTRAL_ARM_DEG = 43.0
"""Angle between the trunk and the arms of the neutral pose."""
_ARMS_DEG = (12.0, 30.0, 48.0, 66.0, 84.0)
_HEADINGS_DEG = (-24.0, -12.0, 0.0, 12.0, 24.0)
_SWINGS_DEG = (-25.0, 0.0, 25.0)
"""Angles that are tried: arms from the trunk, headings, arms swung back."""
_AROUND_DEG = tuple(float(turn) for turn in range(-180, 180, 24))
_FEW_ARMS_DEG = (12.0, 39.0, 66.0)
"""Headings and arms that are tried to find the rough heading."""
_GIRDLE_SHARE = 0.15
"""Share of an arm's angle that the shoulder takes; the upper arm takes the rest."""
_FACING_DEG = 36.0
"""A person who is turned by less faces the front of the booth."""
_FEET, _ANKLES = 0.04, (0.06, 0.12)
"""Heights of feet (at most) and ankles, as shares of the stature."""
_TOES_M = 0.01
"""Least distance by which feet extend in front of their ankles."""
_STRAIGHTER_ELBOW_RAD = np.radians(22.0)
"""Angle by which elbows are straightened from the neutral pose."""
_CLOUD_TRIM_M = 0.48
"""Largest distance that counts of a point: that of a hand when the arm's angle is wrong."""
_BODY_TRIM_M = 0.08
"""Largest distance that counts of a vertex: not all of the body is seen."""
_STATURE_COMPONENTS = 40
"""Shape components that are used for the stature: they hold nearly all of it."""
_MAX_BETA_NORM = 3.5
"""Largest length of beta at the start."""
_STATURE_QUANTILE = 0.9995
"""Quantile of the points' heights that is taken for the stature."""
_AT_HEAD_M = 0.02
"""Distance within which a point shows a vertex of the head."""
_HEAD_SHOWN = 0.72
"""Share of the head's vertices that points show at least: 0.82 to 0.93 in 34 sound scans, up to
0.64 where dark hair gives no readings."""
_HAIR_M = 0.06
"""Height by which a start may be too short where hair hides the head."""
_TRUNK_HEIGHTS = (0.35, 0.75)
"""Heights of the trunk, as shares of the stature."""
_MIN_TRUNK_POINTS = 50

RoughPose = tuple[tuple[float, float], tuple[float, float], float]
"""Degrees: angles of the arms from the trunk (left, right) and behind it (left, right), and the
rotation about the vertical."""


def rotations_of(model: BodyModel, poses: Sequence[RoughPose]) -> Array:
    """Rotations (c, L, 3, 3) of the parts in rough poses."""
    names = list(model.part_names)
    arms_deg, swings_deg, headings_deg = map(np.array, zip(*poses, strict=True))
    twists = np.zeros((len(poses), model.part_count, 3))
    twists[:, 0, 2] = np.radians(headings_deg)
    for index, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        upper_arm = names.index(f"upper_arm_{side}")
        lower = sign * np.radians(_NEUTRAL_ARM_DEG - arms_deg[:, index])
        twists[:, names.index(f"shoulder_{side}"), 1] = _GIRDLE_SHARE * lower
        twists[:, upper_arm, 0] = np.radians(swings_deg[:, index])
        twists[:, upper_arm, 1] = (1.0 - _GIRDLE_SHARE) * lower
        straighter = np.array([0.7, 0.1 * sign, 0.7 * sign]) * _STRAIGHTER_ELBOW_RAD
        twists[:, names.index(f"forearm_{side}")] = straighter
    return model.absolute_rotations(twists)


def stature_beta(model: BodyModel, stature_m: float) -> Array:
    """Most likely shape of a stature: the shortest beta that gives it (conditional normal)."""
    top = model.landmarks["crown"]
    sole = int(np.argmin(model.mean[:, 2]))
    gradient = (model.directions[:, top, 2] - model.directions[:, sole, 2]).astype(np.float64)
    gradient[_STATURE_COMPONENTS:] = 0.0
    excess = stature_m - float(model.mean[top, 2] - model.mean[sole, 2])
    beta = gradient * excess / float(gradient @ gradient)
    norm = float(np.linalg.norm(beta))
    return beta * min(1.0, _MAX_BETA_NORM / max(norm, 1e-9))


def is_head_hidden(model: BodyModel, vertices: Array, cloud: Array) -> bool:
    """Whether few vertices of a coarsely fitted head have a point of the cloud (m, 3) near them."""
    head = vertices[model.part_of_vertex == model.part_names.index("head")]
    high = cloud[cloud[:, 2] > head[:, 2].min() - _AT_HEAD_M]
    if not len(high):
        return True
    away, _ = cKDTree(high, balanced_tree=False).query(head, distance_upper_bound=_AT_HEAD_M)
    return bool(np.isfinite(away).mean() < _HEAD_SHOWN)


def taller(model: BodyModel, state: BodyState) -> BodyState:
    """State of a person with a longer body, soles where they were, for a head that hair hides.

    The stature was taken for too small by what is hidden. A start that is too tall settles; from
    one that is too short the face stays up to 4 cm below its place.
    """
    sole = int(np.argmin(model.mean[:, 2]))
    stature = float(model.mean[model.landmarks["crown"], 2] - model.mean[sole, 2])
    tall = replace(state, beta=state.beta + stature_beta(model, stature + _HAIR_M))
    lift = model.vertices(state)[:, 2].min() - model.vertices(tall)[:, 2].min()
    return replace(tall, translation=state.translation + np.array((0.0, 0.0, lift)))


def starting_states(
    model: BodyModel, scout: SampledBody, points: Array, cloud: Array
) -> list[BodyState]:
    """Starting states: the best, the one that faces the other way, and the others, best first.

    The search first finds the rough heading, then the heading with both arms at one angle, then the
    angle of each arm, then their swing forward or back. Toes that the cameras hardly see can show
    the wrong way.

    Args:
        scout: a few vertices of the model.
        points: (n, 3), a coarse subset of the cloud.
        cloud: (m, 3), a denser one that shows the feet.
    """
    stature = float(np.quantile(points[:, 2], _STATURE_QUANTILE))
    state = replace(model.neutral_state(), beta=stature_beta(model, stature))
    low, high = (share * stature for share in _TRUNK_HEIGHTS)
    trunk = points[(points[:, 2] > low) & (points[:, 2] < high)]
    center = np.median(trunk if len(trunk) > _MIN_TRUNK_POINTS else points, axis=0)
    # The pose-dependent deformation is neglected here.
    arms, _ = scout.arms(state, ())

    def scored(tried: list[RoughPose]) -> tuple[Array, list[BodyState]]:
        rotations = rotations_of(model, tried)
        bodies, shifts = _placed(model, scout, arms, rotations, center)
        states = [
            replace(state, rotations=turns, translation=shift)
            for turns, shift in zip(rotations, shifts, strict=True)
        ]
        return _costs(bodies, points), states

    straight = (0.0, 0.0)
    around = [((arm, arm), straight, turn) for arm, turn in product(_FEW_ARMS_DEG, _AROUND_DEG)]
    roughly = around[int(np.argmin(scored(around)[0]))][2]
    facing = facing_deg(roughly, cloud, stature)
    together = [
        ((arm, arm), straight, facing + turn) for arm, turn in product(_ARMS_DEG, _HEADINGS_DEG)
    ]
    heading = together[int(np.argmin(scored(together)[0]))][2]
    apart = [(arms_deg, straight, heading) for arms_deg in product(_ARMS_DEG, _ARMS_DEG)]
    costs, states = scored(apart)
    arms_deg = apart[int(np.argmin(costs))][0]
    swung = [(arms_deg, swing, heading) for swing in product(_SWINGS_DEG, _SWINGS_DEG)]
    more_costs, more_states = scored([one for one in swung if any(one[1])])
    costs, states = np.concatenate([costs, more_costs]), states + more_states
    first, *others = [states[index] for index in np.argsort(costs, kind="stable")]
    _, turned = scored([(arms_deg[::-1], straight, heading + 180.0)])
    return [first, *turned, *others]


def facing_deg(heading_deg: float, cloud: Array, stature_m: float) -> float:
    """Heading or its opposite, by the direction of the toes: coarse bodies look alike in both.

    Args:
        heading_deg: rotation about z from -y.
        cloud: (m, 3), floor at z = 0.
    """
    height = cloud[:, 2] / stature_m
    feet = cloud[height < _FEET, :2]
    ankles = cloud[(height > _ANKLES[0]) & (height < _ANKLES[1]), :2]
    turn = np.radians(heading_deg)
    ahead = 0.0
    if len(feet) and len(ankles):
        own = cKDTree(ankles).query(feet)[1]
        ahead = float((feet - ankles[own]).mean(axis=0) @ (np.sin(turn), -np.cos(turn)))
    # Where the feet do not show it, the person faces the front of the booth.
    away = ahead < 0.0 if abs(ahead) > _TOES_M else np.cos(turn) < 0.0
    facing = (heading_deg + (360.0 if away else 180.0)) % 360.0 - 180.0
    return 0.0 if abs(facing) < _FACING_DEG else facing


def _placed(
    model: BodyModel,
    scout: SampledBody,
    arms: NDArray[np.float32],
    rotations: Array,
    center: Array,
) -> tuple[Array, Array]:
    """Bodies (c, n, 3) at the center of the cloud, soles on the floor, and their shifts (c, 3)."""
    bodies = np.einsum("cpij,npj->cni", rotations, arms.astype(np.float64), optimize=True)
    trunk = np.isin(model.part_of_vertex[scout.indices], (0, 1, 2))
    shift = center - np.median(bodies[:, trunk], axis=1)
    shift[:, 2] = -bodies[:, :, 2].min(axis=1)
    return bodies + shift[:, None], shift


def _costs(bodies: Array, points: Array) -> Array:
    """Trimmed two-way distances: all points should lie on the body, which is not all seen."""
    found = trimmed_costs(
        np.ascontiguousarray(bodies.swapaxes(1, 2), np.float32),
        points.astype(np.float32),
        _CLOUD_TRIM_M,
        _BODY_TRIM_M,
        1.0,
    )
    return np.asarray(found)
