"""Where the fit starts: height, place, heading and arms from coarse features of the cloud."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from workers.scape.model import BodyModel, BodyState
from workers.scape.sampled import SampledBody

Array = NDArray[np.float64]

_NEUTRAL_ARM_DEG = 43.0
_ARMS_DEG = (12.0, 30.0, 48.0, 66.0, 84.0)
_HEADINGS_DEG = (-24.0, -12.0, 0.0, 12.0, 24.0)
_STRAIGHTER_ELBOW_RAD = np.radians(22.0)
_TRIM_M = 0.08


def posed(
    model: BodyModel, state: BodyState, arm_deg: tuple[float, float], heading_rad: float
) -> BodyState:
    """A state with arms so many degrees from the trunk (left, right), turned about the vertical."""
    names = list(model.part_names)
    twists = np.zeros((model.part_count, 3))
    twists[0, 2] = heading_rad
    for side, sign, angle in (("left", 1.0, arm_deg[0]), ("right", -1.0, arm_deg[1])):
        lower = sign * np.radians(_NEUTRAL_ARM_DEG - angle)
        twists[names.index(f"shoulder_{side}"), 1] = 0.15 * lower
        twists[names.index(f"upper_arm_{side}"), 1] = 0.85 * lower
        straighter = np.array([0.7, 0.1 * sign, 0.7 * sign]) * _STRAIGHTER_ELBOW_RAD
        twists[names.index(f"forearm_{side}")] = straighter
    return replace(state, rotations=model.absolute_rotations(twists))


def stature_beta(model: BodyModel, stature_m: float) -> Array:
    """The likeliest shape of a stature: the smallest beta that gives it (conditional normal)."""
    top = model.landmarks["crown"]
    sole = int(np.argmin(model.mean[:, 2]))
    gradient = (model.directions[:, top, 2] - model.directions[:, sole, 2]).astype(np.float64)
    excess = stature_m - float(model.mean[top, 2] - model.mean[sole, 2])
    beta = gradient * excess / float(gradient @ gradient)
    norm = float(np.linalg.norm(beta))
    return beta * min(1.0, 3.5 / max(norm, 1e-9))


def starting_states(model: BodyModel, scout: SampledBody, points: Array) -> list[BodyState]:
    """States to start from, best first, judged on a coarse sample of the cloud (n, 3).

    First both arms at one angle and all headings, then each arm alone at the best heading.
    """
    stature = float(np.quantile(points[:, 2], 0.9995))
    state = replace(model.neutral_state(), beta=stature_beta(model, stature))
    trunk = points[(points[:, 2] > 0.35 * stature) & (points[:, 2] < 0.75 * stature)]
    center = np.median(trunk if len(trunk) > 50 else points, axis=0)
    tree = cKDTree(points)

    def tried(arms: tuple[float, float], heading_deg: float) -> tuple[float, BodyState]:
        turned = posed(model, state, arms, np.radians(heading_deg))
        candidate = _placed(model, scout, turned, center)
        return _cost(scout.evaluate(candidate), points, tree), candidate

    _, heading = min(
        (tried((arm, arm), heading)[0], heading)
        for arm, heading in product(_ARMS_DEG, _HEADINGS_DEG)
    )
    scored = [tried(arms, heading) for arms in product(_ARMS_DEG, _ARMS_DEG)]
    scored.sort(key=lambda entry: entry[0])
    return [candidate for _, candidate in scored]


def _placed(model: BodyModel, scout: SampledBody, state: BodyState, center: Array) -> BodyState:
    """Over the cloud's center, soles on the floor."""
    found = scout.evaluate(state)
    trunk = np.isin(model.part_of_vertex[scout.indices], (0, 1, 2))
    shift = center - np.median(found[trunk], axis=0)
    shift[2] = -found[:, 2].min()
    return replace(state, translation=state.translation + shift)


def _cost(body: Array, points: Array, tree: cKDTree) -> float:
    """Trimmed two-way distance: the cloud must be explained, the body need not all be seen."""
    to_cloud, _ = tree.query(body, distance_upper_bound=_TRIM_M)
    to_body, _ = cKDTree(body).query(points, distance_upper_bound=2 * _TRIM_M)
    return float(np.minimum(to_cloud, _TRIM_M).mean() + np.minimum(to_body, 2 * _TRIM_M).mean())
