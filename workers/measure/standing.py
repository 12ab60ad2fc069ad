"""The standard standing pose, in which bodies are compared and tailors take measurements.

After ISO 20685-1, whose posture for girths of the trunk and limbs is ISO 7250-1's standing posture
with the arms held 20 degrees off the trunk and the feet apart: upright, head level, legs straight
and upright below the hips, elbows straight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from station.core.geometry import so3_exp
from workers.scape.model.body_model import BodyModel, BodyState

Array = NDArray[np.float64]

_ARM_FROM_TRUNK_RAD = np.radians(20.0)
_LEG_INWARDS_RAD = np.radians(6.0)
"""From the neutral pose's straddle; it brings the feet of the mean body 0.2 m apart."""
_SHOULDER_GIRDLE_SHARE = 0.15
"""Share of the arm's turn that the shoulder blade and collar bone take."""


def standard_turns(model: BodyModel) -> dict[str, Array]:
    """Part -> rotation vector (3,) against its parent, from the neutral pose of the model.

    Directions of the limbs are those of the mean body's landmarks. Parts that are not named stay
    as they are in the neutral pose, which stands upright and looks ahead.
    """
    turns: dict[str, Array] = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at = {
            name: model.mean[model.landmarks[f"{name}_{side}"]]
            for name in ("acromion", "elbow", "wrist")
        }
        arm = np.array([sign * np.sin(_ARM_FROM_TRUNK_RAD), 0.0, -np.cos(_ARM_FROM_TRUNK_RAD)])
        whole = _turn(at["elbow"] - at["acromion"], arm)
        girdle = _SHOULDER_GIRDLE_SHARE * whole
        turns[f"shoulder_{side}"] = girdle
        # The upper arm takes the rest of the rotation.
        upper = _turn(so3_exp(girdle) @ (at["elbow"] - at["acromion"]), arm)
        turns[f"upper_arm_{side}"] = so3_exp(girdle).T @ upper
        above = so3_exp(upper) @ so3_exp(girdle)
        turns[f"forearm_{side}"] = above.T @ _turn(above @ (at["wrist"] - at["elbow"]), arm)
        leg = np.array([0.0, sign * _LEG_INWARDS_RAD, 0.0])
        turns[f"thigh_{side}"] = leg
        turns[f"foot_{side}"] = -leg
    return turns


def standard_state(model: BodyModel, beta: Array) -> BodyState:
    """A shape (B,) in the standard pose, above the origin."""
    twists = np.zeros((model.part_count, 3))
    for part, turn in standard_turns(model).items():
        twists[model.part_names.index(part)] = turn
    return BodyState(model.absolute_rotations(twists), beta, np.asarray(model.anchor @ model.mean))


def stood_upright(model: BodyModel, vertices: Array, state: BodyState) -> Array:
    """A fitted surface (P, 3) in the standard pose, on the floor."""
    return on_both_feet(model, model.repose(vertices, state, standard_state(model, state.beta)))


def on_both_feet(model: BodyModel, vertices: Array) -> Array:
    """Body (P, 3) moved vertically so that its two soles have the mean body's mean height.

    Legs differ a little in length; a person who stands on both feet tilts the pelvis instead.
    A sole is the lowest fifth of a foot's vertices.
    """
    lift = np.mean([_sole(model, vertices, part) for part in ("foot_left", "foot_right")])
    usual = np.mean([_sole(model, model.mean, part) for part in ("foot_left", "foot_right")])
    return np.asarray(vertices - np.array([0.0, 0.0, lift - usual]))


def _sole(model: BodyModel, vertices: Array, part: str) -> float:
    height = np.sort(vertices[model.part_of_vertex == model.part_names.index(part), 2])
    return float(height[: len(height) // 5].mean())


def _turn(direction: Array, target: Array) -> Array:
    """The shortest rotation vector (3,) that takes one direction to another."""
    a, b = direction / np.linalg.norm(direction), target / np.linalg.norm(target)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    return np.asarray(axis / max(sine, 1e-12) * np.arctan2(sine, a @ b))
