"""Poses of the bodies that the model is learned from, as turns of the generator's bones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEUTRAL_ARM_DEG = 43.0
"""Angle between arms and trunk in the neutral pose."""


def random_poses(bones: list[str], count: int, rng: np.random.Generator) -> Array:
    """Poses around the booth's A-pose, (n, bones, 3) rotation vectors about the world's axes.

    Arms 10 to 80 degrees from the trunk, elbows, legs together to apart, spine, neck,
    shoulders raised, fists.
    """
    pose = np.zeros((count, len(bones), 3))

    def turn(bone: str, axis: int, radians: Array) -> None:
        pose[:, bones.index(bone), axis] += radians

    def turn_about(bone: str, axis: Array, radians: Array) -> None:
        for i in range(3):
            turn(bone, i, axis[i] * radians)

    def spread(deviation_deg: float) -> Array:
        return np.radians(deviation_deg) * np.clip(rng.standard_normal(count), -2.5, 2.5)

    for bone in ("spine04", "spine02", "neck01", "neck03"):
        bends = (4.0, 3.0, 3.0) if bone.startswith("spine") else (6.0, 4.0, 5.0)
        for axis, deviation in enumerate(bends):
            turn(bone, axis, spread(deviation))
    common_arm = rng.uniform(8.0, 80.0, count)
    common_leg = rng.uniform(-3.0, 15.0, count)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        # The neutral arm hangs 43 degrees from the trunk; about y, positive lowers the left.
        arm = np.clip(common_arm + 6.0 * rng.standard_normal(count), 5.0, 85.0)
        lower = np.radians(_NEUTRAL_ARM_DEG - arm)
        turn(f"clavicle.{side}", 1, sign * 0.15 * lower + spread(4.0))
        turn(f"clavicle.{side}", 2, spread(3.0))
        turn(f"upperarm01.{side}", 1, sign * 0.85 * lower)
        turn(f"upperarm01.{side}", 0, np.radians(rng.uniform(-10.0, 30.0, count)))
        turn(f"upperarm01.{side}", 2, spread(8.0))
        # The neutral elbow is bent by 44 degrees; a negative bend straightens it.
        bend = np.radians(rng.uniform(-48.0, 20.0, count))
        elbow_axis = np.array([0.7, sign * 0.15, sign * 0.7])
        turn_about(f"lowerarm01.{side}", -elbow_axis, bend)
        along = np.array([sign * 0.55, -0.5, -0.65])
        turn_about(f"lowerarm02.{side}", along, spread(20.0))
        for i in range(3):
            turn(f"wrist.{side}", i, spread(10.0))
        fist = np.where(rng.random(count) < 0.5, rng.random(count), 0.15 * rng.random(count))
        for finger in range(2, 6):
            curl_axis = np.array([0.55, sign * 0.75, sign * -0.3])
            for joint, amount in ((1, 50.0), (2, 65.0), (3, 45.0)):
                turn_about(f"finger{finger}-{joint}.{side}", curl_axis * np.radians(amount), fist)
        for i in range(3):
            turn(f"finger1-1.{side}", i, spread(8.0))
        # About y, negative brings the left leg in.
        leg = np.radians(4.9 - common_leg) + spread(1.5)
        turn(f"upperleg01.{side}", 1, sign * leg)
        turn(f"upperleg01.{side}", 0, spread(4.0))
        turn(f"upperleg01.{side}", 2, spread(7.0))
        turn(f"lowerleg01.{side}", 0, np.abs(spread(3.0)) - np.radians(1.0))
        turn(f"foot.{side}", 1, -sign * leg)
        turn(f"foot.{side}", 0, spread(2.0))
    return pose


def survey_posture(bones: list[str]) -> Array:
    """Turns (bones, 3) to the posture in which people are surveyed: arms 20 degrees from the trunk,
    legs upright. (Theirs hang down; flesh that presses on flesh is no size that can be compared.)
    """
    turns = np.zeros((len(bones), 3))
    lower = np.radians(_NEUTRAL_ARM_DEG - 20.0)
    for side, sign in (("L", 1.0), ("R", -1.0)):
        for bone, angle in (
            (f"clavicle.{side}", 0.15 * lower),
            (f"upperarm01.{side}", 0.85 * lower),
            (f"upperleg01.{side}", np.radians(6.0)),
            (f"foot.{side}", -np.radians(6.0)),
        ):
            turns[bones.index(bone), 1] = sign * angle
    return turns
